from __future__ import annotations

import numpy as np
import pytest

from controller.core.arrays import FloatImage
from controller.optics.capture.profile import measure_noise
from tests.controller.optics.capture.sensor_model import SensorModel, textured


def linear(model: SensorModel, exposure_s: float, seed: int) -> FloatImage:
    samples = model.expose(textured(), exposure_s, seed).samples
    values = (samples.astype(np.float32) - 128) / np.float32(3967)
    return np.where(values < 0.98, values, np.nan).astype(np.float32)


@pytest.mark.parametrize("electrons", [2.0, 9.0])
@pytest.mark.parametrize("second_s", [0.02, 0.16])
def test_shot_and_read_noise_are_found_from_a_pair_of_any_exposures(electrons: float, second_s: float) -> None:
    model = SensorModel(electrons=electrons, read_e=25.0)
    report = measure_noise([(linear(model, 0.02, 1), linear(model, second_s, 2))])
    assert report is not None
    assert report.noise.shot == pytest.approx(model.shot, rel=0.06)
    rounding = 1 / 12**0.5 / 3967
    assert report.noise.read == pytest.approx(np.hypot(model.read, rounding), rel=0.15)
    assert 0.8 < report.misfit < 1.1


def test_a_lamp_that_changed_in_between_and_a_moved_edge_do_no_harm() -> None:
    model = SensorModel()
    first, second = linear(model, 0.02, 1), 1.07 * linear(model, 0.02, 2)
    second[:60, :60] = np.roll(second[:60, :60], 3, axis=1)
    report = measure_noise([(first, second)])
    assert report is not None
    assert report.noise.shot == pytest.approx(model.shot, rel=0.15)


def test_pictures_that_are_dark_or_saturated_tell_nothing() -> None:
    nothing = np.full((64, 64), np.nan, np.float32)
    assert measure_noise([]) is None
    assert measure_noise([(nothing, nothing)]) is None
    constant = np.zeros((200, 200), np.float32)
    assert measure_noise([(constant, constant)]) is None
