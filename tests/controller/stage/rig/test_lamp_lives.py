"""Random lives of a lamp: whatever happens, and whatever fails, no rule is broken (tests/campaigns/lamp_lives.py)."""

from __future__ import annotations

import pytest

from controller.stage.rig.lamp_guard import LampGuard
from tests.campaigns.lamp_lives import lived

SHORT = 10_000
"""Fifty times as many as find a guard without a rest."""


def test_no_random_life_breaks_a_rule() -> None:
    strikes = refusals = 0
    for seed in range(SHORT):
        life = lived(seed)
        assert not life.lamp.sins, (seed, life.lamp.sins)
        strikes += life.lamp.strikes
        refusals += life.guard.rest_left_s() > 0
    # The rules must not hold because nothing ever happens.
    assert strikes > SHORT
    assert refusals > SHORT / 20


def test_the_random_lives_would_find_a_guard_that_forgets(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(LampGuard, "rest_left_s", lambda self: 0.0)
    assert any(lived(seed).lamp.sins for seed in range(200))
