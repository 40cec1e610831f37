"""A panel that makes levels by turns, against its light moment by moment."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lab.emulated.effects import mean_light, seen_of_turns

RAMP = np.tile(np.linspace(0.0, 1.0, 64, dtype=np.float32)[:, None, None], (1, 8, 3))


@given(st.floats(0, 100), st.floats(0.01, 40), st.integers(1, 9))
def test_the_share_of_each_turn_is_its_time(start: float, frames: float, turns: int) -> None:
    moments = start + frames * (np.arange(20000) + 0.5) / 20000
    counted = np.bincount(np.floor(moments).astype(int) % turns, minlength=turns) / 20000
    np.testing.assert_allclose(seen_of_turns(turns, start, frames), counted, atol=3e-4)


@pytest.mark.parametrize("start", [0.0, 0.37])
def test_whole_rounds_show_the_level_that_was_asked_for(start: float) -> None:
    found = mean_light(RAMP, levels=33, turns=8, start=start, frames=16.0)
    np.testing.assert_allclose(found, RAMP, atol=0.5 / 32 / 8 + 1e-6)


def test_short_exposures_see_two_levels_and_longer_ones_less_of_them() -> None:
    one = mean_light(RAMP, levels=33, turns=8, start=0.2, frames=0.5)
    np.testing.assert_allclose(one * 32, np.rint(one * 32), atol=1e-4)
    assert np.abs(one - RAMP).max() > 0.5 / 32
    errors = [np.abs(mean_light(RAMP, levels=33, turns=8, start=0.2, frames=f) - RAMP).mean() for f in (0.5, 3.5, 20.5)]
    assert errors[0] > errors[1] > errors[2]
    assert mean_light(RAMP, levels=33, turns=8, start=0.2, frames=0.5)[:, 0].std() > 0  # adjacent pixels take turns
    assert (one[:, 0] != one[:, 1]).any()
