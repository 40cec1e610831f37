"""Metapixels from simulated dots, against the scene's truth and against scipy's least squares."""

from __future__ import annotations

import functools
from collections.abc import Mapping

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import least_squares

from controller.core.arrays import Float64, FloatImage
from controller.core.errors import CalibrationError
from controller.optics.calibrate.correspondence.decode import decode
from controller.optics.calibrate.metapixels.from_dots import (
    WIDEST_CUT,
    fit_dots,
    initial_metapixels,
    largest_sigma_px,
    modelled_correspondence,
    peak_share,
)
from controller.optics.calibrate.metapixels.gaussian_fit import PARAMETERS, fit_gaussian
from controller.optics.calibrate.values import (
    Calibration,
    Geometry,
    Metapixels,
    Pinhole,
    ProjectorCalibration,
    Radiometry,
)
from controller.optics.capture.patterns import dot_frame, dot_patterns, plan_patterns
from controller.optics.transport import build_transport
from tests.controller.optics.calibrate.simulator import Scene, Stage, photographed

SMALL = Scene(camera_px=(120, 96), projector_px=(48, 40))
SCENES = {
    "in focus": (SMALL, 5),
    "blur 1.2": (Scene(camera_px=(120, 96), projector_px=(48, 40), projector_blur_px=1.2), 9),
    "small pixels": (Scene(camera_px=(84, 68), projector_px=(48, 40), scale=1.5, seed=5), 5),
}


@functools.cache
def dots_of(scene: Scene, r: int) -> tuple[Mapping[str, FloatImage], FloatImage]:
    """Photographs of black and of all dots, and the white image less black."""
    stage = Stage(scene)
    shape = (*scene.projector_px[::-1], 3)
    captures = {"black": stage.photograph(np.zeros(shape, np.uint8))}
    white = np.mean([stage.photograph(np.full(shape, 255, np.uint8)) for _ in range(3)], axis=0) - captures["black"]
    for pattern in dot_patterns(scene.projector_px, r):
        captures[pattern.name] = stage.photograph(dot_frame(pattern, scene.projector_px))
    return captures, white.astype(np.float32)


@functools.cache
def guess_of(scene: Scene) -> Metapixels:
    return initial_metapixels(decode(photographed(scene), plan_patterns(scene.projector_px)), scene.projector_px)


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(0, 1), st.floats(0, 1), st.floats(0, 6), st.sampled_from([1, 3]))
def test_a_fit_of_whatever_a_photograph_holds_fails_or_is_finite(
    seed: int, dark: float, unlit: float, size: float, channels: int
) -> None:
    rng = np.random.default_rng(seed)

    def picture(share: float) -> FloatImage:
        made = rng.random((24, 24, channels), np.float32)
        made[rng.random((24, 24)) < share] = 0
        return made

    image, white = picture(dark), picture(unlit)
    at, px2 = np.array([11.5, 12.25], np.float32), np.array([size, 0.1 * size, size], np.float32)
    fit = np.empty(PARAMETERS)
    quality = fit_gaussian(image, np.zeros_like(image), white, at, px2, at, px2, WIDEST_CUT, fit)
    assert quality == -1 or (quality >= 0 and np.isfinite(fit).all())


def inside(scene: Scene, margin: int = 3) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
    centre, (columns, rows) = scene.true_centres(), scene.camera_px
    inner = np.zeros(centre.shape[:2], bool)
    inner[margin:-margin, margin:-margin] = True
    return np.asarray(inner & np.all((centre > 4) & (centre < np.array([columns - 5, rows - 5])), axis=2))


def sigmas(packed: Float64) -> Float64:
    xx, xy, yy = np.moveaxis(packed, -1, 0)
    mean, half = (xx + yy) / 2, np.hypot((xx - yy) / 2, xy)
    return np.asarray(np.sqrt(np.stack([mean + half, mean - half])))


@pytest.mark.parametrize(("scene", "r"), SCENES.values(), ids=SCENES)
def test_centres_and_sizes_match_the_scene(scene: Scene, r: int) -> None:
    captures, white = dots_of(scene, r)
    found, report = fit_dots(captures, white, guess_of(scene), r)
    use = inside(scene) & found.valid
    assert report.fitted + report.failed == found.valid.sum()
    assert report.fitted > 0.99 * found.valid.sum()
    error = (found.centre_px - scene.true_centres())[use]
    assert np.sqrt(np.mean(error**2)) < 0.05
    truth = scene.true_covariance()
    packed = np.stack([truth[..., 0, 0], truth[..., 0, 1], truth[..., 1, 1]], axis=-1)
    relative = sigmas(found.covariance_px2.astype(float))[:, use] / sigmas(packed)[:, use] - 1
    assert np.sqrt(np.mean(relative**2)) < 0.02


def by_scipy(share: Float64, weight: Float64, guess: tuple[float, ...]) -> Float64:
    """Amplitude, centre, angle and two sigmas, as the paper has them; x, y, xx, xy, yy."""
    rows, columns = np.nonzero(weight)

    def residual(p: Float64) -> Float64:
        a, x, y, angle, s1, s2 = p
        u = np.cos(angle) * (columns - x) + np.sin(angle) * (rows - y)
        v = -np.sin(angle) * (columns - x) + np.cos(angle) * (rows - y)
        model = a * np.exp(-0.5 * ((u / s1) ** 2 + (v / s2) ** 2))
        return np.asarray(np.sqrt(weight[rows, columns]) * (model - share[rows, columns]))

    x, y, xx, _, yy = guess
    start = np.array([share.max(), x, y, 0.3, np.sqrt(xx), np.sqrt(yy)])
    p = least_squares(residual, start, method="lm", xtol=1e-10, ftol=1e-12).x
    turn = np.array([[np.cos(p[3]), -np.sin(p[3])], [np.sin(p[3]), np.cos(p[3])]])
    covariance = turn @ np.diag(p[4:] ** 2) @ turn.T
    return np.array([p[1], p[2], covariance[0, 0], covariance[0, 1], covariance[1, 1]])


def test_fits_agree_with_scipys_least_squares_in_the_papers_own_parameters() -> None:
    scene, r = SCENES["blur 1.2"]
    captures, white = dots_of(scene, r)
    guess = guess_of(scene)
    # started at the answer, both fit the same window
    near, _ = fit_dots(captures, white, guess, r)
    near, _ = fit_dots(captures, white, near, r)
    found, _ = fit_dots(captures, white, near, r)
    y, x = np.mgrid[0 : white.shape[0], 0 : white.shape[1]].astype(float)
    for row, column in ((10, 12), (15, 30), (20, 24), (27, 17), (30, 35)):
        image = captures[f"dot-{column % r:02d}-{row % r:02d}"].astype(float) - captures["black"]
        full = white.astype(float).sum(axis=2)
        cx, cy = near.centre_px[row, column].astype(float)
        xx, xy, yy = near.covariance_px2[row, column].astype(float)
        others = [
            near.centre_px[row + i, column + j].astype(float) - (cx, cy)
            for i in (-r, 0, r)
            for j in (-r, 0, r)
            if (i or j) and 0 <= row + i < 40 and 0 <= column + j < 48 and near.valid[row + i, column + j]
        ]
        inverse = np.linalg.inv([[xx, xy], [xy, yy]])
        cut = min(WIDEST_CUT, *(0.5 * float(np.sqrt(d @ inverse @ d)) for d in others))
        d = np.stack([x - cx, y - cy], axis=-1)
        window = np.einsum("...i,ij,...j", d, inverse, d) <= cut**2
        weight = np.where(window, full / full[window].max(), 0.0)
        wanted = by_scipy(image.sum(axis=2) / full, weight, (cx, cy, xx, xy, yy))
        got = np.concatenate([found.centre_px[row, column], found.covariance_px2[row, column]])
        np.testing.assert_allclose(got, wanted, rtol=1e-3, atol=1e-3)


def test_a_poor_guess_leads_to_the_same_fits() -> None:
    scene, r = SCENES["small pixels"]
    captures, white = dots_of(scene, r)
    guess = guess_of(scene)
    random = np.random.default_rng(3)
    poor = Metapixels(
        (guess.centre_px + random.normal(0, 0.4, guess.centre_px.shape)).astype(np.float32),
        guess.covariance_px2 * random.uniform(0.6, 1.6, guess.valid.shape).astype(np.float32)[..., None],
        guess.valid,
    )
    good, _ = fit_dots(captures, white, guess, r)
    found, report = fit_dots(captures, white, poor, r)
    assert report.failed < 0.01 * report.fitted
    use = inside(scene) & guess.valid
    moved = np.linalg.norm(found.centre_px - good.centre_px, axis=2)[use]
    assert np.quantile(moved, 0.98) < 0.05


def test_where_a_dot_is_dark_or_elsewhere_the_guess_is_kept_and_counted() -> None:
    scene, r = SCENES["in focus"]
    captures, white = dots_of(scene, r)
    guess = guess_of(scene)
    dark = {**captures, "dot-02-03": captures["black"], "dot-01-01": captures["dot-03-03"]}
    found, report = fit_dots(dark, white, guess, r)
    for row, column in ((3, 2), (1, 1)):
        lost = guess.valid[row::r, column::r]
        assert lost.sum() > 20
        np.testing.assert_array_equal(found.centre_px[row::r, column::r], guess.centre_px[row::r, column::r])
        np.testing.assert_array_equal(found.covariance_px2[row::r, column::r], guess.covariance_px2[row::r, column::r])
    _, whole = fit_dots(captures, white, guess, r)
    assert report.failed - whole.failed >= 0.98 * 2 * (guess.valid[3::r, 2::r].sum())
    assert report.without_guess == (~guess.valid).sum()


def test_a_few_saturated_camera_pixels_do_no_harm() -> None:
    scene, r = SCENES["blur 1.2"]
    captures, white = dots_of(scene, r)
    random = np.random.default_rng(1)
    holes = {
        name: np.where(random.random((*image.shape[:2], 1)) < 0.05, np.nan, image) for name, image in captures.items()
    }
    whole, _ = fit_dots(captures, white, guess_of(scene), r)
    found, report = fit_dots({k: v.astype(np.float32) for k, v in holes.items()}, white, guess_of(scene), r)
    assert report.failed < 0.01 * report.fitted
    use = inside(scene) & whole.valid
    assert np.sqrt(np.mean((found.centre_px - whole.centre_px)[use] ** 2)) < 0.05


def test_the_transport_of_fitted_dots_gives_the_white_image_where_it_is_lit() -> None:
    scene, r = SCENES["in focus"]
    captures, white = dots_of(scene, r)
    found, _ = fit_dots(captures, white, guess_of(scene), r)
    white = np.maximum(white, 0)
    radiometry = Radiometry(np.tile(np.linspace(0, 1, 256), (3, 1)), np.array(scene.mixing))
    lit = white.min(axis=2) > 0.05 * white.max()
    part = ProjectorCalibration("left", found, radiometry, white)
    transport = build_transport(Calibration((part,), np.zeros_like(white), lit, np.eye(3)))
    seen = transport.forward_part(0, np.ones((*found.valid.shape, 3), np.float32))
    near = np.zeros(lit.shape, bool)
    x, y = np.round(found.centre_px[found.valid]).astype(int).T
    inside_picture = (x >= 0) & (y >= 0) & (x < lit.shape[1]) & (y < lit.shape[0])
    near[y[inside_picture], x[inside_picture]] = True
    near = cv2.dilate(near.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    assert transport.lit[0][lit & near].mean() > 0.99
    use = lit & near
    assert np.sqrt(np.mean((seen - white)[use] ** 2)) < 0.01 * np.sqrt(np.mean(white[use] ** 2))


def test_where_a_fit_fails_the_models_guess_is_taken_if_there_is_one() -> None:
    scene, r = SCENES["in focus"]
    captures, white = dots_of(scene, r)
    guess = guess_of(scene)
    model = Metapixels(guess.centre_px + np.float32(0.25), guess.covariance_px2, guess.valid.copy())
    model.valid[:20] = False
    dark = {**captures, "dot-02-03": captures["black"]}
    found, _ = fit_dots(dark, white, guess, r, fallback=model)
    rows = np.arange(3, scene.projector_px[1], r)
    np.testing.assert_array_equal(found.centre_px[rows[rows < 20], 2::r], guess.centre_px[rows[rows < 20], 2::r])
    np.testing.assert_array_equal(found.centre_px[rows[rows >= 20], 2::r], model.centre_px[rows[rows >= 20], 2::r])


def test_blur_and_brightness_of_dots_are_known_before_any_is_shown() -> None:
    for scene, r in SCENES.values():
        captures, white = dots_of(scene, r)
        found, _ = fit_dots(captures, white, guess_of(scene), r)
        spread = scene.projector_blur_px**2 + (scene.lit_share_of_pixel / 10) ** 2 / 12
        camera = (scene.camera_blur_px**2 + 1 / 12) / scene.scale**2
        wanted = np.sqrt(spread + camera)
        assert largest_sigma_px(found) == pytest.approx(wanted, rel=0.25)
        grey = (captures[f"dot-{20 % r:02d}-{18 % r:02d}"] - captures["black"]).sum(axis=2)
        x, y = np.round(found.centre_px[18, 20]).astype(int)
        brightest = (grey / white.sum(axis=2))[y - 2 : y + 3, x - 2 : x + 3].max()
        assert peak_share(found) == pytest.approx(brightest, rel=0.3)


def test_a_missing_picture_and_one_of_another_size_are_refused() -> None:
    scene, r = SCENES["in focus"]
    captures, white = dots_of(scene, r)
    some = {name: image for name, image in captures.items() if name != "dot-01-00"}
    with pytest.raises(CalibrationError) as refused:
        fit_dots(some, white, guess_of(scene), r)
    assert refused.value.code == "capture-missing"
    with pytest.raises(CalibrationError) as refused:
        fit_dots({**captures, "dot-01-00": white[1:]}, white, guess_of(scene), r)
    assert refused.value.code == "capture-shape-wrong"
    with pytest.raises(CalibrationError) as refused:
        fit_dots({**captures, "dot-01-00": white[..., 0]}, white, guess_of(scene), r)
    assert refused.value.code == "capture-shape-wrong"


def test_the_model_tells_where_pixels_lie_and_what_stands_in_shadow() -> None:
    """A wall at 2 m, a plate at 1 m before its right part, a projector half a metre to the left."""
    rows, columns, focal = 90, 120, 150.0
    y, x = np.mgrid[0:rows, 0:columns].astype(float)
    ray = np.stack([(x - 60) / focal, (y - 45) / focal, np.ones((rows, columns))], axis=-1)
    plate = (x > 55) & (x < 75) & (y > 30) & (y < 60)
    depth = np.where(plate, 1.0, 2.0)
    points = (ray * depth[..., None]).astype(np.float32)
    normals = np.broadcast_to(np.array([0, 0, -1], np.float32), points.shape).copy()
    matrix = np.array([[100.0, 0, 40], [0, 100.0, 30], [0, 0, 1]])
    projector = Pinhole(matrix, np.zeros(2), np.eye(3), np.array([0.5, 0.0, 0.0]), (120, 60))
    camera = Pinhole(
        np.array([[focal, 0, 60], [0, focal, 45], [0, 0, 1]]), np.zeros(2), np.eye(3), np.zeros(3), (120, 90)
    )
    seen = modelled_correspondence(Geometry(camera, (projector,), points, normals, 0.1, scale_known=True), 0)
    wanted = 100 * (points[..., 0] + 0.5) / depth + 40
    inside_frame = (wanted > 0) & (wanted < 119) & (np.abs(100 * points[..., 1] / depth) < 29)
    np.testing.assert_allclose(seen.projector_px[seen.valid][:, 0], wanted[seen.valid], atol=1e-3)
    shadow = inside_frame & ~plate & ~seen.valid
    # the plate hides what lies right of it, at the projector pixels it takes
    hidden = wanted[shadow]
    assert shadow.sum() > 100
    assert hidden.min() > wanted[plate].min() - 1
    assert hidden.max() < wanted[plate].max() + 1
    guess = initial_metapixels(seen, (120, 60))
    assert guess.valid.sum() > 500
    use = guess.valid & np.all((guess.centre_px > 0) & (guess.centre_px < (columns - 1, rows - 1)), axis=2)
    u, v = np.round(guess.centre_px[use]).astype(int).T
    off = np.abs(seen.projector_px[v, u] - np.argwhere(use)[:, ::-1])
    assert np.nanquantile(off, 0.95) < 1.0
