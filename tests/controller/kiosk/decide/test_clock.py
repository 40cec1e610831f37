from __future__ import annotations

import ctypes
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

from controller.kiosk.decide.clock import TrustedClock, beginning, synchronised
from controller.kiosk.store.event_log import EventLog
from hal.notices import Notice

MAY = 1_778_000_000.0
HOUR_S = 3600.0
DAY_S = 86_400.0


@dataclass
class Clocks:
    """A wall clock that anybody sets, and one that only continues."""

    folder: Path
    wall_s: float = MAY
    passed_s: float = 0.0
    synchronised: bool = False
    log: EventLog = field(init=False)
    trusted: TrustedClock = field(init=False)

    def __post_init__(self) -> None:
        self.boot()

    def boot(self) -> None:
        self.log = EventLog(self.folder / "events.sqlite", wall=lambda: self.wall_s, durable=False)
        self.trusted = TrustedClock(self.log, lambda: self.wall_s, lambda: self.passed_s, lambda: self.synchronised)

    def reboot(self, *, without_s: float = 0.0) -> None:
        self.log.close()
        self.wall_s, self.passed_s = self.wall_s + without_s, 0.0
        self.boot()

    def wait(self, seconds: float) -> float | None:
        self.wall_s, self.passed_s = self.wall_s + seconds, self.passed_s + seconds
        return self.trusted.now()

    def told(self, code: str) -> list[str]:
        return [row.text for row in self.log.after(0) if row.code == code]


@pytest.fixture
def clocks(tmp_path: Path) -> Iterator[Clocks]:
    made = Clocks(tmp_path)
    yield made
    made.log.close()


def test_time_goes_on_as_the_clock_does_and_nothing_is_told(clocks: Clocks) -> None:
    assert [clocks.wait(0.25) for _ in range(3)] == [MAY + 0.25, MAY + 0.5, MAY + 0.75]
    assert clocks.log.after(0) == []


def test_a_clock_that_is_disciplined_by_seconds_is_not_told(clocks: Clocks) -> None:
    clocks.wait(1.0)
    for _ in range(20):
        clocks.wall_s += 10.0
        clocks.wait(0.25)
    assert clocks.told("clock-set") == []


@pytest.mark.parametrize(
    ("by_s", "said"), [(5400.0, "forward by 90 min"), (-5400.0, "back by 90 min"), (-3 * DAY_S, "3 days")]
)
def test_a_clock_that_somebody_sets_is_told_once(clocks: Clocks, by_s: float, said: str) -> None:
    clocks.wait(60.0)
    clocks.wall_s += by_s
    clocks.wait(0.25)
    clocks.wait(0.25)
    (told,) = clocks.told("clock-set")
    assert said in told
    assert ("The schedule waits" in told) is (by_s == -5400.0)


def test_set_back_a_little_time_stands_still_until_the_clock_has_caught_up(clocks: Clocks) -> None:
    before = clocks.wait(60.0)
    clocks.wall_s -= HOUR_S
    assert clocks.wait(10.0) == before
    assert clocks.wait(HOUR_S) == MAY + 70.0


def test_set_back_by_days_it_is_doubted_unless_it_is_synchronised(clocks: Clocks) -> None:
    clocks.wait(60.0)
    clocks.wall_s -= 2 * DAY_S
    assert clocks.wait(1.0) is None
    assert len(clocks.told("clock-unknown")) == 1
    clocks.synchronised = True
    assert clocks.wait(1.0) == MAY + 62.0 - 2 * DAY_S
    assert len(clocks.told("clock-known")) == 1


def test_a_leap_far_ahead_is_remembered_only_after_it_has_lasted(clocks: Clocks) -> None:
    clocks.wait(60.0)
    clocks.wall_s += 30 * DAY_S
    clocks.wait(1.0)
    clocks.wall_s -= 30 * DAY_S
    assert clocks.wait(1.0) == MAY + 62.0, "a glitch leaves no trace"
    clocks.wall_s += 30 * DAY_S
    clocks.wait(1.0)
    clocks.wait(HOUR_S)
    clocks.reboot()
    clocks.wall_s -= 31 * DAY_S
    assert clocks.wait(1.0) is None, "what stayed is believed over a boot"


YEARS_S = 4 * 365 * DAY_S


@pytest.mark.parametrize("reboots", [False, True])
def test_a_clock_that_was_years_ahead_and_was_corrected_is_right_at_once(clocks: Clocks, reboots: bool) -> None:
    clocks.wait(60.0)
    clocks.wall_s += YEARS_S
    clocks.wait(1.0)
    clocks.wait(2 * HOUR_S)
    if reboots:
        clocks.reboot()
    clocks.wall_s -= YEARS_S
    right_s = clocks.wall_s + 1.0
    assert clocks.wait(1.0) == right_s
    assert clocks.wait(DAY_S) == right_s + DAY_S
    clocks.reboot()
    assert clocks.wait(1.0) == right_s + DAY_S + 1.0


@pytest.mark.parametrize(("reboots", "after_s"), [(False, HOUR_S), (True, DAY_S)])
def test_a_stage_that_began_years_ahead_is_not_trapped_for_years(clocks: Clocks, reboots: bool, after_s: float) -> None:
    clocks.wall_s += YEARS_S
    clocks.wait(2 * HOUR_S)
    assert clocks.trusted.since_s > MAY + YEARS_S
    if reboots:
        clocks.reboot()
    clocks.wall_s -= YEARS_S
    assert clocks.wait(1.0) is None
    assert clocks.wait(after_s - 60.0) is None
    assert clocks.wait(120.0) == clocks.wall_s
    assert clocks.trusted.since_s == clocks.wall_s, "what is due each night is not due in years alone"
    assert len(clocks.told("clock-known")) == 1


def test_a_clock_that_jumps_while_it_is_doubted_begins_its_hour_again_only_if_it_is_right(clocks: Clocks) -> None:
    clocks.wait(60.0)
    clocks.reboot()
    clocks.wall_s -= 100 * DAY_S
    assert clocks.wait(2 * HOUR_S) is None, "nobody set it here: it may be a clock without a battery"
    clocks.wall_s += 100 * DAY_S
    assert clocks.wait(1.0) == clocks.wall_s


def test_what_was_believed_outlives_a_boot_into_a_clock_without_battery(clocks: Clocks) -> None:
    clocks.wait(120.0)
    clocks.reboot()
    clocks.wall_s = 0.0
    assert clocks.wait(1.0) is None


def test_the_stages_first_time_is_kept(clocks: Clocks) -> None:
    assert clocks.trusted.since_s == float("inf")
    clocks.wait(1.0)
    assert clocks.trusted.since_s == MAY + 1.0
    clocks.wait(DAY_S)
    clocks.reboot()
    assert clocks.trusted.since_s == MAY + 1.0


def test_a_service_says_since_when_there_was_none(clocks: Clocks) -> None:
    assert clocks.log.add(beginning(clocks.log)).level == "info"
    clocks.wait(600.0)
    clocks.reboot(without_s=5 * HOUR_S)
    cut = clocks.log.add(beginning(clocks.log))
    assert cut.level == "warning"
    assert "ended unexpectedly after 2026-05-05 17:03 UTC" in cut.text
    clocks.log.add(Notice("service-ended", "The kiosk has stopped."))
    clocks.reboot(without_s=5 * HOUR_S)
    assert clocks.log.add(beginning(clocks.log)).text == "The kiosk is starting."


class Timex(ctypes.Structure):
    """The beginning of the kernel's struct, as adjtimex(2) has it, and room for the rest."""

    _fields_ = (
        ("modes", ctypes.c_uint), ("offset", ctypes.c_long), ("freq", ctypes.c_long), ("maxerror", ctypes.c_long),
        ("esterror", ctypes.c_long), ("status", ctypes.c_int), ("rest", ctypes.c_long * 26),
    )  # fmt: skip


STA_PLL, STA_UNSYNC, STA_NANO = 0x1, 0x40, 0x2000


@pytest.mark.parametrize(
    ("state", "status", "expected"),
    [
        (0, STA_PLL | STA_NANO, True),
        (0, 0, True),
        (5, STA_UNSYNC, False),
        (0, STA_UNSYNC | STA_PLL, False),
        (-1, 0, False),
    ],
)
def test_the_kernel_says_whether_the_clock_is_synchronised(
    monkeypatch: pytest.MonkeyPatch, state: int, status: int, expected: bool
) -> None:
    class Library:
        def adjtimex(self, buffer: Any) -> int:
            told = Timex.from_buffer(buffer._obj)
            assert told.modes == 0, "it only asks"
            told.offset = told.freq = told.maxerror = told.esterror = STA_UNSYNC ^ status
            told.status = status
            return state

    monkeypatch.setattr(ctypes, "CDLL", lambda *_, **__: Library())
    assert synchronised() is expected
    monkeypatch.setattr(ctypes, "CDLL", lambda *_, **__: object())
    assert synchronised() is False


def test_this_computers_kernel_is_understood() -> None:
    told = Timex()
    state = ctypes.CDLL(None).adjtimex(ctypes.byref(told))
    assert synchronised() is (state >= 0 and not told.status & STA_UNSYNC)
