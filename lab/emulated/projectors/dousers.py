"""Emulated DMX nodes with dousers, driven by sACN packets: blades that need their time, and the loss of the signal.

The packets are read here from the text of ANSI E1.31, without the library that the driver uses.
"""

from __future__ import annotations

import contextlib
import os
import socket
import struct
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

from hal.errors import DeviceError
from lab.emulated.servers import BackgroundDevice
from plugins.emulated.core.servers import HOST
from plugins.emulated.core.truth import FILE_NAME, DouserTruth
from plugins.emulated.projectors.lamp import EmulatedLamp

LOST_S: Final = 2.5
_TICK_S: Final = 0.1
_HALF: Final = 128
_HEAD: Final = struct.Struct(">HH12sHI16sHI64sBHBBHHBBHHH")
_IDENTIFIER: Final = b"ASC-E1.17\0\0\0"
_LENGTH: Final = 0x0FFF
Tell = Callable[[str, bool], None]
"""The douser of a projector opens (True) or closes."""


@dataclass(frozen=True, slots=True)
class Levels:
    """A data packet. ``source``: 16 bytes; ``slots``: the levels of channels 1 and up."""

    source: bytes
    universe: int
    priority: int
    sequence: int
    ended: bool
    slots: bytes


def read_levels(datagram: bytes) -> Levels | None:
    """The levels in a datagram; None for what is no data packet with the start code 0, or is a preview."""
    if len(datagram) <= _HEAD.size:
        return None
    (preamble, _, identifier, _, root, source, _, framing, _, priority, _, sequence, options, universe, length, set_,
     kind, first, step, count) = _HEAD.unpack_from(datagram)  # fmt: skip
    fixed = (preamble, identifier, root, framing, set_, kind, first, step)
    if fixed != (0x10, _IDENTIFIER, 4, 2, 2, 0xA1, 0, 1) or count < 1 or length & _LENGTH != count + 10:
        return None
    values = datagram[_HEAD.size : _HEAD.size + count]
    if len(values) != count or values[0] != 0 or options & 0x80:
        return None
    return Levels(source, universe, priority, sequence, bool(options & 0x40), values[1:])


class EmulatedDouser:
    """Blades before a lens: closed at first. One thread moves them; others only look."""

    def __init__(self, travel_s: float, *, clock: Callable[[], float] = time.monotonic) -> None:
        self._travel_s = travel_s
        self._clock = clock
        self._course = (0.0, 0.0, clock())

    @property
    def opens(self) -> bool:
        """Whether it is open, or on its way there."""
        return self._course[1] > 0

    def passing(self) -> float:
        """The share of the light that passes, 0 to 1."""
        start, end, since_s = self._course
        gone = self._clock() - since_s
        if gone >= self._travel_s:
            return end
        return start + (end - start) * gone / self._travel_s

    def move(self, is_open: bool) -> None:
        if is_open is not self.opens:
            self._course = (self.passing(), float(is_open), self._clock())


class EmulatedNode(BackgroundDevice):
    """A DMX node at one UDP port; a context. The source with the highest priority counts, the newest of several."""

    def __init__(self, port: int, dousers: Sequence[tuple[DouserTruth, EmulatedDouser]], tell: Tell) -> None:
        super().__init__()
        self._dousers = dousers
        self._tell = tell
        self._sources: dict[tuple[int, bytes], tuple[float, Levels]] = {}
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.bind((HOST, port))
        except OSError as error:
            self._socket.close()
            raise DeviceError(
                "port-in-use",
                what=f"The DMX node's UDP port {port} can't be used: {os.strerror(error.errno or 0)}.",
                remedy=f"End the program that uses it (perhaps another bench), or correct {FILE_NAME}.",
            ) from error
        self._socket.settimeout(_TICK_S)
        self.address = f"{HOST}:{self._socket.getsockname()[1]}"

    def stop(self) -> None:
        """End, and close its port."""
        super().stop()
        self._socket.close()

    def _run(self) -> None:
        while not self._stopped.is_set():
            with contextlib.suppress(OSError):
                if (levels := read_levels(self._socket.recv(2048))) is not None:
                    self._take(levels)
            for truth, douser in self._dousers:
                before = douser.opens
                douser.move(self._wanted(truth, before))
                if douser.opens is not before:
                    self._tell(truth.covers, douser.opens)

    def _take(self, levels: Levels) -> None:
        key = levels.universe, levels.source
        seen = self._sources.get(key)
        if seen is not None and -20 < (levels.sequence - seen[1].sequence + 128) % 256 - 128 <= 0:
            return
        self._sources.pop(key, None)
        if not levels.ended:
            self._sources[key] = time.monotonic(), levels

    def _wanted(self, truth: DouserTruth, before: bool) -> bool:
        now_s = time.monotonic()
        self._sources = {key: seen for key, seen in self._sources.items() if now_s - seen[0] <= LOST_S}
        heard = [levels for (universe, _), (_, levels) in self._sources.items() if universe == truth.universe]
        if not heard:
            return before and truth.lost == "hold"
        counts = max(reversed(heard), key=lambda levels: levels.priority)
        return len(counts.slots) >= truth.channel and counts.slots[truth.channel - 1] >= _HALF


def dmx_nodes(dousers: Sequence[DouserTruth], lamps: Mapping[str, EmulatedLamp], tell: Tell) -> Iterator[EmulatedNode]:
    """The nodes of a bench, one for each port; they cover the lamps. Raises DeviceError("douser-wrong")."""
    covered = [one.covers for one in dousers]
    if len(set(covered)) < len(covered) or not lamps.keys() >= set(covered):
        raise DeviceError(
            "douser-wrong",
            what=f"{FILE_NAME}: a table [[dousers]] covers a projector that has one already, or does not exist.",
            remedy="Name a projector of this file, each once.",
        )
    for port in dict.fromkeys(one.port for one in dousers):
        made = [(one, EmulatedDouser(one.travel_s)) for one in dousers if one.port == port]
        for truth, douser in made:
            lamps[truth.covers].passing = douser.passing
        yield EmulatedNode(port, made, tell)
