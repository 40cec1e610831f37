"""Files on their way to another computer: in parts, each with its hash; what has come stays, whatever happens.

A file counts once all of it is there and is checked. Nothing uses it before. Bundles and updates are sent; a backup is
read by the house, part by part.
"""

from __future__ import annotations

import hashlib
import os
import threading
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Final

from controller.core.errors import WorkError
from controller.core.storage import sync_folder
from controller.stage.link.session import Link
from hal.errors import CodedError

PART_BYTES: Final = 2 << 20
_NAME_BYTES: Final = 32
_KEPT: Final = 3
_PART_S: Final = 10.0
_OFFER_S: Final = 60.0


@dataclass(frozen=True, slots=True)
class Offer:
    """A file by its content: hashes of its parts (SHA-256, hex). ``name`` is the hash of these."""

    size: int
    parts: tuple[str, ...]

    @classmethod
    def of(cls, path: Path) -> Offer:
        with path.open("rb") as file:
            parts = iter(lambda: file.read(PART_BYTES), b"")
            hashes = tuple(hashlib.sha256(part).hexdigest() for part in parts)
            return cls(file.tell(), hashes)

    @property
    def name(self) -> str:
        return hashlib.sha256("".join(self.parts).encode()).hexdigest()

    def part(self, path: Path, number: int) -> bytes:
        """A part as it is sent. Raises OSError."""
        with path.open("rb") as file:
            file.seek(number * PART_BYTES)
            return bytes.fromhex(self.name) + number.to_bytes(4, "big") + file.read(PART_BYTES)


@lru_cache(maxsize=2)
def _offer_of(path: Path, changed_ns: int) -> Offer:
    return Offer.of(path)


def send(link: Link, key: str, path: Path, wanted: Callable[[float], bool] = lambda share: True) -> str | None:
    """Bring a file to the ``Arrivals`` that listen at ``key``; returns its name there. ``wanted`` gets the share that
    is there; None once it says no. Raises CodedError, OSError; what has come is there for the next time.
    """
    offer = _offer_of(path, path.stat().st_mtime_ns)
    while missing := link.ask(f"{key}/offer", offer, tuple[int, ...], within_s=_OFFER_S):
        for done, number in enumerate(missing, len(offer.parts) - len(missing)):
            if not wanted(done / len(offer.parts)):
                return None
            link.ask(f"{key}/part", offer.part(path, number), type(None), within_s=_PART_S)
    return offer.name


class Arrivals:
    """The files in a folder that have come, or are coming. ``check`` raises CodedError for one not to be used."""

    def __init__(self, folder: Path, check: Callable[[Path], None]) -> None:
        self._folder, self._check = folder, check
        self._offer: Offer | None = None
        self._missing: set[int] = set()
        self._lock = threading.RLock()
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)

    def listen(self, link: Link, key: str) -> None:
        """Take what the other side of ``link`` sends there."""
        link.answer(f"{key}/offer", Offer, self.offered)
        link.answer(f"{key}/part", bytes, self.part)

    def path(self, name: str) -> Path:
        """Where the file of this name is. Raises WorkError("file-not-here")."""
        path = self._folder / f"{name}.whole"
        if not path.exists():
            raise WorkError("file-not-here", what="The file has not come whole.", remedy="Wait until it has.")
        return path

    def offered(self, offer: Offer) -> tuple[int, ...]:
        """The parts that are still to be sent: of what has come before a cut, none. Raises what ``check`` raises,
        WorkError("file-part-damaged").
        """
        with self._lock:
            if (self._folder / f"{offer.name}.whole").exists():
                self._check(self.path(offer.name))
                return ()
            if self._offer != offer:
                self._offer, self._missing = offer, set(range(len(offer.parts))) - self._there(offer)
            if not self._missing:
                self._finish(offer)
            return tuple(sorted(self._missing))

    def part(self, data: bytes) -> None:
        """Take a part. Raises WorkError("file-part-damaged" or "cannot-write")."""
        number, content = int.from_bytes(data[_NAME_BYTES : _NAME_BYTES + 4], "big"), data[_NAME_BYTES + 4 :]
        with self._lock:
            offer = self._offer
            right = offer is not None and offer.name == data[:_NAME_BYTES].hex() and number < len(offer.parts)
            if not right or offer is None or hashlib.sha256(content).hexdigest() != offer.parts[number]:
                raise _damaged()
            try:
                with os.fdopen(os.open(self._coming(offer), os.O_RDWR | os.O_CREAT, 0o600), "r+b") as file:
                    os.pwrite(file.fileno(), content, number * PART_BYTES)
            except OSError as error:
                raise WorkError("cannot-write", what=f"A file could not be saved: {error.strerror}.",
                                remedy="Free space on the disk of that computer.") from error  # fmt: skip
            self._missing.discard(number)

    def _coming(self, offer: Offer) -> Path:
        return self._folder / f"{offer.name}.coming"

    def _there(self, offer: Offer) -> set[int]:
        """What an earlier process got: the hash of each part says it."""
        try:
            with self._coming(offer).open("rb") as file:
                return {
                    number
                    for number, expected in enumerate(offer.parts)
                    if hashlib.sha256(file.read(PART_BYTES)).hexdigest() == expected
                }
        except OSError:
            return set()

    def _finish(self, offer: Offer) -> None:
        coming = self._coming(offer)
        try:
            if coming.stat().st_size != offer.size or len(self._there(offer)) != len(offer.parts):
                raise _damaged()
            self._check(coming)
        except CodedError:
            coming.unlink(missing_ok=True)
            self._offer = None
            raise
        with coming.open("rb") as file:
            os.fsync(file.fileno())
        coming.rename(self._folder / f"{offer.name}.whole")
        sync_folder(self._folder)
        others = sorted(self._folder.glob("*.whole"), key=lambda path: path.stat().st_mtime)
        for path in [*others[:-_KEPT], *self._folder.glob("*.coming")]:
            path.unlink(missing_ok=True)


def _damaged() -> WorkError:
    return WorkError("file-part-damaged", what="A part of a file came damaged.", remedy="It is sent again.")
