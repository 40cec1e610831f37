"""The reachable range, and exposures chosen from it."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from controller.core.errors import UsageError, WorkError
from controller.optics.calibrate.values import Calibration
from controller.optics.solve.reach.drive_levels import DriveLevels
from controller.optics.solve.reach.feasibility import (
    Feasibility,
    expose_target,
    exposures,
    feasibility,
    target_radiance,
)
from controller.optics.transport import build_transport

Stage = Callable[..., Calibration]


def drive_of(calibration: Calibration) -> DriveLevels:
    return DriveLevels.of_transport(build_transport(calibration))


@settings(max_examples=10, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture], derandomize=True)
@given(seed=st.integers(0, 1000), share=st.floats(0.05, 1.0))
def test_at_the_chosen_exposure_the_stated_share_is_bright_enough_and_no_brighter_one_does(
    stage: Stage, seed: int, share: float
) -> None:
    calibration = stage(seed)
    transport = build_transport(calibration)
    drive = DriveLevels.of_transport(transport)
    target = np.random.default_rng(seed).random((*transport.camera_shape, 3)).astype(np.float32)
    exposure = exposures(drive, target, calibration.black, share)[0]
    within, beyond = (
        feasibility(drive, target_radiance(target, calibration.black, e), calibration.black, margin=1e-5)
        for e in (exposure, exposure * 1.02)
    )

    def bright_enough(found: Feasibility) -> float:
        enough: float = (~found.too_bright[transport.object_mask]).mean()
        return enough

    assert bright_enough(within) >= share - 1e-9
    assert bright_enough(beyond) < bright_enough(within)


@settings(max_examples=10, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture], derandomize=True)
@given(colour=st.tuples(*[st.floats(0, 1)] * 3))
def test_what_all_projectors_make_together_is_within_reach_and_a_little_more_is_not(
    stage: Stage, colour: tuple[float, float, float]
) -> None:
    """Through T itself: the same colour on all projectors is driven by just that colour, crosstalk and all."""
    calibration = stage()
    transport = build_transport(calibration)
    drive = DriveLevels.of_transport(transport)
    frames = [np.broadcast_to(np.array(colour, np.float32), (*size, 3)).copy() for size in transport.sizes]
    light = transport.forward(frames)
    mask = transport.object_mask
    found = feasibility(drive, light + calibration.black, calibration.black)
    assert found.reachable[mask].all()
    full = transport.forward([np.ones_like(frame) for frame in frames])
    levels = drive.of(light + np.float32(1.01) * full)[mask]
    np.testing.assert_allclose(levels, np.array(colour) + 1.01 + np.zeros((int(mask.sum()), 3)), atol=1e-3)
    assert feasibility(drive, light + 1.01 * full + calibration.black, calibration.black).too_bright[mask].all()


def test_a_colour_purer_than_the_projectors_primaries_is_out_of_reach(stage: Stage) -> None:
    calibration = stage()
    transport = build_transport(calibration)
    drive = DriveLevels.of_transport(transport)
    red = transport.reach() * np.array([0.5, 0, 0], np.float32)
    found = feasibility(drive, red + calibration.black, calibration.black)
    assert not found.reachable.any()
    assert found.too_dark[transport.object_mask].all()
    assert not found.too_bright.any()


def test_the_feasibility_map_says_what_is_missing_and_what_is_too_much(stage: Stage) -> None:
    calibration = stage()
    transport = build_transport(calibration)
    drive = DriveLevels.of_transport(transport)
    reach = transport.reach()
    target = calibration.black + 0.5 * reach
    target[30, 40] = calibration.black[30, 40] + 1.25 * reach[30, 40]
    target[31, 41] = calibration.black[31, 41] - 0.1 * reach[31, 41]
    result = feasibility(drive, target, calibration.black)
    np.testing.assert_allclose(drive.of(target - calibration.black)[30, 40], 1.25, rtol=1e-3)
    assert (np.argwhere(result.too_bright).tolist(), np.argwhere(result.too_dark).tolist()) == ([[30, 40]], [[31, 41]])
    assert not result.reachable[30, 40]
    assert result.reachable[29, 39]


def test_a_radiance_is_never_below_the_black_image(stage: Stage) -> None:
    calibration = stage()
    radiance = target_radiance(np.zeros_like(calibration.black), calibration.black, 0.7)
    np.testing.assert_array_equal(radiance, calibration.black)


def test_a_black_target_has_no_exposure(stage: Stage) -> None:
    calibration = stage()
    with pytest.raises(WorkError) as failed:
        exposures(drive_of(calibration), np.zeros_like(calibration.black), calibration.black)
    assert failed.value.code == "no-light"


def test_a_share_outside_zero_to_one_is_refused(stage: Stage) -> None:
    calibration = stage()
    with pytest.raises(UsageError) as refused:
        exposures(drive_of(calibration), calibration.black, calibration.black, share=0)
    assert refused.value.code == "share-out-of-range"


def test_pixels_without_light_in_a_channel_do_not_bear_on_the_exposure(stage: Stage) -> None:
    calibration = stage()
    dark = [dataclasses.replace(p, white=p.white.copy()) for p in calibration.projectors]
    for part in dark:
        part.white[10:20, 10:20, 2] = 0
    transport = build_transport(dataclasses.replace(calibration, projectors=tuple(dark)))
    drive = DriveLevels.of_transport(transport)
    target = np.full((*transport.camera_shape, 3), 0.5, np.float32)
    exposure = exposures(drive, target, calibration.black)[0]
    found = feasibility(drive, target_radiance(target, calibration.black, exposure), calibration.black)
    assert 0 < exposure < np.inf
    assert not found.reachable[10:20, 10:20].any()
    assert found.share > 0.9


@pytest.mark.parametrize(("dark", "held_back"), [(0.15, 5.0), (0.05, 1.0), (0.0, 1.0)])
def test_a_small_dark_part_that_decides_the_exposure_is_told(stage: Stage, dark: float, held_back: float) -> None:
    calibration = stage(albedo_from=0.85)
    columns = round(dark * calibration.black.shape[1])
    for part in calibration.projectors:
        part.white[:] = part.white.mean(axis=(0, 1))
        part.white[:, :columns] *= 0.2
    transport = build_transport(calibration)
    drive = DriveLevels.of_transport(transport)
    found = expose_target(drive, np.ones_like(calibration.black), calibration.black, share=0.9)
    assert found.held_back == pytest.approx(held_back, rel=0.1)
