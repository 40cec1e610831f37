"""The driver ``ptp``: still cameras with PTP over the network or USB, by the operations in their DeviceInfo.

A conversation is recorded on a tape as containers of PTP over USB, whatever bus it really went over. So a tape of one
bus can be replayed on another, and holds no name or key of this computer.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from typing import Any, Final

from hal.codecs.ptp import usb as ptp_usb
from hal.deadline import Deadline
from hal.errors import PluginError
from hal.escapes import toml_value
from hal.registry import Driver, OpenContext
from hal.tape import Transcript
from plugins.ptp.body import PictureStorage
from plugins.ptp.ip import PtpIpAddress, PtpIpLink
from plugins.ptp.link import MOST_IN_MEMORY, LinkEvent, PtpLink, Reply, Sink
from plugins.ptp.shot import Timing
from plugins.ptp.still import Connect, PtpCamera

TRACK: Final = "ptp"


class RecordedLink:
    """See ``PtpLink``."""

    def __init__(self, link: PtpLink, track: Transcript) -> None:
        self._link = link
        self._track = track
        self._number = -1
        track.remark("connected")

    @property
    def broken(self) -> bool:
        return self._link.broken

    def transact(
        self,
        operation: int,
        *parameters: int,
        data: bytes | None = None,
        sink: Sink | None = None,
        most: int = MOST_IN_MEMORY,
        deadline: Deadline,
    ) -> Reply:
        self._number += 1
        self._track.sent(ptp_usb.pack_command(operation, self._number, parameters))
        if data is not None:
            self._track.sent(ptp_usb.pack_data(operation, self._number, data))
        streamed = bytearray()

        def copied(piece: memoryview) -> object:
            streamed.extend(piece)
            return None if sink is None else sink(piece)

        reply = self._link.transact(
            operation, *parameters, data=data, sink=None if sink is None else copied, most=most, deadline=deadline
        )
        received = bytes(streamed) or reply.data
        if received:
            self._track.received(ptp_usb.pack_data(operation, self._number, received))
        self._track.received(_container(ptp_usb.RESPONSE, reply.code, self._number, reply.parameters))
        return reply

    def events(self) -> list[LinkEvent]:
        found = self._link.events()
        for event in found:
            self._track.received(_container(ptp_usb.EVENT, event.code, 0, event.parameters))
        return found

    def wait_event(self, seconds: float, *, deadline: Deadline) -> None:
        self._link.wait_event(seconds, deadline=deadline)

    def close(self) -> None:
        self._link.close()


def _container(kind: int, code: int, number: int, parameters: tuple[int, ...]) -> bytes:
    body = struct.pack(f"<{len(parameters)}I", *parameters)
    return ptp_usb.HEADER.pack(ptp_usb.HEADER.size + len(body), kind, code, number) + body


LONGEST_PICTURE_S: Final = 600.0


def _settings(settings: Mapping[str, Any]) -> tuple[str, PictureStorage, Timing]:
    """Address, where pictures are stored, and time limits. Raises PluginError."""
    address = str(settings["address"])
    _way(address)
    to_card = _choice(settings, "target", "computer", "card") == "card"
    storage = PictureStorage(to_card, _flag(settings, "keep_on_card"), _flag(settings, "raw_and_jpeg"))
    return address, storage, _timing(settings)


def open_camera(settings: Mapping[str, Any], context: OpenContext, deadline: Deadline) -> PtpCamera:
    """Open the camera of a ``[camera]`` table."""
    address, storage, timing = _settings(settings)  # a wrong address leaves no file
    transcript = context.transcript(TRACK, _named(address))
    connect = _way(address)
    if transcript is not None:
        connect = _recorded(connect, transcript)
    return PtpCamera(
        connect,
        serial=str(settings.get("serial", "")),
        storage=storage,
        timing=timing,
        transcript=transcript,
        deadline=deadline,
    )


def _way(address: str) -> Connect:
    """What opens a link to ``address``. Raises PluginError."""
    if address.startswith("usb:"):
        # Imported here, because a stage with its camera on the network needs no libusb.
        from plugins.ptp.usb.bus import UsbAddress, UsbFinder

        return UsbFinder(UsbAddress.parse(address)).connect
    place = PtpIpAddress.parse(address)
    return lambda until: PtpIpLink.connect(place, deadline=until)


def _recorded(connect: Connect, track: Transcript) -> Connect:
    """Each new link writes on the tape."""
    return lambda until: RecordedLink(connect(until), track)


def _named(address: str) -> str:
    if address.startswith("usb:"):
        return address
    place = PtpIpAddress.parse(address)
    return f"{place.host}-{place.command_port}"


def _choice(settings: Mapping[str, Any], key: str, *allowed: str) -> str:
    value = str(settings.get(key, allowed[0]))
    if value not in allowed:
        raise _wrong_setting(key, value, " or ".join(f'"{choice}"' for choice in allowed))
    return value


def _flag(settings: Mapping[str, Any], key: str) -> bool:
    value = settings.get(key, False)
    if not isinstance(value, bool):
        raise _wrong_setting(key, value, "true or false")
    return value


def _timing(settings: Mapping[str, Any]) -> Timing:
    if "picture_s" not in settings:
        return Timing()
    value = settings["picture_s"]
    if isinstance(value, bool) or not isinstance(value, int | float) or not 1 <= value <= LONGEST_PICTURE_S:
        raise _wrong_setting("picture_s", value, f"a number of seconds from 1 to {LONGEST_PICTURE_S:g}")
    return Timing(margin_s=float(value))


def _wrong_setting(key: str, value: object, allowed: str) -> PluginError:
    return PluginError(
        "camera-setting",
        what=f"The camera's setting {key} is {toml_value(value)}.",
        remedy=f"Write {allowed} for {key} in the [camera] table.",
    )


DRIVER: Final = Driver(
    kind="camera",
    name="ptp",
    summary="Still cameras with PTP over USB or the network (PTP/IP): standard ones and Canon EOS.",
    open=open_camera,
    settings={
        "address": "usb:SERIAL, usb:VENDOR:PRODUCT, usb:PORT, usb: for any, or ptpip:HOST:COMMANDPORT[:EVENTPORT]",
        "serial": "serial number that the camera must have (default: any)",
        "target": '"computer" (default) or "card": where a Canon EOS stores its pictures first',
        "raw_and_jpeg": "true to get a JPEG with each RAW file, if the camera can (default false)",
        "picture_s": "seconds that a picture may take beyond twice its exposure (default 15): more for large files",
        "keep_on_card": "true to keep pictures on the card after the transfer (default false)",
    },
    required=("address",),
    check=lambda settings, context: _settings(settings),
)
