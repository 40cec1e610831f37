"""The finest wave of projectors, against SciPy's bounded least squares and what must hold for any optics."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import lsq_linear

from controller.optics.plan.figures import LineProjector, finest_wave, kept_contrast, last_kept, solved

BRIGHT = 2.0


def test_levels_are_those_of_bounded_least_squares() -> None:
    rng = np.random.default_rng(3)
    lights = [np.abs(rng.normal(size=(24, count))) * (rng.random((24, count)) < 0.3) for count in (7, 5)]
    wanted = rng.uniform(0, 3, (2, 24))
    smoothness = 0.05
    light = np.hstack(lights)
    own = np.concatenate([one.T @ one.sum(axis=1) for one in lights])
    rough = np.sqrt(smoothness * own[own > 0].mean()) * np.delete(np.diff(np.eye(12), axis=0), 6, axis=0)
    for row, found in zip(wanted, solved(lights, wanted, smoothness), strict=True):
        best = lsq_linear(np.vstack((light, rough)), np.concatenate((row, np.zeros(len(rough)))), (0, 1), tol=1e-12)
        np.testing.assert_allclose(found, best.x, atol=2e-3)


def test_one_projector_ends_at_half_a_cycle_and_three_sharp_ones_go_on() -> None:
    sharp = LineProjector(1.0, 0.35, BRIGHT)
    first, every = finest_wave([sharp]), finest_wave([sharp] * 3)
    assert first == pytest.approx(0.5, abs=0.03)
    assert every / first >= 1.4
    blurred = LineProjector(1.0, 0.7, BRIGHT)
    assert finest_wave([blurred] * 3) / finest_wave([blurred]) < 1.2


@pytest.mark.parametrize(
    ("alone", "coarse"),
    [((0.67, 1.86), (1.45, 0.5, 1.53)), ((0.45, 0.73), (1.69, 0.43, 0.28)), ((0.45, 1.49), (2.52, 0.48, 0.56))],
)
def test_a_coarse_projector_beside_a_sharp_one_makes_no_wave_coarser(
    alone: tuple[float, float], coarse: tuple[float, float, float]
) -> None:
    sharp = LineProjector(1.0, *alone)
    first, both = finest_wave([sharp]), finest_wave([sharp, LineProjector(*coarse)])
    assert first <= 0.5
    assert both >= first


@settings(max_examples=5, deadline=None)
@given(st.floats(0.2, 0.7), st.floats(1.2, 4.0))
def test_more_projectors_lose_no_contrast_and_more_blur_gains_none(blur_px: float, light: float) -> None:
    frequencies = np.array([0.35, 0.55])
    one = kept_contrast([LineProjector(1.0, blur_px, light)], frequencies)
    four = kept_contrast([LineProjector(1.0, blur_px, light)] * 4, frequencies)
    softer = kept_contrast([LineProjector(1.0, blur_px + 0.3, light)] * 4, frequencies)
    assert np.all(four >= one - 0.05)
    assert np.all(softer <= four + 0.05)


def test_the_limit_lies_between_the_last_that_is_kept_and_the_first_that_is_not() -> None:
    frequencies = np.array([0.2, 0.4, 0.6, 0.8])
    assert last_kept(frequencies, np.array([1.0, 0.75, 0.25, 0.9])) == pytest.approx(0.5)
    assert last_kept(frequencies, np.array([1.0, np.nan, 0.25, 0.1])) == pytest.approx(0.2 + 0.4 * 0.5 / 0.75)
    assert last_kept(frequencies, np.ones(4)) == 0.8
    assert last_kept(frequencies, np.zeros(4)) == 0.2
