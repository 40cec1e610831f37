"""Does what a cue list says, at the times of the stage's time zone; a changed file is read again."""

from __future__ import annotations

import asyncio
import logging
import time
from pathlib import Path
from typing import Final
from zoneinfo import ZoneInfo

from controller.core.errors import VelaturaError
from controller.core.files import read_text
from controller.kiosk.building.cue_list import Cue, due, parse
from controller.kiosk.building.protocol import Options, Protocol
from controller.kiosk.building.verbs import Verbs

STEP_S: Final = 0.1
LATE_S: Final = 30.0
"""A cue that could not be done for so long is left out: it would surprise people after a restart."""
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
