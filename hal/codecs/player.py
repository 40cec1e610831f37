"""The player's bytes: its frame files, and the JSON lines of its socket (docs/reference/player-protocol.md). No I/O.

The inbox (the controller writes, the player reads), the memory output (the player writes, the program that stands for
the projectors reads) and the file of ``live`` have one layout: a header, a slot for each output, and the pixels.
"""

from __future__ import annotations

import contextlib
import json
import mmap
import struct
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Final, Self

import numpy as np
import numpy.typing as npt

from hal.errors import CodedError, DeviceRefused, ProtocolError

PROTOCOL: Final = 1
LONGEST_ANSWER_BYTES: Final = 1 << 20
MOST_OUTPUTS: Final = 16
LONGEST_NAME_BYTES: Final = 39
SEQUENCE_AT: Final = 16
"""Byte of the sequence number (u64), a seqlock: odd while frames are being written, two more for each set."""
PRESENTED_AT: Final = 24
"""Byte of the time at which the set was presented or written (f64, monotonic seconds)."""
MAGIC: Final = b"VELFRAME"
_VERSION: Final = 1
_HEADER: Final = struct.Struct("<8sIIQdQ24x")
_SLOT: Final = struct.Struct("<40sIIQQ")
_ALIGNMENT: Final = 4096
LONGEST_HEAD_BYTES: Final = _HEADER.size + MOST_OUTPUTS * _SLOT.size


@dataclass(frozen=True, slots=True)
class FrameSlot:
    """One output of a frame file: its name, its picture's size, and the ``offset`` of its pixels (RGB, row by row)."""

    name: str
    width_px: int
    height_px: int
    offset: int

    @property
    def shape(self) -> tuple[int, int, int]:
        return (self.height_px, self.width_px, 3)

    @property
    def nbytes(self) -> int:
        return self.width_px * self.height_px * 3


@dataclass(frozen=True, slots=True)
class FrameLayout:
    """The slots of a frame file, and its ``size`` in bytes."""

    slots: tuple[FrameSlot, ...]
    size: int

    @classmethod
    def of(cls, outputs: Iterable[tuple[str, int, int]]) -> Self:
        """The layout for outputs: (name, width_px, height_px) each, at most 16."""
        sizes = list(outputs)
        position = _HEADER.size + _SLOT.size * len(sizes)
        slots = []
        for name, width_px, height_px in sizes:
            position += -position % _ALIGNMENT
            slots.append(FrameSlot(name, width_px, height_px, position))
            position += slots[-1].nbytes
        return cls(tuple(slots), position)

    def head(self) -> bytes:
        """The bytes before the pixels, with sequence and time zero."""
        slots = (_SLOT.pack(slot.name.encode(), slot.width_px, slot.height_px, slot.offset, 0) for slot in self.slots)
        return _HEADER.pack(MAGIC, _VERSION, len(self.slots), 0, 0.0, self.size) + b"".join(slots)


class MappedFrames:
    """A mapped frame file: ``pixels`` of its outputs, (rows, columns, 3) uint8 each, in the layout's order."""

    def __init__(self, mapped: mmap.mmap, layout: FrameLayout) -> None:
        self._map = mapped
        # One aligned 64-bit store each: a byte-wise store could be read half done.
        self._sequence = np.frombuffer(mapped, "<u8", 1, SEQUENCE_AT)
        self._presented_at = np.frombuffer(mapped, "<f8", 1, PRESENTED_AT)
        self.pixels: tuple[npt.NDArray[np.uint8], ...] = tuple(
            np.frombuffer(mapped, np.uint8, slot.nbytes, slot.offset).reshape(slot.shape) for slot in layout.slots
        )

    @property
    def sequence(self) -> int:
        """The set's number: odd while it is being written."""
        return int(self._sequence[0])

    @property
    def presented_at_s(self) -> float:
        """When the set was presented or written, in monotonic seconds."""
        return float(self._presented_at[0])

    def begin(self) -> None:
        """Say that a set is being written."""
        self._sequence[0] = self.sequence | 1

    def finish(self, presented_at_s: float | None = None) -> int:
        """Say that the set is whole, and since when; returns its number."""
        if presented_at_s is not None:
            self._presented_at[0] = presented_at_s
        self._sequence[0] = self.sequence + 1
        return self.sequence

    def close(self) -> None:
        """Release the mapping; the file stays."""
        del self._sequence, self._presented_at, self.pixels
        with contextlib.suppress(BufferError):
            self._map.close()


def parse_layout(head: bytes) -> FrameLayout:
    """The layout that a frame file's first bytes say; ``LONGEST_HEAD_BYTES`` of them are always enough.

    Raises ProtocolError("frame-file-wrong") for anything else, slots beyond the file's size included.
    """
    if len(head) < _HEADER.size or not head.startswith(MAGIC):
        raise _not_frames("it is not a frame file")
    _, version, count, _, _, size = _HEADER.unpack_from(head)
    if version != _VERSION or not 1 <= count <= MOST_OUTPUTS or len(head) < _HEADER.size + count * _SLOT.size:
        raise _not_frames(f"it has version {version} and {count} outputs")
    slots = []
    for number in range(count):
        name, width_px, height_px, offset, _ = _SLOT.unpack_from(head, _HEADER.size + number * _SLOT.size)
        slots.append(FrameSlot(name.rstrip(b"\0").decode(errors="replace"), width_px, height_px, offset))
        if not slots[-1].nbytes or offset + slots[-1].nbytes > size:
            raise _not_frames(f"the pixels of output {slots[-1].name!r} are not inside it")
    return FrameLayout(tuple(slots), size)


def parse_set(head: bytes) -> tuple[int, float]:
    """Sequence number and time of the set in a frame file that begins like this."""
    _, _, _, sequence, presented_at_s, _ = _HEADER.unpack_from(head)
    return sequence, presented_at_s


def _not_frames(why: str) -> ProtocolError:
    return ProtocolError(
        "frame-file-wrong",
        what=f"The file does not hold frames: {why}.",
        remedy="Let its writer make it again, as docs/reference/player-protocol.md describes.",
    )


def request_line(ticket: object, request: Mapping[str, Any]) -> bytes:
    """A request, as one line; its answer has the same ``ticket``."""
    return json.dumps({"id": ticket, **request}).encode() + b"\n"


def answer_line(ticket: object, values: Mapping[str, Any]) -> bytes:
    """A good answer, as one line."""
    return json.dumps({"id": ticket, "ok": True, **values}).encode() + b"\n"


def error_line(ticket: object, error: CodedError) -> bytes:
    """A refusal, as one line."""
    return json.dumps({"id": ticket, "ok": False, "error": error_fields(error)}).encode() + b"\n"


def error_fields(error: CodedError) -> dict[str, str]:
    """An error or a warning, as answers have it."""
    return {"code": error.code, "what": error.what, "remedy": error.remedy}


def parse_answer(line: bytes) -> dict[str, Any]:
    """The JSON object of an answer. Raises ProtocolError("player-protocol-broken")."""
    try:
        answer = json.loads(line)
    except (ValueError, RecursionError) as error:
        raise protocol_broken("an answer of it is not JSON") from error
    if not isinstance(answer, dict):
        raise protocol_broken("an answer of it is not a JSON object")
    return answer


def accepted(answer: dict[str, Any]) -> dict[str, Any]:
    """A good answer. Raises DeviceRefused with the player's own code and sentences, or ProtocolError."""
    if answer.get("ok") is True:
        return answer
    failure = answer.get("error")
    keys = ("code", "what", "remedy")
    if not isinstance(failure, dict) or not all(isinstance(failure.get(key), str) for key in keys):
        raise protocol_broken("one of its errors lacks code, what or remedy")
    raise DeviceRefused(failure["code"], what=failure["what"], remedy=failure["remedy"])


def protocol_broken(detail: str) -> ProtocolError:
    """The error for bytes that the player's protocol does not allow."""
    return ProtocolError(
        "player-protocol-broken",
        what=f"The player broke its protocol: {detail}.",
        remedy="Install player and controller of the same release, and restart the player.",
    )
