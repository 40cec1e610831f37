"""The white image from the steps of sinusoids, against a light that is known."""

from __future__ import annotations

import numpy as np
import pytest

from controller.core.arrays import FloatImage
from controller.optics.calibrate.photometry.separation import WhiteSums

SHAPE = (60, 80, 3)
COUNT = 4


def paint() -> FloatImage:
    y, x = np.mgrid[0 : SHAPE[0], 0 : SHAPE[1]]
    one = 0.1 + 0.9 * ((x // 9 + y // 7) % 2)
    return np.stack([one, 0.7 * one, 0.4 + 0.2 * one], axis=2).astype(np.float32)


def photographed(truth: FloatImage, noise: float, seed: int) -> FloatImage:
    return (truth * (1 + noise * np.random.default_rng(seed).standard_normal(truth.shape))).astype(np.float32)


def averaged(white: FloatImage, *, noise: float = 0.01, brightness: tuple[float, ...] = (1.0, 1.0, 1.0)) -> FloatImage:
    sums = WhiteSums()
    for seed in range(COUNT):
        sums.add(photographed(paint(), noise, seed) * np.array(brightness, np.float32))
    return sums.averaged(white)


def error(image: FloatImage) -> float:
    return float(np.std(image / paint() - 1))


@pytest.mark.parametrize(("white_noise", "noise"), [(0.01, 0.01), (0.02, 0.01), (0.002, 0.01)])
def test_noise_is_nearly_the_least_that_there_can_be(white_noise: float, noise: float) -> None:
    least = (white_noise**-2 + COUNT * noise**-2) ** -0.5
    found = error(averaged(photographed(paint(), white_noise, 9), noise=noise))
    assert least * 0.9 < found < 1.1 * least


def test_it_is_as_bright_as_white_in_each_channel() -> None:
    """The lamp may have been stronger, and the response by which steps are shown is not known well."""
    white = photographed(paint(), 0.01, 9)
    found = averaged(white, brightness=(1.03, 0.98, 1.01))
    np.testing.assert_allclose((found / paint()).mean(axis=(0, 1)), (white / paint()).mean(axis=(0, 1)), atol=2e-3)
    assert error(found) < 0.6 * error(white)


def test_saturated_steps_leave_white_as_it_is() -> None:
    white, sums = photographed(paint(), 0.01, 9), WhiteSums()
    for seed in range(COUNT):
        one = photographed(paint(), 0.01, seed)
        one[:20] = np.nan
        sums.add(one)
    found = sums.averaged(white)
    np.testing.assert_array_equal(found[:20], white[:20])
    assert np.std(found[30:] / paint()[30:]) < 0.6 * np.std(white[30:] / paint()[30:])


def test_unknown_white_stays_unknown() -> None:
    white = photographed(paint(), 0.01, 9)
    white[5, 6] = np.nan
    found = averaged(white)
    assert np.isnan(found[5, 6]).all()
    assert np.isfinite(np.delete(found.reshape(-1, 3), 5 * SHAPE[1] + 6, axis=0)).all()


def test_without_sums_white_is_itself() -> None:
    white = photographed(paint(), 0.01, 9)
    assert WhiteSums().averaged(white) is white
    one = WhiteSums()
    one.add(white)
    assert one.averaged(white) is white


def test_exact_pictures_change_nothing() -> None:
    np.testing.assert_allclose(averaged(paint(), noise=0.0), paint(), rtol=1e-5)
