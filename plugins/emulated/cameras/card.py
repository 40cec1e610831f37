"""The emulated camera's memory card, and the memory for pictures that go straight to the computer."""

from __future__ import annotations

import struct
from dataclasses import dataclass, field
from itertools import count
from typing import Final

from plugins.emulated.cameras.wire import text

STORAGE: Final = 0x0001_0001
FOLDER: Final = 0x3001
_ROOT: Final = 0xFFFF_FFFF


@dataclass(frozen=True, slots=True)
class Stored:
    """A file or folder."""

    handle: int
    parent: int
    format: int
    name: str
    data: bytes
    taken: str

    def info(self) -> bytes:
        """Its ObjectInfo dataset."""
        folder = self.format == FOLDER
        head = struct.pack("<IHHIHIII", STORAGE, self.format, 0, len(self.data), 0, 0, 0, 0)
        middle = struct.pack("<IIIIHII", 0, 0, 0, self.parent, 1 if folder else 0, 0, 0)
        return head + middle + text(self.name) + text(self.taken) + text(self.taken) + text("")


@dataclass(slots=True)
class Card:
    """DCIM/100VELA and what was photographed since; ``waiting`` holds what the computer has not fetched yet."""

    capacity: int
    objects: dict[int, Stored] = field(default_factory=dict)
    waiting: dict[int, Stored] = field(default_factory=dict)
    _handles: count[int] = field(default_factory=lambda: count(1))
    _folder: int = 0

    def __post_init__(self) -> None:
        dcim = self.add(0, FOLDER, "DCIM", b"", "20070101T000000")
        self._folder = self.add(dcim.handle, FOLDER, "100VELA", b"", "20070101T000000").handle

    @property
    def free(self) -> int:
        return max(0, self.capacity - sum(len(one.data) for one in self.objects.values()))

    def add(self, parent: int, format_code: int, name: str, data: bytes, taken: str) -> Stored:
        stored = Stored(next(self._handles), parent, format_code, name, data, taken)
        self.objects[stored.handle] = stored
        return stored

    def add_picture(self, format_code: int, name: str, data: bytes, taken: str, *, to_host: bool) -> Stored:
        if not to_host:
            return self.add(self._folder, format_code, name, data, taken)
        stored = Stored(0x9000_0000 + next(self._handles), 0, format_code, name, data, taken)
        self.waiting[stored.handle] = stored
        return stored

    def find(self, handle: int) -> Stored | None:
        return self.objects.get(handle) or self.waiting.get(handle)

    def handles(self, format_code: int, parent: int) -> list[int]:
        """Handles as GetObjectHandles filters them: parent 0 means everywhere, 0xFFFFFFFF the top."""
        return [
            one.handle
            for one in self.objects.values()
            if (not format_code or one.format == format_code)
            and (not parent or one.parent == (0 if parent == _ROOT else parent))
        ]

    def storage_info(self) -> bytes:
        images = min(9999, self.free // (16 << 20))
        head = struct.pack("<HHHQQI", 4, 3, 0, self.capacity, self.free, images)
        return head + text("Emulated card") + text("VELATURA")
