"""Does what a cue list says, at the times of the stage's time zone; a changed file is read again.

A cue list is CSV with the columns ``time``, ``verb``, ``values``. A time is ``18:30`` or ``18:30:05`` (every day),
``2026-12-24 18:30`` (once), or ``+90`` or ``+1:30`` after the previous cue (seconds, or minutes and seconds, or hours
too).
"""

from __future__ import annotations

import asyncio
import csv
import logging
import re
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from datetime import date, datetime, timedelta
from datetime import time as time_of_day
from pathlib import Path
from typing import Final
from zoneinfo import ZoneInfo

from controller.core.errors import UsageError, VelaturaError
from controller.core.files import read_text
from controller.kiosk.building.protocol import Options, Protocol
from controller.kiosk.building.verbs import Verbs

HEAD: Final = ["time", "verb", "values"]
MOST_CUES: Final = 10_000
LONGEST_OFFSET_S: Final = 7 * 86400.0
_RELATIVE: Final = re.compile(r"\+(?:(?:(\d{1,3}):)?(\d{1,3}):)?(\d{1,6}(?:\.\d{1,3})?)", re.ASCII)
_WALL: Final = re.compile(r"(?:(\d{4}-\d{2}-\d{2})[ T])?(\d{1,2}):(\d{2})(?::(\d{2}))?", re.ASCII)


@dataclass(frozen=True, slots=True)
class Cue:
    """``at`` on ``day``, or every day if that is None, and ``after_s`` seconds later; ``values``: text for the verb."""

    line: int
    day: date | None
    at: time_of_day
    after_s: float
    verb: str
    values: str


def parse(text: str, check: Callable[[str, str], object]) -> tuple[Cue, ...]:
    """The cues in the order of the file. Empty lines and lines that begin with ``#`` are passed over.

    ``check`` raises VelaturaError for a verb and its values that are not valid. Raises UsageError("cues-wrong") naming
    the line.
    """
    cues: list[Cue] = []
    reader = csv.reader(text.splitlines(keepends=True), skipinitialspace=True, strict=True)
    headed = False
    try:
        for row in reader:
            cells = [cell.strip() for cell in row]
            if not any(cells) or cells[0].startswith("#"):
                continue
            if not headed:
                if cells != HEAD:
                    raise _wrong(reader.line_num, f"the first line is not {','.join(HEAD)}")
                headed = True
                continue
            cues.append(_cue(reader.line_num, cells, cues[-1] if cues else None))
            _checked(cues[-1], check)
            if len(cues) > MOST_CUES:
                raise _wrong(reader.line_num, f"there are more than {MOST_CUES} cues")
    except csv.Error as error:
        raise _wrong(reader.line_num, str(error)) from error
    return tuple(cues)


def _cue(line: int, cells: Sequence[str], before: Cue | None) -> Cue:
    if len(cells) not in (2, 3):
        raise _wrong(line, "it does not have two or three columns; put values with commas in quotation marks")
    verb, values = cells[1], cells[2] if len(cells) == 3 else ""
    if (match := _RELATIVE.fullmatch(cells[0])) is not None:
        if before is None:
            raise _wrong(line, "there is no cue before this one; begin with a time of the day")
        seconds = 3600 * int(match[1] or 0) + 60 * int(match[2] or 0) + float(match[3])
        if before.after_s + seconds > LONGEST_OFFSET_S:
            raise _wrong(line, "it comes more than a week after the last time of the day")
        return Cue(line, before.day, before.at, before.after_s + seconds, verb, values)
    if (match := _WALL.fullmatch(cells[0])) is None:
        raise _wrong(line, f"{cells[0][:30]!r} is not a time such as 18:30, 2026-12-24 18:30 or +90")
    try:
        day = None if match[1] is None else date.fromisoformat(match[1])
        hour, minute, second = (int(part or 0) for part in match.group(2, 3, 4))
        if (hour, minute, second) == (24, 0, 0):
            hour, day = 0, day and day + timedelta(days=1)
        return Cue(line, day, time_of_day(hour, minute, second), 0.0, verb, values)
    except ValueError as error:
        raise _wrong(line, f"{cells[0][:30]!r} does not exist") from error


def _checked(cue: Cue, check: Callable[[str, str], object]) -> None:
    try:
        check(cue.verb, cue.values)
    except VelaturaError as error:
        raise _wrong(cue.line, f"{error.what} {error.remedy}".rstrip(".")) from error


def _wrong(line: int, detail: str) -> UsageError:
    return UsageError("cues-wrong", what=f"Line {line} of the cue list: {detail}.", remedy="Correct this line.")


def due(cues: Sequence[Cue], after_unix_s: float, until_unix_s: float, zone: ZoneInfo) -> list[Cue]:
    """The cues after one moment, and until another that is at most some minutes later; in the order of their time."""
    found = [
        (moment, cue.line, cue)
        for cue in cues
        for moment in _moments(cue, after_unix_s, zone)
        if after_unix_s < moment <= until_unix_s
    ]
    return [cue for *_, cue in sorted(found, key=lambda one: one[:2])]


def _moments(cue: Cue, around_unix_s: float, zone: ZoneInfo) -> Iterator[float]:
    days = [cue.day] if cue.day is not None else _days_around(around_unix_s - cue.after_s, zone)
    for day in days:
        yield datetime.combine(day, cue.at, zone).timestamp() + cue.after_s


def _days_around(unix_s: float, zone: ZoneInfo) -> list[date]:
    today = datetime.fromtimestamp(unix_s, zone).date()
    return [today + timedelta(days) for days in (-1, 0, 1)]


STEP_S: Final = 0.1
LATE_S: Final = 30.0
"""A cue that could not be done for so long is dropped: it would surprise people after a restart."""
BACK_S: Final = 3600.0
"""A clock that is set back by less repeats no cue."""
_LOG: Final = logging.getLogger("velatura.building")


class CueOptions(Options):
    """``file``: the list, a CSV file."""

    file: Path

    @property
    def where(self) -> str:
        return str(self.file)


class _File:
    """The cues of a file; the old ones stay while a changed file is wrong."""

    def __init__(self, file: Path, verbs: Verbs) -> None:
        self._file, self._verbs = file, verbs
        self._seen = self._signature()
        self.cues = self._read()

    def reload_if_changed(self) -> None:
        """Read the file again if it has changed."""
        seen = self._signature()
        if seen == self._seen:
            return
        self._seen = seen
        try:
            self.cues = self._read()
        except (VelaturaError, OSError, ValueError) as error:
            what = f"{error.what} {error.remedy}" if isinstance(error, VelaturaError) else f"{self._file}: {error}."
            self._verbs.record("cues-wrong", f"{what} The old cues stay in use.")

    def _read(self) -> tuple[Cue, ...]:
        return parse(read_text(self._file), self._verbs.values)

    def _signature(self) -> tuple[int, int]:
        try:
            found = self._file.stat()
        except OSError:
            return 0, 0
        return found.st_mtime_ns, found.st_size


async def serve(options: CueOptions, verbs: Verbs) -> None:
    """Do the cues until cancelled. Raises OSError, and UsageError("cues-wrong") naming the line."""
    file = await asyncio.to_thread(_File, options.file, verbs)
    last_s = time.time()
    while True:
        await asyncio.sleep(STEP_S)
        await asyncio.to_thread(file.reload_if_changed)
        now_s = time.time()
        if now_s - last_s <= -BACK_S:
            last_s = now_s
        for cue in due(file.cues, max(last_s, now_s - LATE_S), now_s, ZoneInfo(verbs.time_zone())):
            await asyncio.to_thread(_do, verbs, cue)
        last_s = max(last_s, now_s)


def _do(verbs: Verbs, cue: Cue) -> None:
    try:
        verbs.do(cue.verb, cue.values, source=f"line {cue.line}")
    except VelaturaError as error:
        verbs.record("cue-refused", f"Line {cue.line} could not be done. {error.what} {error.remedy}")
    except Exception:  # noqa: BLE001 - one cue must not end the list
        _LOG.exception("A cue failed.")
        verbs.record("cue-refused", f"Line {cue.line} could not be done: an unexpected error.")


PROTOCOL: Final = Protocol("cues", "Cue list", CueOptions, serve)
