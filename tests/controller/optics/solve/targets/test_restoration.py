"""Pictures that restore a faded object: where they are laid, in which colours, and which are refused."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt
import pytest
import skimage.data

from controller.core.arrays import FloatImage
from controller.core.colour import srgb_to_linear
from controller.core.errors import UsageError
from controller.optics.solve.reach.drive_levels import DriveLevels
from controller.optics.solve.reach.feasibility import feasibility, with_less_light
from controller.optics.solve.targets.registration import Registration, register
from controller.optics.solve.targets.restoration import LightName, RestorationLook, restored, without_margin
from controller.optics.solve.targets.values import Target
from controller.optics.transport import build_transport
from tests.controller.optics.solve.conftest import plane_calibration

CAMERA = (260, 340)
"""(rows, columns)"""
Matrix = npt.NDArray[np.float64]


def picture_of(name: str, seed: int = 1) -> FloatImage:
    """(200, 260, 3) linear light: a cut of a photograph, or shapes of all sizes and colours at random."""
    if name == "shapes":
        rng = np.random.default_rng(seed)
        image = np.full((200, 260, 3), 0.5, np.float32)
        for size in np.geomspace(60, 3, 160):
            centre, axes = rng.uniform(0, (260, 200)), rng.uniform(0.3, 1, 2) * size
            colour = rng.uniform(0, 1, 3).tolist()
            cv2.ellipse(image, (tuple(centre), tuple(2 * axes), float(rng.uniform(0, 180))), colour, -1)
        return cv2.GaussianBlur(image, (0, 0), 0.7).astype(np.float32)
    whole = srgb_to_linear(getattr(skimage.data, name)()[..., :3])
    by = max(260 / whole.shape[1], 200 / whole.shape[0])
    small = cv2.resize(whole, None, fx=by, fy=by, interpolation=cv2.INTER_AREA)
    return np.ascontiguousarray(small[:200, :260], np.float32)


def on_wall(picture: FloatImage, seed: int) -> tuple[FloatImage, Matrix]:
    """How the camera sees it, faded, with a stain, in a frame on a wall; and (3, 3) from its pixels to the camera's."""
    rng = np.random.default_rng(seed)
    height, width = picture.shape[:2]
    corners = np.array([[0, 0], [width - 1, 0], [width - 1, height - 1], [0, height - 1]], np.float32)
    middle_px = np.array([CAMERA[1] - width, CAMERA[0] - height]) / 2
    seen = corners + middle_px + rng.uniform(-9, 9, (4, 2))
    to_camera = cv2.getPerspectiveTransform(corners, seen.astype(np.float32))
    laid = cv2.warpPerspective(picture, to_camera, CAMERA[::-1], flags=cv2.INTER_CUBIC)
    inside = cv2.warpPerspective(np.ones((height, width), np.float32), to_camera, CAMERA[::-1]) > 0.99
    mixed = np.clip(laid, 0, 1) @ (0.5 * np.eye(3) + 0.5 * rng.dirichlet(np.ones(3), 3)).T
    faded = (0.25 + 0.35 * mixed ** rng.uniform(0.6, 1.2)) * [1.0, 0.85, 0.6]
    y, x = np.mgrid[0 : CAMERA[0], 0 : CAMERA[1]]
    middle = seen[0] + 0.4 * (seen[2] - seen[0])
    stain = np.clip(1.2 - np.hypot(x - middle[0], y - middle[1]) / 40, 0, 1)[..., None]
    faded = faded * (1 - stain) + stain * [0.12, 0.08, 0.05]
    frame = cv2.dilate(inside.astype(np.uint8), np.ones((21, 21), np.uint8)) > 0
    scene = np.where(inside[..., None], faded, np.where(frame[..., None], [0.3, 0.2, 0.1], 0.6))
    scene = cv2.GaussianBlur(scene, (0, 0), 0.7) * (1 + 0.01 * rng.standard_normal(scene.shape))
    return scene.astype(np.float32), np.asarray(to_camera, np.float64)


def scanned(picture: FloatImage, degrees: float = 10.0, scale: float = 0.7) -> tuple[FloatImage, Matrix]:
    """The picture turned and scaled on white; and (3, 3) from its pixels to the scan's."""
    height, width = picture.shape[:2]
    turn = cv2.getRotationMatrix2D(((width - 1) / 2, (height - 1) / 2), degrees, scale)
    size = np.ceil(np.abs(turn[:, :2]) @ (width, height)).astype(int)
    turn[:, 2] += (size - (width, height)) / 2
    soft = cv2.GaussianBlur(picture, (0, 0), 0.4 / scale)
    scan = cv2.warpAffine(soft, turn, size.tolist(), flags=cv2.INTER_CUBIC, borderValue=(0.9, 0.9, 0.9))
    return np.clip(scan, 0, 1).astype(np.float32), np.vstack([turn, [0, 0, 1]])


def beside_px(found: Registration, to_camera: Matrix, to_scan: Matrix) -> Matrix:
    """(n,) camera pixels between where places of the picture are laid and where they are."""
    x, y = np.meshgrid(np.linspace(8, 251, 12), np.linspace(8, 191, 12))
    places = np.stack([x, y], -1).reshape(-1, 1, 2)
    seen = cv2.perspectiveTransform(places, to_camera)[:, 0]
    at = seen.astype(np.float32)
    laid = cv2.remap(found.position_px, at[:, :1], at[:, 1:], cv2.INTER_LINEAR).astype(np.float64)
    back = cv2.perspectiveTransform(laid.reshape(-1, 1, 2), to_camera @ np.linalg.inv(to_scan))[:, 0]
    return np.asarray(np.hypot(*(back - seen).T))


@pytest.mark.parametrize(("name", "seed"), [("astronaut", 1), ("coffee", 7), ("shapes", 23), ("chelsea", 3)])
def test_a_turned_small_scan_is_laid_on_what_has_faded(name: str, seed: int) -> None:
    picture = picture_of(name, seed)
    own, to_camera = on_wall(picture, seed)
    scan, to_scan = scanned(picture)
    found = register(without_margin(scan), own)
    beside = beside_px(found, to_camera, to_scan)
    assert np.median(beside) <= 0.5
    assert np.percentile(beside, 95) <= 2.0
    assert found.turned_degrees == pytest.approx(10, abs=4)
    assert not found.matched[:20].any(), "the wall is no part of the picture"
    assert np.nanmedian(found.residual_px) < 1.0


def test_a_picture_upside_down_is_turned() -> None:
    picture = picture_of("shapes")
    own, to_camera = on_wall(picture, 5)
    scan, to_scan = scanned(picture, 180.0, 1.0)
    found = register(scan, own)
    assert np.median(beside_px(found, to_camera, to_scan)) < 0.5
    assert abs(found.turned_degrees) > 170


def test_of_twenty_other_pictures_twenty_are_refused() -> None:
    own, _ = on_wall(picture_of("astronaut"), 1)
    photographs = [picture_of(name) for name in ("coffee", "chelsea", "rocket")]
    shapes = [picture_of("shapes", seed) for seed in range(2, 18)]
    plain = np.full((200, 260, 3), 0.5, np.float32)
    for other in (*photographs, *shapes, plain):
        with pytest.raises(UsageError) as refused:
            register(np.ascontiguousarray(other[::2, ::2]), own)
        assert refused.value.code == "restoration-not-matched"


def test_a_mirrored_picture_is_named() -> None:
    picture = picture_of("coffee")
    own, _ = on_wall(picture, 2)
    with pytest.raises(UsageError) as refused:
        register(np.ascontiguousarray(picture[:, ::-1]), own)
    assert refused.value.code == "restoration-mirrored"


def clicked(to_camera: Matrix, places: Matrix, off_px: float = 0.0) -> list[tuple[float, float, float, float]]:
    rng = np.random.default_rng(0)
    seen = cv2.perspectiveTransform(places.reshape(-1, 1, 2), to_camera)[:, 0] + rng.uniform(
        -off_px, off_px, places.shape
    )
    return [(*place, *at) for place, at in zip(places.tolist(), seen.tolist(), strict=True)]


PLACES = np.array([[10.0, 12.0], [240.0, 20.0], [250.0, 180.0], [15.0, 190.0], [120.0, 70.0]])


def test_points_lay_a_picture_that_has_nothing_in_common() -> None:
    own, to_camera = on_wall(picture_of("astronaut"), 1)
    other = picture_of("coffee")
    found = register(other, own, clicked(to_camera, PLACES))
    assert found.by_points
    assert beside_px(found, to_camera, np.eye(3)).max() < 0.05


def test_what_both_have_in_common_makes_points_more_exact() -> None:
    picture = picture_of("coffee")
    own, to_camera = on_wall(picture, 1)
    found = register(picture, own, clicked(to_camera, PLACES[:4], off_px=4.0))
    assert not found.by_points
    assert np.median(beside_px(found, to_camera, np.eye(3))) < 0.5


@pytest.mark.parametrize(
    ("points", "says"),
    [
        ([(1, 1, 1, 1), (50, 1, 50, 1), (1, 50, 1, 50)], "3 points"),
        ([(n, n, 10 + 2 * n, 20 + n) for n in range(0, 100, 20)], "line"),
        ([(0, 0, 0, 0), (50, 0, 50, 0), (100, 0, 100, 0), (0, 50, 0, 50)], "line"),
        ([(0, 0, 0, 0), (50, 0, 50, 0), (50, 50, 50, 50), (300, 5, 0, 50)], "300, 5 is outside the picture of 260"),
        ([(0, 0, 0, 0), (50, 0, 50, 0), (50, 50, 50, 50), (0, 50, 0, -9)], "0, -9 is outside the camera's picture"),
        ([(0, 0, 0, 0), (50, 0, 50, 0), (50, 50, 0, 50), (0, 50, 50, 50)], "order"),
        ([(0, 0, 50, 0), (50, 0, 0, 0), (50, 50, 0, 50), (0, 50, 50, 50)], "order"),
    ],
)
def test_points_that_lay_nothing_are_named(points: list[tuple[float, float, float, float]], says: str) -> None:
    own, _ = on_wall(picture_of("shapes"), 1)
    with pytest.raises(UsageError, match=says) as refused:
        register(picture_of("shapes"), own, points)
    assert refused.value.code == "restoration-points"


def test_on_a_round_object_the_picture_is_bent() -> None:
    picture = np.repeat(np.repeat(picture_of("shapes", 4), 2, axis=0), 2, axis=1)
    rows, columns = 440, 480
    y, x = np.mgrid[0:rows, 0:columns].astype(np.float64)
    across = (x - columns / 2) / 300
    to_x = 259.5 + 300 * np.arcsin(np.clip(across, -0.75, 0.75))
    to_y = 199.5 + 1.02 * (y - rows / 2) + 10 * across**2
    own = 0.3 + 0.3 * cv2.remap(picture, to_x.astype(np.float32), to_y.astype(np.float32), cv2.INTER_LINEAR)
    own[(np.abs(across) > 0.7)] = np.nan
    found = register(picture, own.astype(np.float32))
    inside = found.matched & (np.abs(across) < 0.6) & (to_y > 10) & (to_y < 390)
    beside = np.hypot(*(np.moveaxis(found.position_px, 2, 0) - (to_x, to_y)))[inside]
    assert inside.sum() > 0.5 * inside.size
    assert np.median(beside) <= 0.5
    assert np.percentile(beside, 95) <= 2.0


def flat(picture: FloatImage, rows: int = 40, columns: int = 50) -> Registration:
    """Pixel on pixel, ten pixels in."""
    y, x = np.mgrid[0:rows, 0:columns].astype(np.float32) - 10
    inside = (x >= 0) & (y >= 0) & (x < picture.shape[1]) & (y < picture.shape[0])
    return Registration(np.stack([x, y], -1), inside, inside.copy(), np.zeros_like(x), 0.0, by_points=False)


TO_XYZ = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])


@pytest.mark.parametrize("outside", ["dark", "as-is"])
def test_what_is_around_the_picture_stays_dark_or_as_it_is(outside: str) -> None:
    picture = np.full((20, 30, 3), 0.4, np.float32)
    picture[:5, :5] = np.nan
    own = np.full((40, 50, 3), 0.25, np.float32)
    mask = np.ones((40, 50), np.bool_)
    mask[:, -5:] = False
    laid = flat(picture)
    laid.matched[15:, 30:] = False
    laid.inside[10:15, 10:15] = laid.matched[10:15, 10:15] = False
    look = RestorationLook(outside="as-is" if outside == "as-is" else "dark")
    target = restored(picture, laid, own, mask, look, TO_XYZ)
    np.testing.assert_allclose(target.image[18:22, 18:22], 0.4, atol=2e-3)
    np.testing.assert_allclose(target.image[25, 35], 0.25, atol=2e-3, err_msg="what is not matched is the object's own")
    for around in ((2, 2), (12, 12), (38, 20)):
        np.testing.assert_allclose(target.image[around], 0.25 if outside == "as-is" else 0.0, atol=2e-3)
        assert target.mask[around] == (outside == "as-is")
    assert not target.mask[:, -5:].any()
    assert np.isfinite(target.image).all()


BRADFORD = {
    "d65": np.eye(3),
    "d50": np.array(
        [[1.0478112, 0.0228866, -0.0501270], [0.0295424, 0.9904844, -0.0170491], [-0.0092345, 0.0150436, 0.7521316]]
    ),
    "a": np.array(
        [[1.2164557, 0.1109905, -0.1549325], [0.1533326, 0.9152313, -0.0559953], [-0.0239469, 0.0358984, 0.3147529]]
    ),
}
"""From D65, as Bruce Lindbloom publishes them."""


@pytest.mark.parametrize("light", ["d65", "d50", "a"])
def test_colours_are_those_of_the_surface_under_the_light(light: LightName) -> None:
    patch = np.array([0.55, 0.3, 0.2])
    camera_to_xyz = TO_XYZ @ np.array([[0.9, 0.08, 0.02], [0.05, 0.9, 0.05], [0.0, 0.1, 0.9]])
    picture = np.broadcast_to(patch, (20, 30, 3)).astype(np.float32)
    own, mask = np.zeros((40, 50, 3), np.float32), np.ones((40, 50), np.bool_)
    target = restored(picture, flat(picture), own, mask, RestorationLook(light=light), camera_to_xyz)
    np.testing.assert_allclose(camera_to_xyz @ target.image[20, 25], BRADFORD[light] @ TO_XYZ @ patch, atol=2e-3)


@pytest.mark.parametrize(
    ("look", "share"),
    [
        (RestorationLook(), None),
        (RestorationLook(brightness=0.3), 0.3),
        (RestorationLook(lux=50, white_lux=400), 0.125),
    ],
)
def test_the_light_is_a_share_of_the_projectors_white(look: RestorationLook, share: float | None) -> None:
    assert look.share_of_white() == share


@pytest.mark.parametrize(
    "look",
    [
        RestorationLook(brightness=1.2),
        RestorationLook(brightness=0),
        RestorationLook(lux=50),
        RestorationLook(lux=500, white_lux=400),
        RestorationLook(lux=5, white_lux=400, brightness=0.5),
    ],
)
def test_a_light_that_cannot_be_is_named(look: RestorationLook) -> None:
    with pytest.raises(UsageError) as refused:
        look.share_of_white()
    assert refused.value.code == "restoration-light"


def test_only_an_even_margin_at_all_corners_is_left_out() -> None:
    picture = picture_of("shapes")
    np.testing.assert_array_equal(without_margin(picture), picture)
    scan, to_scan = scanned(picture)
    known = np.asarray(np.isfinite(without_margin(scan)).all(axis=2))
    assert not known[[0, 0, -1, -1], [0, -1, 0, -1]].any()
    ours = cv2.warpPerspective(np.ones((200, 260), np.float32), to_scan, known.shape[::-1]) > 0.5
    assert (known == ours).mean() > 0.95
    cut = np.zeros((40, 50, 3), np.float32)
    cut[:5] = cut[-5:] = np.nan
    np.testing.assert_array_equal(without_margin(cut), cut, err_msg="black beside what is transparent is the picture's")
    even = np.full((20, 30, 3), 0.4, np.float32)
    np.testing.assert_array_equal(without_margin(even), even)


def test_the_light_is_named_at_which_hardly_anything_is_too_bright() -> None:
    calibration = plane_calibration()
    transport, black = build_transport(calibration), calibration.black
    slope = np.linspace(0.1, 0.5, transport.camera_shape[1])[:, None]
    mask = np.zeros(transport.camera_shape, np.bool_)
    mask[:, 20:60] = True
    image = np.asarray(np.where(mask[..., None], slope, 0) * np.ones(3), np.float32)
    target, drive = Target(image, mask), DriveLevels.of_transport(transport)
    share, less, then_share = with_less_light(drive, target, black, exposure=2.0)

    def shown(exposure: float) -> float:
        return float(feasibility(drive, exposure * image, black).reachable[mask].mean())

    assert share == pytest.approx(shown(2.0))
    assert then_share == pytest.approx(shown(2.0 * less))
    assert share < 0.9 < 0.98 < then_share
    assert shown(2.1 * less) < then_share
