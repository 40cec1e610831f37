"""A short campaign in every test run; the long one is started by hand (tests/campaigns/camera_faults.py)."""

from __future__ import annotations

from tests.campaigns.camera_faults import CAMERAS, run


def test_no_picture_is_lost_or_doubled_whatever_befalls_the_camera_and_every_fault_is_told() -> None:
    outcomes = run(96, seed=3)
    assert [outcome.camera for outcome in outcomes] == sorted(CAMERAS)
    for outcome in outcomes:
        assert outcome.wrong == [], outcome
        assert outcome.holds, outcome
        assert outcome.faults > 0
        assert outcome.pictures > outcome.captures // 2
