"""The mains of an emulated stage: which relay of which emulated board feeds which projector (``[[mains]]``).

The relays are moved by the program that drives the emulated board, through real bytes; the projectors behind them then
lose their mains or boot, and a lamp that was cut hot counts the damage.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Final

from hal.errors import DeviceError
from lab.emulated.servers import BackgroundDevice
from lab.emulated.usb.bench import UsbDeviceTruth
from plugins.emulated.core.truth import FILE_NAME, USB_FILE, MainsTruth, ProjectorTruth
from plugins.emulated.projectors.projector import BoardProjector

_TICK_S: Final = 0.02
Moves = Callable[[str, int], Sequence[tuple[int, bool]]]
"""Every (channel, closed) of the named board, after the given number of them."""
MainsListener = Callable[[str, bool, int], None]
"""A projector has lost its mains (False) or got them back (True), and how often its lamp was damaged so far."""


class Mains(BackgroundDevice):
    """Follows the relays from ``start`` to ``stop``. At first every relay is open: the projectors have no mains.

    Every move counts, in its order, however soon the next one comes.
    """

    def __init__(
        self,
        circuits: Sequence[MainsTruth],
        projectors: Mapping[str, BoardProjector],
        moves: Moves,
        tell: MainsListener = lambda projector, on, damages: None,
    ) -> None:
        super().__init__()
        self._projectors = projectors
        self._moves = moves
        self._tell = tell
        self._feeds = {(one.relay, one.channel): one.feeds for one in circuits}
        self._seen = {one.relay: 0 for one in circuits}
        for feeds in self._feeds.values():
            self._switch(feeds, False)

    def _run(self) -> None:
        while not self._stopped.wait(_TICK_S):
            for relay, seen in self._seen.items():
                try:
                    moves = self._moves(relay, seen)
                except RuntimeError:
                    return  # the bus has ended before us
                self._seen[relay] = seen + len(moves)
                for channel, closed in moves:
                    self._switch(self._feeds.get((relay, channel), ()), closed)

    def _switch(self, feeds: Sequence[str], on: bool) -> None:
        for name in feeds:
            projector = self._projectors[name]
            if on:
                projector.restore_mains()
            else:
                projector.cut_mains()
            self._tell(name, on, projector.lamp.damages)


def check_mains(
    circuits: Sequence[MainsTruth], projectors: Sequence[ProjectorTruth], devices: Sequence[UsbDeviceTruth]
) -> None:
    """Raises DeviceError("mains-wrong") for a relay or a projector that is not there, or is wired twice."""
    boards = {one.name: one.channels for one in devices if one.kind == "relay"}
    names = {one.name for one in projectors}
    wired: set[tuple[str, int]] = set()
    fed: set[str] = set()
    for number, one in enumerate(circuits, start=1):
        place = (one.relay, one.channel)
        if one.channel > boards.get(one.relay, 0):
            raise _wrong(number, f"{USB_FILE} has no relay {one.channel} of a board {one.relay!r}")
        if place in wired or not names.issuperset(one.feeds) or not fed.isdisjoint(one.feeds):
            raise _wrong(number, "a relay or a projector is wired twice, or a projector does not exist")
        wired.add(place)
        fed.update(one.feeds)


def _wrong(number: int, why: str) -> DeviceError:
    return DeviceError(
        "mains-wrong",
        what=f"{FILE_NAME}: [[mains]] table {number} is wrong: {why}.",
        remedy="Name a relay board of bench/usb.toml, one of its channels, and projectors of bench.toml, each once.",
    )
