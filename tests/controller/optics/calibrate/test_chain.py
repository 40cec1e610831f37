"""From photographs to the light transport, as a calibration goes, with whatever may go wrong on the way."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from controller.core.arrays import FloatImage
from controller.core.errors import CalibrationError, VelaturaError
from controller.optics.calibrate.correspondence.decode import decode
from controller.optics.calibrate.geometry.self_calibration import reconstruct
from controller.optics.calibrate.geometry.values import CameraPrior, Reconstruction
from controller.optics.calibrate.metapixels.from_phase import fit_pixels
from controller.optics.calibrate.photometry.radiometry import measure_radiometry
from controller.optics.calibrate.values import Calibration, Correspondence, ProjectorCalibration, Radiometry
from controller.optics.capture.pattern_frames import frame
from controller.optics.capture.patterns import PatternKind, plan_patterns
from controller.optics.transport import LightTransport, build_transport
from tests.controller.optics.calibrate.geometry.test_self_calibration import CAMERA, PROJECTOR, fitted, make_stage
from tests.controller.optics.calibrate.geometry.test_self_calibration import Stage as TrueStage
from tests.controller.optics.calibrate.simulator import Scene, Stage, positions

pytestmark = pytest.mark.slow

PLAN = plan_patterns(PROJECTOR)
LINEAR = Radiometry(np.tile(np.linspace(0, 1, 256), (3, 1)), np.eye(3))
NAMES = ("left", "right", "above")
SMALL = Scene((132, 100), (64, 48), 1.9, 3.0, seed=3)
REACH_PX = 8
SMALL_NAMES = [pattern.name for pattern in plan_patterns(SMALL.projector_px)]


@functools.cache
def truth() -> TrueStage:
    return make_stage(11, noise_px=0.0, outliers=0.0)


def photograph(n: int, light: FloatImage, seed: int) -> FloatImage:
    """What the camera of ``truth`` sees of projector ``n`` showing linear light: square pixels, blurred, and paint."""
    large = cv2.GaussianBlur(cv2.resize(light, None, fx=4, fy=4, interpolation=cv2.INTER_NEAREST), (0, 0), 1.6)
    at = np.nan_to_num(4 * (truth().correspondences[n].projector_px + 0.5) - 0.5, nan=-99.0)
    seen = cv2.remap(large, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
    y, x = np.mgrid[0 : CAMERA[1], 0 : CAMERA[0]]
    paint = 0.6 + 0.2 * (np.sin(x / 17) * np.cos(y / 19))[..., None]
    seen = seen.reshape(CAMERA[1], CAMERA[0], -1)
    noise = np.random.default_rng([seed, n]).normal(0.002, 0.0005, (CAMERA[1], CAMERA[0], 3))
    return np.asarray(paint * seen + noise, np.float32)


@functools.cache
def photographs(n: int, *, dead: bool = False) -> dict[str, FloatImage]:
    lamp = np.float32(0.0 if dead else 1.0)
    return {
        p.name: photograph(n, lamp * frame(p, PROJECTOR), seed)
        for seed, p in enumerate(PLAN)
        if p.kind is not PatternKind.COLOUR_TILES
    }


@dataclass(frozen=True)
class Calibrated:
    correspondences: list[Correspondence]
    transport: LightTransport


def calibrated(order: Sequence[int], dead: int | None = None) -> Calibrated:
    parts, found = [], []
    for n in order:
        captures = photographs(n, dead=n == dead)
        found.append(decode(captures, PLAN))
        fit = fit_pixels(captures, PLAN, found[-1])
        white = np.maximum(captures["white"] - captures["black"], 0)
        white[~found[-1].valid] = 0
        parts.append(ProjectorCalibration(NAMES[n], fit.metapixels, LINEAR, white, fit.phase_map))
    mask = np.any([part.white.max(axis=2) > 0 for part in parts], axis=0)
    black = photographs(0)["black"]
    return Calibrated(found, build_transport(Calibration(tuple(parts), black, mask, np.eye(3))))


def solved(found: Sequence[Correspondence]) -> Reconstruction:
    prior = CameraPrior(truth().focal_px, 0.01, distance_m=1.3)
    return reconstruct(found, CAMERA, [PROJECTOR] * len(found), prior)


@pytest.fixture(scope="module")
def whole() -> Calibrated:
    return calibrated((0, 1, 2))


@pytest.fixture(scope="module")
def geometry(whole: Calibrated) -> Reconstruction:
    return solved(whole.correspondences)


def test_photographs_become_a_shape_and_a_transport_that_predicts(whole: Calibrated, geometry: Reconstruction) -> None:
    points = geometry.geometry.points_m.astype(np.float64)
    known = np.isfinite(points[..., 2])
    moved, *_ = fitted(points[known], truth().points[known])
    assert np.sqrt(np.mean(np.sum((moved - truth().points[known]) ** 2, axis=1))) < 5e-4
    pattern = frame(PLAN.of_kind(PatternKind.RANDOM)[0], PROJECTOR)
    for n in range(3):
        seen = photographs(n)["random-0"] - photographs(n)["black"]
        use = whole.transport.lit[n]
        difference = (whole.transport.forward_part(n, pattern) - seen)[use]
        assert np.sqrt(np.mean(difference**2) / np.mean(seen[use] ** 2)) < 0.03


def test_projectors_in_another_order_give_the_same_stage(whole: Calibrated, geometry: Reconstruction) -> None:
    order = (2, 0, 1)
    other = calibrated(order)
    pattern = frame(PLAN.of_kind(PatternKind.RANDOM)[0], PROJECTOR)
    for place, n in enumerate(order):
        np.testing.assert_array_equal(
            other.transport.forward_part(place, pattern), whole.transport.forward_part(n, pattern)
        )
    turned = solved(other.correspondences)
    both = np.isfinite(turned.geometry.points_m[..., 2]) & np.isfinite(geometry.geometry.points_m[..., 2])
    apart = (turned.geometry.points_m - geometry.geometry.points_m)[both]
    assert np.mean(both) > 0.3
    assert np.sqrt(np.mean(np.sum(apart**2, axis=1))) < 2e-3
    for place, n in enumerate(order):
        change = turned.geometry.projectors[place].rotation @ geometry.geometry.projectors[n].rotation.T
        assert np.degrees(np.arccos(np.clip((np.trace(change) - 1) / 2, -1, 1))) < 0.2


def test_a_dead_projector_lights_nothing_is_named_by_the_geometry_and_harms_no_other(whole: Calibrated) -> None:
    hurt = calibrated((0, 1, 2), dead=1)
    assert np.mean(hurt.correspondences[1].valid) < 1e-3
    white = np.ones((PROJECTOR[1], PROJECTOR[0], 3), np.float32)
    assert np.mean(hurt.transport.forward_part(1, white)) < 1e-4
    for n in (0, 2):
        np.testing.assert_array_equal(hurt.transport.forward_part(n, white), whole.transport.forward_part(n, white))
    with pytest.raises(CalibrationError, match="rojector"):
        solved(hurt.correspondences)


@functools.cache
def small() -> dict[str, FloatImage]:
    return Stage(SMALL).captures()


@functools.cache
def small_found() -> Correspondence:
    return decode(small(), plan_patterns(SMALL.projector_px))


@pytest.mark.parametrize("name", SMALL_NAMES)
def test_every_missing_photograph_is_named_by_a_step_that_needs_it(name: str) -> None:
    plan = plan_patterns(SMALL.projector_px)
    captures = {key: image for key, image in small().items() if key != name}
    steps = (
        lambda: decode(captures, plan),
        lambda: fit_pixels(captures, plan, small_found()),
        lambda: measure_radiometry(captures, plan),
    )
    refusals = [error for step in steps if (error := refusal(step)) is not None]
    assert all(error.code == "capture-missing" and name in error.what for error in refusals)
    assert bool(refusals) == (not name.startswith("random"))


def refusal(step: Callable[[], object]) -> VelaturaError | None:
    """What a step raises, or None."""
    try:
        step()
    except VelaturaError as error:
        return error
    return None


@settings(max_examples=12, deadline=None)
@given(
    name=st.sampled_from([key for key in SMALL_NAMES if key.startswith(("gray", "phase", "blur", "black"))]),
    value=st.sampled_from([0.0, 1.0, float("nan")]),
)
def test_a_black_saturated_or_unmeasured_photograph_is_refused_or_costs_pixels_but_misplaces_none(
    name: str, value: float
) -> None:
    plan = plan_patterns(SMALL.projector_px)
    captures = {**small(), name: np.full_like(small()[name], value)}
    refused = refusal(lambda: decode(captures, plan))
    if refused is not None:
        assert refused.code == "captures-inconsistent"
        return
    found = decode(captures, plan)
    metapixels = fit_pixels(captures, plan, found).metapixels
    assert np.all(np.abs(found.projector_px - positions(SMALL))[found.valid] < 0.5)
    off = (metapixels.centre_px - SMALL.true_centres())[metapixels.valid]
    assert np.all(np.isfinite(metapixels.covariance_px2[metapixels.valid]))
    assert off.size == 0 or np.sqrt(np.mean(off**2)) < 0.1


@settings(max_examples=12, deadline=None)
@given(
    name=st.sampled_from([key for key in SMALL_NAMES if key.startswith(("gray", "phase", "blur", "black"))]),
    row=st.integers(0, 80),
    column=st.integers(0, 110),
    side=st.integers(1, 20),
)
def test_saturated_patches_change_nothing_beyond_their_reach(name: str, row: int, column: int, side: int) -> None:
    plan = plan_patterns(SMALL.projector_px)
    image = small()[name].copy()
    image[row : row + side, column : column + side] = np.nan
    captures = {**small(), name: image}
    found = decode(captures, plan)
    fit = fit_pixels(captures, plan, found)
    assert np.all(np.isfinite(found.projector_px[found.valid]))
    far = np.ones(found.valid.shape, bool)
    rows, columns = (slice(max(at - REACH_PX, 0), at + side + REACH_PX) for at in (row, column))
    far[rows, columns] = False
    assert np.mean(found.valid[far] == small_found().valid[far]) > 0.99
    both = far & found.valid & small_found().valid
    np.testing.assert_allclose(found.projector_px[both], small_found().projector_px[both], atol=0.02)
    assert np.all(np.abs(found.projector_px - positions(SMALL))[found.valid] < 0.5)
    off = (fit.metapixels.centre_px - SMALL.true_centres())[fit.metapixels.valid]
    assert np.sqrt(np.mean(off**2)) < 0.1
