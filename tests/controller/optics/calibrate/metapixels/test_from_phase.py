from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
import scipy.sparse

from controller.core.arrays import Float64
from controller.optics.calibrate.correspondence.decode import decode
from controller.optics.calibrate.metapixels.from_phase import fit_metapixels
from controller.optics.calibrate.values import Correspondence, Metapixels
from controller.optics.capture.pattern_frames import frame
from controller.optics.capture.patterns import PatternKind, plan_patterns
from tests.controller.optics.calibrate.simulator import Scene, Stage, photographed

PLAN = plan_patterns(Scene().projector_px)
CUT = 3.0


def fitted(scene: Scene) -> tuple[Correspondence, Metapixels]:
    correspondence = decode(photographed(scene), PLAN)
    return correspondence, fit_metapixels(photographed(scene), PLAN, correspondence)


def seen(
    scene: Scene, metapixels: Metapixels, margin: int = 3, clear_px: float = 2
) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
    """Projector pixels truly in the camera's image and off the frame's border."""
    centre, (columns, rows) = scene.true_centres(), scene.camera_px
    inner = np.zeros(metapixels.valid.shape, bool)
    inner[margin:-margin, margin:-margin] = True
    return np.asarray(inner & np.all((centre > clear_px) & (centre < np.array([columns, rows]) - 1 - clear_px), axis=2))


def sigmas(xx: Float64, xy: Float64, yy: Float64) -> Float64:
    mean, half = (xx + yy) / 2, np.hypot((xx - yy) / 2, xy)
    return np.sqrt(np.stack([mean + half, mean - half]))


def shares(metapixels: Metapixels, camera_px: tuple[int, int]) -> scipy.sparse.csr_matrix:
    """Each camera pixel's shares of projector pixels: Gaussians cut at three sigma, rows summing to one."""
    columns, rows = camera_px
    which = np.flatnonzero(metapixels.valid)
    centre = metapixels.centre_px.reshape(-1, 2)[which].astype(float)
    xx, xy, yy = metapixels.covariance_px2.reshape(-1, 3)[which].astype(float).T
    reach = int(np.ceil(CUT * np.sqrt(max(xx.max(), yy.max()))))
    parts = []
    for dy in range(-reach, reach + 1):
        for dx in range(-reach, reach + 1):
            x, y = np.round(centre[:, 0]) + dx, np.round(centre[:, 1]) + dy
            u, v = x - centre[:, 0], y - centre[:, 1]
            far = (yy * u * u - 2 * xy * u * v + xx * v * v) / (xx * yy - xy * xy)
            ok = (far < CUT**2) & (x >= 0) & (y >= 0) & (x < columns) & (y < rows)
            parts.append(((y * columns + x)[ok], which[ok], np.exp(-far[ok] / 2)))
    row, column, value = (np.concatenate(part) for part in zip(*parts, strict=True))
    matrix = scipy.sparse.csr_matrix((value, (row.astype(int), column)), shape=(rows * columns, metapixels.valid.size))
    total = np.asarray(matrix.sum(axis=1)).ravel()
    return scipy.sparse.csr_matrix(scipy.sparse.diags(1 / np.where(total > 0, total, 1)) @ matrix)


def shown_alone(
    scene: Scene, wanted: np.ndarray[tuple[int, ...], np.dtype[np.bool_]], spacing: int = 22
) -> Iterator[tuple[tuple[int, int], Float64]]:
    """Pixels shown one by one, far from each other, without noise: x, y, xx, xy, yy of their light's share of white."""
    stage, (columns, rows) = Stage(scene), scene.camera_px
    y, x = np.mgrid[0:rows, 0:columns]
    white = stage.light(np.ones((*wanted.shape, 3), np.float32)).sum(axis=2)
    position = scene.projector_of(np.stack([x, y], axis=-1).astype(float))
    for down, across in [(n % spacing, 5 * n % spacing) for n in range(3, 6 * spacing, 51)]:
        dots = np.zeros((*wanted.shape, 3), np.float32)
        dots[down::spacing, across::spacing] = 1
        share = stage.light(dots).sum(axis=2) / np.maximum(white, 1e-6)
        for row, column in np.argwhere(wanted[down::spacing, across::spacing]) * spacing + [down, across]:
            near = np.max(np.abs(position - [column, row]), axis=2) < spacing / 2
            weight = np.where(near, share, 0).astype(float)
            weight /= weight.sum()
            cx, cy = np.sum(weight * x), np.sum(weight * y)
            dx, dy = x - cx, y - cy
            moments = [np.sum(weight * product) for product in (dx * dx, dx * dy, dy * dy)]
            yield (int(row), int(column)), np.array([cx, cy, *moments])


SCENES = {
    "in focus": Scene(),
    "blur 0.8": Scene(projector_blur_px=0.8),
    "blur 1.2": Scene(projector_blur_px=1.2),
    "blur 2": Scene(projector_blur_px=2.0),
    "small pixels": Scene(scale=1.5, seed=5),
}


@pytest.mark.parametrize("scene", SCENES.values(), ids=SCENES)
def test_centres_and_sizes_match_the_scene(scene: Scene) -> None:
    _, found = fitted(scene)
    use = seen(scene, found)
    assert np.mean(found.valid[use]) > 0.995
    rows = []
    # at the frame's border white itself fades, and its share with it; at the picture's, part is not seen
    whole = use & seen(
        scene, found, margin=3 + int(4 * scene.projector_blur_px), clear_px=8 + 8 * scene.projector_blur_px
    )
    for (row, column), truth in shown_alone(scene, whole & found.valid):
        error = found.centre_px[row, column] - truth[:2]
        relative = sigmas(*found.covariance_px2[row, column].astype(float)) / sigmas(*truth[2:]) - 1
        rows.append((*error, *relative))
    off = np.sqrt(np.mean(np.square(rows), axis=0))
    assert len(rows) > 12
    assert np.all(off[:2] < 0.025)
    assert np.all(off[2:] < 0.012)


@pytest.mark.parametrize("scene", SCENES.values(), ids=SCENES)
def test_a_random_pattern_is_predicted_within_two_percent(scene: Scene) -> None:
    correspondence, found = fitted(scene)
    stage = Stage(scene)
    white = stage.light(np.ones((*found.valid.shape, 3), np.float32))
    pattern = frame(PLAN.of_kind(PatternKind.RANDOM)[0], PLAN.size_px)
    truth = stage.light(pattern)
    light = shares(found, scene.camera_px) @ (pattern.reshape(-1, 3) @ np.array(scene.mixing).T)
    predicted = white * light.reshape(white.shape)
    use = correspondence.valid
    assert np.sqrt(np.sum((predicted - truth)[use] ** 2) / np.sum(truth[use] ** 2)) < 0.013


def test_pixels_at_the_frames_border_are_continued_from_inside() -> None:
    scene = Scene(scale=1.5, seed=5)
    _, found = fitted(scene)
    error = np.linalg.norm(found.centre_px - scene.true_centres(), axis=2)
    assert np.mean(found.valid[0, 3:-3]) > 0.99
    assert np.nanmax(error[0, 3:-3]) < 0.2


def test_at_a_depth_edge_the_pixels_lie_on_one_surface_or_are_left_out() -> None:
    """The left of the edge looks at positions up to p, the right from p + 7 on: those between are hidden."""
    scene = Scene(step_px=7.0)
    _, found = fitted(scene)
    edge = 0.6 * scene.camera_px[0]
    flat = Scene()
    left = flat.true_centres()
    right = flat.camera_of(np.stack(np.meshgrid(*(np.arange(n, dtype=float) for n in PLAN.size_px)), -1) - [7.0, 0.0])
    truth = np.where((left[..., :1] < edge - 1), left, np.where(right[..., :1] > edge + 1, right, np.nan))
    error = np.linalg.norm(found.centre_px - truth, axis=2)
    inner = seen(flat, found)
    assert np.nanquantile(error[inner & found.valid], 0.999) < 1.0
    hidden = inner & (left[..., 0] > edge + 4) & (right[..., 0] < edge - 4)
    assert hidden.any()
    assert not found.valid[hidden].any()


def test_where_two_surfaces_share_a_pixel_the_one_seen_by_more_camera_pixels_is_taken() -> None:
    rows, columns = 60, 80
    y, x = np.mgrid[0:rows, 0:columns].astype(np.float32)
    position = np.stack([x / 2, y / 2], axis=-1)
    position[:, 50:, 0] -= 25 - 2  # a second surface sees projector columns 2.. again, as far as 17
    valid = np.ones((rows, columns), bool)
    valid[:, 50:] = (y[:, 50:] % 2) == 0  # with half the pixels
    names = (
        "black",
        *(f"{kind}-{a}-{n}" for kind, axes in (("blur", "xyd"), ("phase", "xy")) for a in axes for n in range(3)),
    )
    blank = dict.fromkeys(names, np.ones((rows, columns), np.float32))
    plan = plan_patterns((40, 30))
    correspondence = Correspondence(position, np.full((rows, columns), 0.9, np.float32), valid)
    found = fit_metapixels(blank, plan, correspondence)
    assert found.valid[10, 5:15].all()
    np.testing.assert_allclose(found.centre_px[10, 5:15, 0], 2 * np.arange(5, 15), atol=0.2)


@pytest.mark.parametrize("share", [0.1, 0.3])
def test_light_by_way_of_other_surfaces_makes_no_pixel_wider(share: float) -> None:
    scene = Scene(projector_blur_px=0.6)
    captures = photographed(scene)
    correspondence, plain = fitted(scene)
    # It comes from everywhere, so fine patterns are not in it: the mean of a sinusoid's steps.
    lit = dict(captures)
    for pattern in PLAN:
        if pattern.name.startswith(("phase-", "blur-")):
            steps = [captures[f"{pattern.name[:-1]}{n}"] for n in range(3)]
            mean = np.mean(steps, axis=0, dtype=np.float32)
            lit[pattern.name] = np.asarray((1 - share) * captures[pattern.name] + share * mean, np.float32)
    found = fit_metapixels(lit, PLAN, correspondence)
    use = plain.valid & found.valid & seen(scene, plain)
    before, after = (np.sqrt(one.covariance_px2[use][:, [0, 2]].astype(float)) for one in (plain, found))
    assert np.abs(after / before - 1).max() < 0.02
    assert use.mean() > 0.5


def test_nothing_seen_gives_no_pixels() -> None:
    shape = (50, 60)
    nothing = Correspondence(
        np.full((*shape, 2), np.nan, np.float32), np.zeros(shape, np.float32), np.zeros(shape, np.bool_)
    )
    captures = {pattern.name: np.zeros(shape, np.float32) for pattern in PLAN}
    found = fit_metapixels(captures, PLAN, nothing)
    assert not found.valid.any()
    assert np.all(np.isnan(found.centre_px))
