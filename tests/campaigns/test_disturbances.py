"""A short campaign in every test run; the long one is started by hand (tests/campaigns/disturbances.py)."""

from __future__ import annotations

from tests.campaigns.disturbances import KINDS, refined


def test_no_disturbance_of_a_refining_makes_a_result_worse() -> None:
    outcomes = [refined(seed) for seed in range(16, 16 + len(KINDS))]
    assert {one.kind for one in outcomes} == set(KINDS)
    assert not [one for one in outcomes if one.worse]
    assert any(one.after < one.before - 0.1 for one in outcomes), "what is not disturbed is corrected"
