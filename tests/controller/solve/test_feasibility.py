"""The reachable range, and exposures chosen from it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from controller.calibrate.values import Calibration
from controller.errors import UsageError, WorkError
from controller.solve.feasibility import choose_exposure, feasibility, target_radiance
from controller.transport import LightTransport

Stage = Callable[..., Calibration]


@settings(max_examples=10, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture], derandomize=True)
@given(seed=st.integers(0, 1000), share=st.floats(0.05, 1.0))
def test_at_the_chosen_exposure_the_stated_share_is_reachable_and_no_brighter_one_does(
    stage: Stage, seed: int, share: float
) -> None:
    calibration = stage(seed)
    transport = LightTransport.build(calibration)
    target = np.random.default_rng(seed).random((*transport.shape, 3)).astype(np.float32)
    exposure = choose_exposure(transport, target, calibration.black, share=share)
    within, beyond = (
        feasibility(transport, target_radiance(target, calibration.black, e), calibration.black, margin=1e-6)
        for e in (exposure, exposure * 1.02)
    )
    assert within.share >= share - 1e-9
    assert beyond.share < within.share


def test_the_feasibility_map_says_what_is_missing_and_what_is_too_much(stage: Stage) -> None:
    calibration = stage()
    transport = LightTransport.build(calibration)
    reach = transport.reach()
    target = calibration.black + 0.5 * reach
    target[30, 40] = calibration.black[30, 40] + reach[30, 40] + 0.25
    target[31, 41] = 0
    result = feasibility(transport, target, calibration.black)
    np.testing.assert_allclose(result.too_bright[30, 40], 0.25, rtol=1e-5)
    np.testing.assert_allclose(result.too_dark[31, 41], calibration.black[31, 41])
    assert not result.reachable[30, 40]
    assert result.reachable[29, 39]
    assert not result.too_bright[29, 39].any()


def test_a_radiance_is_never_below_the_black_image(stage: Stage) -> None:
    calibration = stage()
    radiance = target_radiance(np.zeros_like(calibration.black), calibration.black, 0.7)
    np.testing.assert_array_equal(radiance, calibration.black)


def test_a_black_target_has_no_exposure(stage: Stage) -> None:
    calibration = stage()
    with pytest.raises(WorkError) as failed:
        choose_exposure(LightTransport.build(calibration), np.zeros_like(calibration.black), calibration.black)
    assert failed.value.code == "no-light"


def test_a_share_outside_zero_to_one_is_refused(stage: Stage) -> None:
    calibration = stage()
    with pytest.raises(UsageError) as refused:
        choose_exposure(LightTransport.build(calibration), calibration.black, calibration.black, share=0)
    assert refused.value.code == "share-out-of-range"
