from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from controller.core.arrays import Float64
from controller.core.errors import CalibrationError, UsageError
from controller.optics.capture.jpeg_response import measure_response, nominal_response

EXPOSURES_S = tuple(2.0**stop for stop in range(-7, 1))
ALONE = slice(8, 250)


def scene(rows: int = 300, columns: int = 400) -> Float64:
    """Smooth light over two and a half decades, of a colour that changes."""
    noise = np.random.default_rng(0).standard_normal((rows, columns, 3)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 12)
    return np.asarray(np.exp(1.3 * smooth / smooth.std()) * 1.5, np.float64)


def curve(linear: Float64) -> Float64:
    """A camera's: gamma with a toe, and an S for contrast."""
    value = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 1e-9) ** (1 / 2.4) - 0.055)
    return np.asarray(value + 0.3 * value * (1 - value) * (2 * value - 1))


def inverse() -> Float64:
    grid = np.linspace(0, 1, 100_001)
    return np.asarray(np.interp(np.arange(256) / 255, curve(grid), grid))


def taken(exposure_s: float, seed: int, *, quality: int = 95) -> npt.NDArray[np.uint8]:
    signal = scene() * exposure_s
    noisy = signal + np.random.default_rng(seed).normal(0, 1, signal.shape) * np.sqrt(signal / 20_000 + 1e-7)
    values = np.rint(255 * curve(np.clip(noisy, 0, 1))).astype(np.uint8)
    done, data = cv2.imencode(".jpg", values[:, :, ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality,
                                                           cv2.IMWRITE_JPEG_SAMPLING_FACTOR, 0x111111])  # fmt: skip
    assert done
    return np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR_RGB), np.uint8)


@pytest.fixture(scope="module")
def series() -> list[npt.NDArray[np.uint8]]:
    return [taken(exposure_s, n) for n, exposure_s in enumerate(EXPOSURES_S)]


def test_a_hidden_tone_curve_is_found_to_a_percent(series: list[npt.NDArray[np.uint8]]) -> None:
    found = measure_response(series, EXPOSURES_S)
    ratio = found.table[:, ALONE] / inverse()[ALONE]
    assert np.all(np.abs(ratio / np.median(ratio) - 1)[:, 40:] < 0.02)
    assert np.sqrt(np.mean((found.table - inverse()) ** 2)) < 0.006
    assert found.misfit < 0.2


def test_the_curves_never_fall_and_end_together(series: list[npt.NDArray[np.uint8]]) -> None:
    table = measure_response(series, EXPOSURES_S).table
    assert np.all(np.diff(table, axis=1) > 0)
    np.testing.assert_array_equal(table[:, 0], 0)
    np.testing.assert_allclose(table[:, 255], 1)


def test_opencvs_debevec_finds_the_same_curve_less_exactly(series: list[npt.NDArray[np.uint8]]) -> None:
    cv2.setRNGSeed(0)
    times = np.array(EXPOSURES_S, np.float32)
    theirs = cv2.createCalibrateDebevec(samples=400, lambda_=10.0).process(series, times)[:, 0, :].T.astype(np.float64)
    ours = measure_response(series, EXPOSURES_S).table
    middle = slice(40, 220)
    log_ours, log_theirs, truth = (np.log(table[..., middle]) for table in (ours, theirs, inverse()))
    apart = log_ours - log_theirs
    assert np.all(np.std(apart, axis=1) < 0.03)
    # Each channel of theirs has a scale of its own, so shapes are compared.
    errors = [np.std(log - truth, axis=1).mean() for log in (log_ours, log_theirs)]
    assert errors[0] < errors[1]


def test_a_channel_without_light_takes_its_curve_from_the_others(series: list[npt.NDArray[np.uint8]]) -> None:
    dim = [image.copy() for image in series]
    for image, exposure_s in zip(dim, EXPOSURES_S, strict=True):
        image[:, :, 2] = np.rint(255 * curve(np.clip(0.1 * scene()[:, :, 2] * exposure_s, 0, 1)))
    table = measure_response(dim, EXPOSURES_S).table
    assert np.all(np.abs(table[2] - inverse())[ALONE] < 0.02)


def test_series_that_tell_nothing_or_contradict_themselves_are_refused(series: list[npt.NDArray[np.uint8]]) -> None:
    flat = [np.full((50, 50, 3), value, np.uint8) for value in (10, 100, 200)]
    with pytest.raises(CalibrationError) as unseen:
        measure_response(flat, (0.1, 0.2, 0.4))
    assert unseen.value.code == "response-unseen"
    moved = [np.roll(image, 60 * n, axis=1) for n, image in enumerate(series)]
    with pytest.raises(CalibrationError) as moving:
        measure_response(moved, EXPOSURES_S)
    assert moving.value.code == "response-inconsistent"
    for images, times in (([], ()), (series[:1], (1.0,)), (series[:2], (1.0, 0.0))):
        with pytest.raises(UsageError):
            measure_response(images, times)


def test_the_nominal_response_is_srgb() -> None:
    table = nominal_response()
    assert table.shape == (3, 256)
    assert table[0, 128] == pytest.approx(0.2158605, rel=1e-5)
