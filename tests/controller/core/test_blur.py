"""A wide Gaussian, against SciPy's."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.ndimage import gaussian_filter

from controller.core.blur import gaussian_blur


@pytest.mark.parametrize("sigma_px", [1.0, 7.5, 9.0, 16.0, 32.0, 81.0])
def test_it_is_the_gaussian_of_a_step_within_one_percent(sigma_px: float) -> None:
    image = np.zeros((301, 517), np.float32)
    image[90:, 200:] = 1.0
    expected = gaussian_filter(image.astype(np.float64), sigma_px, mode="mirror", truncate=6)
    assert np.abs(gaussian_blur(image, sigma_px) - expected).max() < 0.01


@given(
    shape=st.tuples(st.integers(1, 60), st.integers(1, 60)),
    channels=st.sampled_from([(), (1,), (2,), (3,)]),
    sigma_px=st.floats(0.3, 100.0),
    value=st.floats(-10.0, 10.0, width=32),
)
def test_even_light_stays_as_it_is(
    shape: tuple[int, int], channels: tuple[int, ...], sigma_px: float, value: float
) -> None:
    image = np.full((*shape, *channels), value, np.float32)
    out = gaussian_blur(image, sigma_px)
    assert out.shape[:2] == shape
    assert np.allclose(out, value, rtol=1e-4, atol=1e-5)


@given(seed=st.integers(0, 2**32 - 1), sigma_px=st.floats(8.0, 40.0))
def test_it_stays_within_what_was_there_and_keeps_the_mean(seed: int, sigma_px: float) -> None:
    image = np.random.default_rng(seed).random((97, 133), np.float32)
    out = gaussian_blur(image, sigma_px)
    assert image.min() <= out.min() <= out.max() <= image.max()
    assert abs(out.mean() - image.mean()) < 0.02
