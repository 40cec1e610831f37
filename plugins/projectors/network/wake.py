"""Wake-on-LAN: a packet that wakes a projector whose network sleeps in standby. It strikes no lamp."""

from __future__ import annotations

import re
import socket
from typing import Final

from hal.errors import DeviceGone, PluginError

_ADDRESS: Final = re.compile(r"(?:[0-9A-Fa-f]{2}[:-]?){5}[0-9A-Fa-f]{2}")
PORT: Final = 9
BROADCAST: Final = "255.255.255.255"


def magic_packet(address: str) -> bytes:
    """The packet for a MAC address: six bytes FF, and the address 16 times. Raises PluginError("setting-wrong")."""
    if not _ADDRESS.fullmatch(address):
        raise PluginError(
            "setting-wrong",
            what=f"{address!r} is not a MAC address.",
            remedy='Write wake in stage.toml like this: "00:1a:2b:3c:4d:5e".',
        )
    return b"\xff" * 6 + bytes.fromhex(re.sub("[:-]", "", address)) * 16


def wake(address: str, to: tuple[str, int] = (BROADCAST, PORT)) -> None:
    """Send the packet once. Raises DeviceGone("wake-not-sent") without a network, and PluginError."""
    packet = magic_packet(address)
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            sender.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
            sender.sendto(packet, to)
    except OSError as error:
        raise DeviceGone(
            "wake-not-sent",
            what=f"The packet that wakes {address} could not be sent: {error.strerror}.",
            remedy="Check this computer's network.",
        ) from error
