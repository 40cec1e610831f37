"""Where the search for projectors is sent: only to the network interface that a person named."""

from __future__ import annotations

import fcntl
import socket
import struct
from typing import Final

from controller.core.errors import UsageError

ALL: Final = "all"
EVERYWHERE: Final = "255.255.255.255"
PJLINK: Final = 4352
_SIOCGIFBRDADDR: Final = 0x8919
_LONGEST: Final = 15


def search_address(interface: str) -> str:
    """The broadcast address of ``interface``, or of all for "all". Raises UsageError("interface-unknown")."""
    if interface == ALL:
        return EVERYWHERE
    names = sorted(name for _, name in socket.if_nameindex())
    if interface in names and len(interface) <= _LONGEST:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as any_socket:
            try:
                reply = fcntl.ioctl(any_socket, _SIOCGIFBRDADDR, struct.pack("256s", interface.encode()))
            except OSError:
                reply = b""
        if reply and reply[20:24] != bytes(4):
            return socket.inet_ntoa(reply[20:24])
        raise UsageError(
            "interface-unknown",
            what=f"The network interface {interface} has no broadcast address.",
            remedy="Connect it, or name another one.",
        )
    raise UsageError(
        "interface-unknown",
        what=f"There is no network interface {interface!r}.",
        remedy=f"Use one of {', '.join(names)}, or {ALL}.",
    )
