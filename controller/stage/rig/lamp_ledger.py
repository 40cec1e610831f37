"""Stored state of each lamp, so that after a restart or power cut a hot lamp never counts as cold."""

from __future__ import annotations

import json
import math
import threading
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Final, Protocol

from controller.core.errors import VelaturaError
from controller.core.files import read_bytes
from controller.core.storage import write_atomically
from hal.deadline import Deadline


class Clock(Protocol):
    """Seconds since boot, and waiting."""

    def now_s(self) -> float:
        """Monotonic; comparable between processes of one boot."""

    def boot(self) -> str:
        """Identifies this boot; times of another boot can't be compared."""

    def sleep(self, seconds: float, deadline: Deadline) -> None:
        """As ``Deadline.sleep``."""


class SystemClock:
    """CLOCK_MONOTONIC, which on Linux counts from boot for all processes."""

    def now_s(self) -> float:
        return time.monotonic()

    def boot(self) -> str:
        return Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()

    def sleep(self, seconds: float, deadline: Deadline) -> None:
        deadline.sleep(seconds)


@dataclass(frozen=True, slots=True)
class LampRecord:
    """One lamp.

    ``lit``: struck and not seen off since; ``since_s``: the clock at the strike (lit) or at the off (not
    lit), None for "never seen"; ``boot``: the boot of ``since_s``; ``strikes`` and ``lit_s``: totals;
    ``failed``: attempts in a row that gave no light, as the kiosk counts them.
    """

    lit: bool = False
    since_s: float | None = None
    boot: str = ""
    strikes: int = 0
    lit_s: float = 0.0
    failed: int = 0

    def failed_in(self, boot: str) -> int:
        """Those failed attempts that count in this boot: a computer that was started again allows all again."""
        return self.failed if self.boot == boot else 0


class LampLedger(Protocol):
    """Where lamp records survive."""

    def read(self, name: str) -> LampRecord | None:
        """The record of a lamp; None if it was never written."""

    def write(self, name: str, record: LampRecord) -> None:
        """Durable on return. Raises WorkError("no-space") and the like; the stored record is then unchanged."""

    def keep(self, name: str, record: LampRecord) -> bool:
        """As ``write``, of what has happened already: what can't be stored is read from now on, and goes with the next
        write. Returns whether it is durable."""

    def forgive(self, name: str, most: int) -> None:
        """After a technician's repair, or at an opening: at most so many attempts count as failed. As ``keep``."""


_UNKNOWN: Final = ""
_UNREADABLE: Final = (OSError, ValueError, TypeError, AttributeError, KeyError, RecursionError)


class LampFile:
    """A ledger in one JSON file of the stage folder, with a copy beside it.

    Where the file is damaged, or gone and the copy is there (damaged or not), every lamp of the stage counts as hot;
    strikes and hours are the copy's. Lamps that were not written since then count as hot after a restart, too: an entry
    without a name marks this.
    """

    NAME: Final = "lamps.json"
    COPY: Final = "lamps-copy.json"

    def __init__(self, path: Path) -> None:
        self._path, self._copy = path, path.with_name(self.COPY)
        self._lock = threading.RLock()
        self.damaged = False
        self._records = self._load()

    def read(self, name: str) -> LampRecord | None:
        record = self._records.get(name)
        return LampRecord(lit=True) if record is None and self.damaged else record

    def write(self, name: str, record: LampRecord) -> None:
        with self._lock:
            unknown = {_UNKNOWN: LampRecord(lit=True)} if self.damaged else {}
            records = {**unknown, **self._records, name: record}
            text = json.dumps({key: asdict(value) for key, value in sorted(records.items())}, indent=2)
            # The copy first: if the second one fails, the file is as it was.
            for path in (self._copy, self._path):
                write_atomically(path, text.encode() + b"\n")
            self._records = records

    def keep(self, name: str, record: LampRecord) -> bool:
        try:
            self.write(name, record)
        except VelaturaError:
            with self._lock:
                self._records = {**self._records, name: record}
            return False
        return True

    def forgive(self, name: str, most: int) -> None:
        with self._lock:
            record = self._records.get(name)
            if record is not None and record.failed > most:
                self.keep(name, replace(record, failed=most))

    def _load(self) -> Mapping[str, LampRecord]:
        gone = False
        try:
            records = _records(self._path)
        except FileNotFoundError:
            gone = True
        except _UNREADABLE:
            pass
        else:
            self.damaged = _UNKNOWN in records
            return records
        try:
            kept = _records(self._copy)
        except _UNREADABLE as error:
            self.damaged = not (gone and isinstance(error, FileNotFoundError))
            return {}
        self.damaged = True
        return {name: replace(record, lit=True, boot="") for name, record in kept.items()}


def _records(path: Path) -> dict[str, LampRecord]:
    content = json.loads(read_bytes(path))
    return {str(name): _record(fields) for name, fields in content.items()}


def _record(fields: Mapping[str, object]) -> LampRecord:
    lit, since_s, boot = fields["lit"], fields["since_s"], fields["boot"]
    strikes, lit_s, failed = fields["strikes"], fields["lit_s"], fields.get("failed", 0)
    if not (
        isinstance(lit, bool)
        and isinstance(since_s, float | int | None)
        and isinstance(boot, str)
        and isinstance(strikes, int)
        and isinstance(failed, int)
        and isinstance(lit_s, float | int)
        and math.isfinite(lit_s)
        and math.isfinite(since_s or 0.0)
    ):
        raise TypeError("a field of the wrong type")
    return LampRecord(lit, since_s, boot, strikes, float(lit_s), failed)
