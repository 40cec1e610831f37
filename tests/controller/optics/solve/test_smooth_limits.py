"""Sheets over obstacles: above what is wide enough, lowest of those, smooth, and on the object alone."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import lsq_linear

from controller.optics.solve.reach.adaptation import SmoothLimits, _quantile, lowest_above


def test_a_sheet_lies_on_wide_obstacles_falls_off_beside_them_and_leaves_out_narrow_ones() -> None:
    mask = np.ones((200, 400), np.bool_)
    need = np.zeros((200, 400), np.float32)
    need[80:120, 80:120] = 1.0
    need[:, 330:331] = 5.0
    limit = SmoothLimits.on(mask).above(need)
    assert limit[90:110, 90:110].min() > 0.99
    fall = limit[100, 125:240]
    assert (np.diff(fall) <= 1e-5).all()
    assert fall[-1] < 0.02
    assert limit[:, 331].max() < 0.02


def test_objects_apart_do_not_limit_each_other() -> None:
    mask = np.zeros((200, 400), np.bool_)
    mask[:, :180], mask[:, 220:] = True, True
    need = np.zeros((200, 400), np.float32)
    need[:, 150:180] = 1.0
    limit = SmoothLimits.on(mask).above(need)
    assert limit[100, 170] > 0.95
    assert limit[:, 220:].max() < 1e-6
    assert (limit[~mask] == 0).all()


def test_nothing_is_limited_where_nothing_is_needed() -> None:
    mask = np.ones((50, 60), np.bool_)
    assert not SmoothLimits.on(mask).above(np.zeros((50, 60), np.float32)).any()


@settings(max_examples=25, deadline=None, derandomize=True)
@given(seed=st.integers(0, 10_000), length=st.floats(0.3, 6.0), share=st.floats(0.05, 0.9))
def test_the_sheet_is_the_one_of_least_energy(seed: int, length: float, share: float) -> None:
    """Against SciPy's bounded least squares: h'Ah with h at least the obstacle is |Ch|^2 with A = C'C."""
    random = np.random.default_rng(seed)
    size = 40
    obstacle = np.where(random.random(size) < share, random.random(size), 0.0)
    steps = sp.csr_matrix(np.diff(np.eye(size), axis=0))
    stiffness = sp.csr_matrix(sp.identity(size) + length**2 * (steps.T @ steps))
    found = lowest_above(stiffness, obstacle)
    root = np.linalg.cholesky(stiffness.toarray()).T
    expected = lsq_linear(root, np.zeros(size), bounds=(obstacle, np.inf), tol=1e-12).x
    np.testing.assert_allclose(found, expected, atol=1e-4)
    assert (found >= obstacle - 1e-9).all()


@given(st.integers(0, 10_000), st.sampled_from((0.0, 0.5, 0.95, 1.0)))
@settings(max_examples=40, deadline=None)
def test_the_quantile_of_each_cell_is_numpys(seed: int, share: float) -> None:
    rng = np.random.default_rng(seed)
    values = rng.normal(size=(7, 12)).astype(np.float32)
    counted = rng.random((7, 12)) > 0.4
    counted[:, 0] = True
    expected = np.nanquantile(np.where(counted, values, np.nan).astype(np.float64), share, axis=1)
    np.testing.assert_allclose(_quantile(values, counted, share), expected, rtol=1e-6, atol=1e-6)
