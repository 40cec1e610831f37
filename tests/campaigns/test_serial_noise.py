"""A short campaign in every test run; the long one is started by hand (tests/campaigns/serial_noise.py)."""

from __future__ import annotations

from tests.campaigns.serial_noise import FAMILIES, run


def test_every_exchange_over_a_bad_line_ends_confirmed_or_with_a_typed_error_in_time() -> None:
    outcomes = run(720, seed=5, pace=4.0)
    assert [outcome.family for outcome in outcomes] == sorted(FAMILIES)
    for outcome in outcomes:
        assert outcome.wrong == [], outcome
        assert outcome.all_ended, outcome
        assert outcome.late_s < 10.0, outcome
        assert outcome.faults > 0
        assert outcome.confirmed > outcome.calls // 4
