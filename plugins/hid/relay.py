"""USB relay boards of the USBRelayN family, for mains and lamp power. The caller keeps the lamp rules."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

from hal.codecs.hid import (
    RELAY_PRODUCT,
    RELAY_REPORT_LENGTH,
    RELAY_VENDOR,
    RelayState,
    channels_of,
    parse_state,
    switch_report,
)
from hal.deadline import Deadline
from hal.errors import DeviceRefused
from hal.registry import Driver, OpenContext, setting
from hal.values import DeviceIdentity
from plugins.hid.link import HidFound, HidHandle, HidKind, HidLink, OpenHid


def _state(handle: HidHandle, found: HidFound) -> RelayState:
    return parse_state(handle.get_feature_report(0, RELAY_REPORT_LENGTH), channels_of(found.product) or 0)


_KIND: Final = HidKind(
    name="relay board",
    vendor=RELAY_VENDOR,
    product=RELAY_PRODUCT,
    suits=lambda found: channels_of(found.product) is not None,
    serial_of=lambda handle, found: _state(handle, found).serial,
)


class RelayBoard:
    """``hal.interfaces.PowerSwitch`` on a relay board.

    After a board was unplugged, all its relays are open; ``state`` always asks the board.
    """

    def __init__(self, *, serial: str = "", backend: str = "hidraw", deadline: Deadline) -> None:
        self._link = HidLink(_KIND, serial=serial, backend=backend)
        try:
            self.identity(deadline=deadline)
        except BaseException:
            self._link.close()
            raise

    def identity(self, *, deadline: Deadline) -> DeviceIdentity:
        def query(board: OpenHid) -> DeviceIdentity:
            return DeviceIdentity(board.found.maker, board.found.product, _state(board.handle, board.found).serial)

        return self._link.call(query, deadline=deadline)

    def channels(self, *, deadline: Deadline) -> int:
        return len(self._link.call(lambda board: _state(board.handle, board.found), deadline=deadline).closed)

    def state(self, channel: int, *, deadline: Deadline) -> bool:
        """See ``hal.interfaces.PowerSwitch.state``. Raises DeviceRefused("relay-no-channel")."""

        def query(board: OpenHid) -> bool:
            closed = _state(board.handle, board.found).closed
            _require(channel, len(closed))
            return closed[channel - 1]

        return self._link.call(query, deadline=deadline)

    def switch(self, channel: int, closed: bool, *, deadline: Deadline) -> None:
        """Close or open a relay, and check it at the board; no effect if it is so already.

        Raises DeviceRefused("relay-no-channel"), before anything is sent, or DeviceRefused("relay-stuck").
        """

        def do(board: OpenHid) -> None:
            _require(channel, channels_of(board.found.product) or 0)
            board.handle.send_feature_report(switch_report(channel, closed))
            if _state(board.handle, board.found).closed[channel - 1] is not closed:
                raise DeviceRefused(
                    "relay-stuck",
                    what=f"Relay {channel} of board {board.serial} did not {'close' if closed else 'open'}.",
                    remedy="If in doubt, switch its mains off by hand. Replace the board.",
                )

        self._link.call(do, deadline=deadline)

    def close(self) -> None:
        self._link.close()


def _require(channel: int, channels: int) -> None:
    if not 1 <= channel <= channels:
        raise DeviceRefused(
            "relay-no-channel",
            what=f"The relay board has no channel {channel}.",
            remedy=f"Use a channel from 1 to {channels}.",
        )


def open_relay_board(settings: Mapping[str, Any], context: OpenContext, deadline: Deadline) -> RelayBoard:
    """Open the relay board of a stage's table."""
    return RelayBoard(
        serial=setting(settings, "serial", str, ""),
        backend=setting(settings, "backend", str, "hidraw"),
        deadline=deadline,
    )


DRIVER: Final = Driver(
    kind="power_switch",
    name="usb-relay",
    summary="USB relay boards with the names USBRelay1 to USBRelay8 (16c0:05df).",
    open=open_relay_board,
    settings={
        "serial": "the board's five-character serial number (default: the only board)",
        "backend": '"hidraw" (default) or "libusb": the backend of hidapi',
    },
)
