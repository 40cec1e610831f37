"""A short campaign in every test run; the long one is started by hand (tests/campaigns/playing.py)."""

from __future__ import annotations

from tests.campaigns.playing import Found, in_memory, in_windows
from tests.controller.play.display.xorg import HEIGHT, WIDTH


def check(found: Found, swaps: int) -> None:
    assert found.holds, found
    assert found.passed >= swaps


def test_sets_in_memory_are_whole_and_cost_no_memory() -> None:
    check(in_memory(500), 500)


def test_sets_on_real_windows_are_whole_and_cost_no_memory() -> None:
    check(in_windows(40, width=WIDTH, height=HEIGHT, mode="small"), 40)
