from __future__ import annotations

import numpy as np
import pytest

from controller.core.arrays import FloatImage
from controller.core.errors import CalibrationError
from controller.optics.calibrate.verify.grade import Grade, verify
from controller.optics.capture.profile import CameraNoise
from controller.optics.capture.raw import develop

RGGB = np.array([[0, 1], [1, 2]])
RANDOM = np.random.default_rng(11)
BLACK = np.full((80, 100, 3), 0.01, np.float32)
SEEN = BLACK + RANDOM.uniform(0.1, 0.9, BLACK.shape).astype(np.float32)
ALL = np.ones(BLACK.shape[:2], np.bool_)


@pytest.mark.parametrize(("error", "grade"), [(0.01, Grade.A), (0.03, Grade.B), (0.06, Grade.C), (0.2, Grade.D)])
def test_the_grade_follows_the_relative_error(error: float, grade: Grade) -> None:
    light = SEEN - BLACK
    noise = RANDOM.standard_normal(light.shape).astype(np.float32)
    predicted = SEEN + np.float32(error * np.sqrt(np.mean(light**2))) * noise
    found = verify(predicted, SEEN, BLACK, ALL)
    assert found.relative_rms == pytest.approx(error, rel=0.05)
    assert found.grade is grade


@pytest.mark.parametrize(("error", "grade"), [(0.014, Grade.A), (0.035, Grade.B)])
def test_the_noise_of_a_10_bit_camera_is_not_the_calibration_s_error(error: float, grade: Grade) -> None:
    """Samples of ten bits, developed; the error is smooth, the noise is larger than it."""
    rows, columns = 300, 400
    y, x = np.mgrid[0:rows, 0:columns].astype(np.float32)
    light = (0.15 + 0.1 * np.sin(x / 9) * np.cos(y / 7))[..., None] * np.array([0.8, 1.0, 0.7], np.float32)
    off = np.sin(x / 31 + y / 23)[..., None] * np.sqrt(2) * error * np.sqrt(np.mean(light**2))
    noise = CameraNoise(1 / 2_500, 1.5 / 1023)
    mosaic = np.empty((rows, columns))
    for row, column in np.ndindex(2, 2):
        mosaic[row::2, column::2] = light[row::2, column::2, RGGB[row, column]]
    mosaic += np.random.default_rng(3).normal(0, np.sqrt(noise.shot * mosaic + noise.read**2 - 1 / 12 / 1023**2))
    samples = np.rint(64 + (1023 - 64) * mosaic).clip(0, 1023).astype(np.uint16)
    seen = develop(samples, RGGB, np.full((2, 2), 64.0), np.full((2, 2), 1023.0)).image
    black, everywhere = np.zeros_like(seen), np.ones((rows, columns), np.bool_)
    predicted = np.asarray(light + off, np.float32)
    found = verify(predicted, seen, black, everywhere, noise.variance(seen, interpolated=True))
    assert found.relative_rms == pytest.approx(error, abs=0.004)
    assert found.grade is grade
    as_seen = verify(predicted, seen, black, everywhere).relative_rms
    assert as_seen > 0.04, "which would be refused"
    assert found.noise_rms == pytest.approx(np.sqrt(as_seen**2 - error**2), rel=0.05)
    assert np.nanmedian(found.error_map) < 1.5 * error


def test_a_dimmed_lamp_shows_as_gain_and_not_as_shape() -> None:
    found = verify(BLACK + (SEEN - BLACK) / 0.9, SEEN, BLACK, ALL)
    np.testing.assert_allclose(found.gain, 0.9, rtol=1e-5)
    assert found.relative_rms == pytest.approx(1 / 0.9 - 1, rel=1e-4)
    assert found.without_gain_rms < 1e-5


def test_the_map_shows_where_the_error_is() -> None:
    predicted = SEEN.copy()
    predicted[20:40, 50:70] *= 1.3
    found = verify(predicted, SEEN, BLACK, ALL)
    assert np.nanmin(found.error_map[28:32, 58:62]) > 0.2
    assert np.nanmax(found.error_map[60:, :30]) < 0.01


def test_what_is_outside_the_mask_or_not_measured_does_not_count() -> None:
    predicted, seen, mask = SEEN.copy(), SEEN.copy(), ALL.copy()
    predicted[:10] = 7.0
    mask[:10] = False
    seen[50:60] = np.nan
    found = verify(predicted, seen, BLACK, mask)
    assert found.relative_rms < 1e-6
    assert np.all(np.isnan(found.error_map[:10]))


@pytest.mark.parametrize("seen", [BLACK, np.full_like(BLACK, np.nan)])
def test_a_photograph_without_light_is_refused(seen: FloatImage) -> None:
    with pytest.raises(CalibrationError) as caught:
        verify(SEEN, seen, BLACK, ALL)
    assert caught.value.code == "verification-dark"


def test_a_photograph_of_another_size_is_refused() -> None:
    with pytest.raises(CalibrationError) as caught:
        verify(SEEN[:-1], SEEN, BLACK, ALL)
    assert caught.value.code == "verification-shape-wrong"
