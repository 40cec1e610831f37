"""A short campaign in every test run; the long one is started by hand (tests/campaigns/bundles.py), and judges time."""

from __future__ import annotations

from tests.campaigns.bundles import run


def test_damaged_bundles_are_refused_wherever_the_damage_is() -> None:
    outcome = run(2000, seed=5, every=13)
    assert outcome.wrong == []
    assert outcome.counts["payload"] == 2000
    assert min(outcome.counts.values()) > 1000
