"""A camera from the track of a tape: each operation is answered as it was, on PTP/IP, whatever bus it came from."""

from __future__ import annotations

import struct
from collections.abc import Hashable, Iterable
from dataclasses import dataclass, field
from typing import Final

from hal.tape import Track
from hal.transcript import Direction, Entry
from plugins.emulated.cameras.body import CameraFaults, CameraNames, EmulatedBody
from plugins.emulated.cameras.shot import ShotFiles, ShotSettings
from plugins.emulated.cameras.wire import NOT_SUPPORTED, Gone, PtpOutcome
from plugins.emulated.tape.exchanges import Exchange, Replay

_HEADER: Final = struct.Struct("<IHHI")
_COMMAND, _DATA, _RESPONSE, _EVENT = 1, 2, 3, 4
_ACTS: Final = frozenset({0x100E, 0x910F, 0x9128, 0x9125, 0x90C0, 0x90CB, 0x9207, 0x9205, 0x100B, 0x9117})
"""Operations that release the shutter or delete a picture."""
_GET_OBJECT: Final = 0x1009
_PARTS: Final = frozenset({0x101B, 0x9107})
_ALWAYS: Final = {0x1002: PtpOutcome(), 0x1003: PtpOutcome()}


@dataclass(slots=True)
class _Done:
    """An operation of the tape: what was asked, what came, and the events after it."""

    code: int
    parameters: tuple[int, ...]
    sent: bytes = b""
    data: bytes | None = None
    answer: tuple[int, tuple[int, ...]] | None = None
    events: list[tuple[int, tuple[int, ...]]] = field(default_factory=list)


class TapeBody(EmulatedBody):
    """See ``EmulatedBody``. ``unknown``: operations that the tape does not have, refused as not supported."""

    def __init__(self, track: Track) -> None:
        super().__init__(no_files, names=CameraNames("", "Camera of a tape", ""), time_scale=0.0, card_bytes=0,
                         faults=CameraFaults())  # fmt: skip
        done = _operations(track.entries)
        self.unknown: list[int] = []
        self._replay = Replay([Exchange((one.code, one.parameters, one.sent), one) for one in done], acts=_acts)
        self._objects = _objects(done)

    def answer(self, code: int, parameters: tuple[int, ...], data: bytes) -> PtpOutcome:
        with self.lock:
            self.answered[code] += 1
            found = self._replay.answer((code, parameters, data)) or self._replay.answer((code, parameters, b""))
            if found is not None:
                return self._again(found)
            if code in _PARTS and (whole := self._objects.get(parameters[0] if parameters else -1)) is not None:
                piece = whole[parameters[1] : parameters[1] + parameters[2]]
                return PtpOutcome(parameters=(len(piece),), data=piece)
            if code == _GET_OBJECT and parameters and parameters[0] in self._objects:
                return PtpOutcome(data=self._objects[parameters[0]])
            if code not in _ALWAYS:
                self.unknown.append(code)
            return _ALWAYS.get(code, PtpOutcome(NOT_SUPPORTED))

    def _again(self, done: _Done) -> PtpOutcome:
        if done.answer is None:
            raise Gone  # the connection ended here
        for code, parameters in done.events:
            self.on_event(code, parameters)
        return PtpOutcome(done.answer[0], done.answer[1], done.data)


def _acts(question: Hashable) -> bool:
    return isinstance(question, tuple) and question[0] in _ACTS


def _operations(entries: Iterable[Entry]) -> list[_Done]:
    found: list[_Done] = []
    for entry in entries:
        if entry.way is Direction.REMARK or len(entry.data) < _HEADER.size:
            continue
        _, kind, code, _ = _HEADER.unpack_from(entry.data)
        body = entry.data[_HEADER.size :]
        numbers = struct.unpack(f"<{len(body) // 4}I", body[: len(body) // 4 * 4]) if kind != _DATA else ()
        if kind == _COMMAND:
            found.append(_Done(code, numbers))
        elif found and kind == _DATA and entry.way is Direction.SENT:
            found[-1].sent = body
        elif found and kind == _DATA:
            found[-1].data = body
        elif found and kind == _RESPONSE:
            found[-1].answer = (code, numbers)
        elif found and kind == _EVENT:
            found[-1].events.append((code, numbers))
    return found


def _objects(done: Iterable[_Done]) -> dict[int, bytes]:
    """The files that were fetched, whole or in blocks, by their handles."""
    objects: dict[int, bytes] = {}
    for one in done:
        if one.data is None or not one.parameters:
            continue
        if one.code == _GET_OBJECT:
            objects[one.parameters[0]] = one.data
        elif one.code in _PARTS and len(one.parameters) > 1:
            known = objects.get(one.parameters[0], b"")
            objects[one.parameters[0]] = known[: one.parameters[1]] + one.data
    return objects


def no_files(settings: ShotSettings) -> ShotFiles:
    raise AssertionError("a tape's camera takes no pictures of its own")
