"""Bundles on their way to other computers: in parts, each with its hash; what has come stays, whatever happens.

A bundle counts once all of it is there and its signature is good. Nothing plays it before.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from controller.core.errors import BundleError, WorkError
from controller.core.storage import sync_folder
from hal.errors import CodedError

PART_BYTES: Final = 2 << 20
_NAME_BYTES: Final = 32
_KEPT: Final = 3


@dataclass(frozen=True, slots=True)
class Offer:
    """A bundle by its content: hashes of its parts (SHA-256, hex). ``name`` is the hash of these."""

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


def message(name: str, number: int, data: bytes) -> bytes:
    """A part as it is sent."""
    return bytes.fromhex(name) + number.to_bytes(4, "big") + data


class Arrivals:
    """The bundles in a folder that have come, or are coming. ``check`` raises BundleError for one not to be played."""

    def __init__(self, folder: Path, check: Callable[[Path], None]) -> None:
        self._folder, self._check = folder, check
        self._offer: Offer | None = None
        self._missing: set[int] = set()
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)

    def path(self, name: str) -> Path:
        """Where the bundle of this name is. Raises BundleError("bundle-not-here")."""
        path = self._folder / f"{name}.vel"
        if not path.exists():
            raise BundleError("bundle-not-here", what="The bundle has not come whole.", remedy="Wait until it has.")
        return path

    def offered(self, offer: Offer) -> tuple[int, ...]:
        """The parts that are still to be sent: of what has come before a cut, none. Raises BundleError."""
        if (self._folder / f"{offer.name}.vel").exists():
            self._check(self.path(offer.name))
            return ()
        if self._offer != offer:
            self._offer, self._missing = offer, set(range(len(offer.parts))) - self._there(offer)
        if not self._missing:
            self._finish(offer)
        return tuple(sorted(self._missing))

    def part(self, data: bytes) -> None:
        """Take a part. Raises WorkError("bundle-part-damaged", "no-space" or "cannot-write")."""
        offer, number = self._offer, int.from_bytes(data[_NAME_BYTES : _NAME_BYTES + 4], "big")
        content = data[_NAME_BYTES + 4 :]
        right = offer is not None and offer.name == data[:_NAME_BYTES].hex() and number < len(offer.parts)
        if not right or offer is None or hashlib.sha256(content).hexdigest() != offer.parts[number]:
            raise WorkError("bundle-part-damaged", what="A part of a bundle came damaged.", remedy="It is sent again.")
        try:
            with os.fdopen(os.open(self._coming(offer), os.O_RDWR | os.O_CREAT, 0o600), "r+b") as file:
                os.pwrite(file.fileno(), content, number * PART_BYTES)
        except OSError as error:
            raise WorkError("cannot-write", what=f"A bundle could not be saved: {error.strerror}.",
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
                raise WorkError("bundle-part-damaged", what="A bundle came damaged.", remedy="It is sent again.")
            self._check(coming)
        except CodedError:
            coming.unlink(missing_ok=True)
            self._offer = None
            raise
        with coming.open("rb") as file:
            os.fsync(file.fileno())
        coming.rename(self._folder / f"{offer.name}.vel")
        sync_folder(self._folder)
        others = sorted(self._folder.glob("*.vel"), key=lambda path: path.stat().st_mtime)
        for path in [*others[:-_KEPT], *self._folder.glob("*.coming")]:
            path.unlink(missing_ok=True)
