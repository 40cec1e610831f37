"""Reads the event log of a simulated kiosk after each step, and its file without the kiosk's code."""

from __future__ import annotations

import contextlib
import sqlite3
import tempfile
from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Final

from controller.kiosk.state import EventRow
from controller.kiosk.store.event_log import SHOWN
from controller.run.state_machine import State
from lab.simulate.monitors.invariants import Violation
from lab.simulate.scenarios.scenario import event_name
from lab.simulate.world import SimulatedWorld

if TYPE_CHECKING:
    from controller.kiosk.service import Service

PAGE_BYTES: Final = 4096
_HEADER_BYTES: Final = 32
_FRAME_BYTES: Final = 24


def readable(file: Path) -> dict[int, str]:
    """The texts of its events by their numbers: all, or the newest ones as far as the first that can't be read."""
    texts: dict[int, str] = {}
    with tempfile.TemporaryDirectory() as name:
        copy = Path(name) / file.name
        for end in ("", "-wal"):
            if (part := file.with_name(f"{file.name}{end}")).is_file():
                copy.with_name(f"{copy.name}{end}").write_bytes(part.read_bytes())
        with contextlib.suppress(sqlite3.Error, UnicodeDecodeError), contextlib.closing(sqlite3.connect(copy)) as rows:
            for number, text in rows.execute("SELECT number, text FROM events ORDER BY number DESC"):
                texts[number] = text
    return texts


def pages_of(write_ahead_log: Path) -> list[int]:
    """The numbers of the pages that it has: those that were written last."""
    content = write_ahead_log.read_bytes() if write_ahead_log.is_file() else b""
    frames = range(_HEADER_BYTES, len(content) - _FRAME_BYTES - PAGE_BYTES + 1, _FRAME_BYTES + PAGE_BYTES)
    return sorted({int.from_bytes(content[at : at + 4], "big") for at in frames})


CHECK_BEGINS: Final = "Started: Drift check."
MOST_WORDS: Final = 240
MOST_AGAIN: Final = 20
"""Of the same words; the longest pause between two starts of the player is 30 s."""
WORDS_S: Final = 300.0
MOST_ENDS: Final = 12
"""Of a player because of its silence. One that loses two of five answers is ended up to seven times in this time."""
WRITTEN_S: Final = 60.0
"""Twice the pause after which the log is written again."""
ENDED: Final = ("player-hung", "player-gone")
STARTED: Final = "service-started"


class LogMonitor:
    """``rows``: by number, those that are surely written; ``read``: the number of the last one.

    ``digested``: all lines in the order in which they were read, without ``here``, the folder of this life.
    ``state``: the stage's, as it says, and ``fault``: what was wrong when that was "fault" last.
    ``unlit_s``: when it said last that a lamp gave no light. ``moment`` hears of each line.
    """

    def __init__(self, world: SimulatedWorld) -> None:
        self._world = world
        self.read = 0
        self.rows: dict[int, EventRow] = {}
        self.digested: list[str] = []
        self.here = "\0"
        self.state = self.fault = self._before = ""
        self.unlit_s = -1e9
        self.begun_checks: set[str] = set()
        self.on_event: Callable[[str], None] = lambda _: None
        self._held: deque[EventRow] = deque(maxlen=SHOWN)
        self._alerted, self._alerted_number, self._kills = 0, 0, 0
        self._due_check = ""
        self._unwritten_since_s: float | None = None
        self._looked_s = 0.0
        self._recent: deque[tuple[float, str]] = deque()
        self._often: Counter[str] = Counter()
        self._ends_s: deque[float] = deque(maxlen=MOST_ENDS)

    def preload(self, rows: Sequence[EventRow]) -> None:
        """These are in the log before the life begins."""
        self.rows = {row.number: row for row in rows[-SHOWN:]}
        self.read = len(rows)

    # -- the service

    def begins(self) -> None:
        self._held.clear()
        self._ends_s.clear()
        self._unwritten_since_s = None
        self.state = State.OFF.value

    def killed(self) -> None:
        """The service was, perhaps between an alert and the note that it was sent."""
        # Sent before it was killed, and not yet looked at.
        self._alerted_number = max([self._alerted_number, *(row.number for row in self._world.alerted)])
        self._alerted = len(self._world.alerted)
        self._kills += 1

    def damaged(self, left: Mapping[int, str]) -> None:
        """Its file was: of what was written, these texts can still be read."""
        self.rows = {number: row for number, row in self.rows.items() if left.get(number) == row.text}

    def numbers_again(self) -> None:
        """What was logged from ``read`` on has numbers that others had, which were never written."""
        self._alerted_number = min(self._alerted_number, self.read)

    def in_file(self, file: Path) -> None:
        """After its end, or at the end of a life: what was written is in the file. Raises Violation."""
        left = readable(file)
        # Older ones may go when a damaged file is replaced.
        least = sorted(left)[-SHOWN] if len(left) >= SHOWN else 0
        gone = [number for number, row in self.rows.items() if number >= least and left.get(number) != row.text]
        if gone:
            raise Violation("nothing lost", f"event {gone[0]} is gone from the log's file: {self.rows[gone[0]].text}")

    # -- checks

    def check(self, service: Service, check_begins_rightly: Callable[[], bool]) -> list[EventRow]:
        """Read what is new, and return it. Raises Violation."""
        number = service.log.number
        self._is_written(service, has_news=number != self.read)
        if service.log.problem is None:
            # What was logged while nothing could be written has been written now.
            self.rows.update((row.number, row) for row in self._held)
            self._held.clear()
        if number == self.read:
            return []
        new = service.log.after(self.read)
        for row in new:
            self.read = row.number
            text = row.text.replace(self.here, "")
            self.digested.append(f"{row.number} {row.unix_s!r} {row.level} {row.code} {text}")
            if service.log.problem is None:
                self.rows[row.number] = row
            else:
                self._held.append(row)
            self._said(row)
            self.on_event(event_name(row.code, row.text))
            if row.code == "crash":
                raise Violation("no crash", row.text)
            if row.level == "error" and row.code != "state" and row.text.count(".") < 2:
                raise Violation("remedy", f"{row.code}: {row.text}")
            if row.code == "state":
                self._changes_state(row)
            elif row.code == "task-due":
                if not check_begins_rightly():
                    raise Violation("at night", row.text)
                self._due_check = row.text.partition("(")[2].partition(")")[0]
            elif row.text == CHECK_BEGINS:
                self._check_begins(service)
        return list(new)

    def _is_written(self, service: Service, *, has_news: bool) -> None:
        """What is new since the last look was logged while there had long been room. Raises Violation."""
        now_s, problem = self._world.scheduler.now_s, service.log.problem
        if problem is None or self._world.disk.full:
            self._unwritten_since_s = None
        elif self._unwritten_since_s is None:
            self._unwritten_since_s = now_s
        elif has_news and self._looked_s > max(self._unwritten_since_s, self._world.disk.refused_s) + WRITTEN_S:
            raise Violation("log written", f"since {now_s - self._unwritten_since_s:.0f} s: {problem}")
        self._looked_s = now_s

    def alerts(self) -> None:
        """What was sent since the last look. Raises Violation."""
        world = self._world
        for row in world.alerted[self._alerted :]:
            if row.number <= self._alerted_number and not self._kills:
                raise Violation("alerts", f"event {row.number} was sent after {self._alerted_number}")
            if row.number > self._alerted_number:
                self._alerted_number, self._kills = row.number, 0
        self._alerted = len(world.alerted)

    def _changes_state(self, row: EventRow) -> None:
        """Who tries again after a fault still says what was wrong."""
        state, _, reason = row.text.removeprefix("The stage is ").rstrip(".").partition(": ")
        if state == State.FAULT.value:
            self.fault = reason
        elif state == State.POWERING.value and self.state == State.FAULT.value:
            before = reason.partition("Before: ")[2].rstrip(".")
            if not before or before not in self.fault:
                raise Violation("says why it is dark", f"it had a fault ({self.fault}), and says: {row.text}")
        self.state = state

    def _check_begins(self, service: Service) -> None:
        if self._due_check in self.begun_checks:
            raise Violation("once a night", f"{self._due_check} begins again")
        if service.log.problem is None:
            # What can't be written may be done again after a kill.
            self.begun_checks.add(self._due_check)

    def _said(self, row: EventRow) -> None:
        now_s, recent, often = self._world.scheduler.now_s, self._recent, self._often
        if row.code == "lamp-not-lit":
            self.unlit_s = now_s
        if row.code in ENDED:
            self._ends_s.append(now_s)
            if len(self._ends_s) == MOST_ENDS and now_s - self._ends_s[0] < WORDS_S:
                raise Violation(
                    "few ends", f"the player was ended {MOST_ENDS} times in {now_s - self._ends_s[0]:.0f} s"
                )
        # Who asks often gets as many answers: a request, and the line after it, are words of their own. So is a start,
        # because people restart the service; what ends by itself is another invariant.
        asked = "done-by" in (row.code, self._before) or row.code == STARTED
        self._before = row.code
        text = f"{row.text} ({row.number})" if asked else row.text
        recent.append((now_s, text))
        often[text] += 1
        while now_s - recent[0][0] >= WORDS_S:
            often[recent.popleft()[1]] -= 1
        if len(recent) >= MOST_WORDS:
            raise Violation("few words", f"{MOST_WORDS} events in {now_s - recent[0][0]:.0f} s")
        if often[text] >= MOST_AGAIN:
            raise Violation("few words", f"{MOST_AGAIN} times in {WORDS_S:.0f} s: {row.text}")
