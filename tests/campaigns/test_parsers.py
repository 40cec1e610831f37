"""A short campaign in every test run; the long one is started by hand (tests/campaigns/parsers.py)."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.campaigns.parser_targets import Target, targets
from tests.campaigns.parsers import Outcome, once, run


def test_no_parser_crashes_or_lingers_on_malformed_inputs() -> None:
    outcomes = run(600, seed=11, follow=False)
    assert len(outcomes) == 21
    for outcome in outcomes:
        assert outcome.holds, outcome
        assert outcome.inputs >= 600
        assert outcome.grown_mib < 64


def test_the_campaign_would_show_a_crash_and_a_slow_parser() -> None:
    def slow(data: bytes) -> None:
        sum(range(6_000_000))

    for parse in (lambda data: data[10], slow):
        outcome = Outcome("bad")
        once(Target(parse, (b"",)), b"", outcome)
        assert not outcome.holds


@pytest.mark.parametrize("name", targets(Path()))
def test_some_seed_of_every_parser_is_sound(name: str, tmp_path: Path) -> None:
    target = targets(tmp_path)[name]
    sound = 0
    for seed in target.seeds:
        try:
            target.parse(seed)
        except target.refuses:
            continue
        sound += 1
    assert sound > 0 or name == "bundle-header"
