"""What a camera pixel sees of a projector, against sums that are written out with SciPy's erf."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import erf

from plugins.emulated.optics.footprints import KEPT_BYTES, SUBPIXELS, Footprints, LitSamples
from plugins.emulated.optics.rays import BEYOND_PX, SIGMA_STEP_PX

ROWS, COLUMNS, FILL = 7, 9, 0.8


def drawn(seed: int, pixels: int = 40) -> tuple[LitSamples, np.ndarray]:
    """Samples of camera pixels in and just outside a small panel, some in shadow; and a frame."""
    rng = np.random.default_rng(seed)
    starts = np.concatenate([[0], np.cumsum(rng.integers(0, 4, pixels))]).astype(np.int32)
    n = int(starts[-1])
    at_px = rng.uniform(-BEYOND_PX, (COLUMNS - 1 + BEYOND_PX, ROWS - 1 + BEYOND_PX), (n, 2)).astype(np.float32)
    gain = np.where(rng.random(n) < 0.3, 0.0, rng.uniform(0.2, 2.0, n)).astype(np.float32)
    blur = rng.integers(6, 200, n).astype(np.uint8)
    lit = LitSamples(starts, at_px, gain, blur, rng.random((n, 3)).astype(np.float32))
    return lit, rng.random((ROWS, COLUMNS, 3)).astype(np.float32)


def share(at_px: float, pixels: int, sigma_px: float) -> np.ndarray:
    """Of each of a row of blurred pixels, at the middle of the SUBPIXELS-th part in which ``at_px`` lies."""
    at = (np.floor((at_px + 0.5) * SUBPIXELS) + 0.5) / SUBPIXELS - 0.5
    away, half, scale = at - np.arange(pixels), 0.5 * np.sqrt(FILL), np.sqrt(2.0) * sigma_px
    return np.asarray((erf((away + half) / scale) - erf((away - half) / scale)) / (4.0 * half))


@pytest.mark.parametrize("most_bytes", [KEPT_BYTES, 20_000, 0])
@pytest.mark.parametrize("seed", [1, 2])
def test_a_pixel_sees_its_samples_share_of_each_blurred_panel_pixel(seed: int, most_bytes: int) -> None:
    lit, frame = drawn(seed)
    expected = np.zeros((len(lit.starts) - 1, 3))
    for pixel in range(len(expected)):
        for n in range(lit.starts[pixel], lit.starts[pixel + 1]):
            sigma_px = lit.blur[n] * SIGMA_STEP_PX
            down, across = share(lit.at_px[n, 1], ROWS, sigma_px), share(lit.at_px[n, 0], COLUMNS, sigma_px)
            expected[pixel] += lit.gain[n] * lit.albedo[n] * np.einsum("j,i,jic->c", down, across, frame)
    light = Footprints.of(lit, FILL, most_bytes=most_bytes).light(frame)
    # Profiles end after 3.2 sigma, and what is cut off goes to the rest.
    np.testing.assert_allclose(light, expected, atol=4e-3 * expected.max())


@given(st.integers(0, 2**32 - 1), st.integers(0, 60_000))
def test_the_memory_that_it_may_use_changes_light_by_rounding_alone(seed: int, most_bytes: int) -> None:
    lit, frame = drawn(seed, pixels=12)
    some = Footprints.of(lit, FILL, most_bytes=most_bytes)
    assert some.weights.nbytes <= most_bytes
    exact = Footprints.of(lit, FILL, most_bytes=0).light(frame)
    rounding = np.zeros((len(exact), 1))
    rounding[: len(some.steps), 0] = 0.5 * some.steps
    # Each weight is at most half a step off, and no colour of the frame has more light than all of it together.
    allowed = rounding * frame.sum(axis=(0, 1)).max() + 1e-5 * exact + 1e-6
    assert (np.abs(some.light(frame) - exact) <= allowed).all()
    assert some.steps.max(initial=0.0) <= 2e-4
