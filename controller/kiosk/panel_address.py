"""Under which addresses browsers reach the panel of this computer, and how somebody logs in first."""

from __future__ import annotations

import contextlib
import fcntl
import ipaddress
import socket
import struct
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from controller.core import kiosk_places
from controller.core.storage import write_atomically

FIRST_LOGIN: Final = kiosk_places.FIRST_LOGIN
EVERYWHERE: Final = ("0.0.0.0", "::")  # noqa: S104 - compared with, not listened at
_GET_ADDRESS: Final = 0x8915
"""SIOCGIFADDR: an interface's IPv4 address (netdevice(7))."""


def is_loopback(host: str) -> bool:
    """Whether only this computer reaches ``host``."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def bracketed(host: str) -> str:
    """A host as it stands in a URL and in the header Host: an IPv6 address in brackets."""
    return f"[{host}]" if ":" in host and not host.startswith("[") else host


def own_addresses() -> tuple[str, ...]:
    """The IPv4 addresses of this computer in its networks, without those that only itself knows."""
    found = []
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as channel:
        for _, name in socket.if_nameindex():
            # An interface without an address has nothing to tell.
            with contextlib.suppress(OSError):
                reply = fcntl.ioctl(channel, _GET_ADDRESS, struct.pack("256s", name.encode()[:15]))
                found.append(ipaddress.ip_address(reply[20:24]))
    return tuple(str(one) for one in found if not one.is_loopback)


def addresses(address: str) -> tuple[str, ...]:
    """The addresses for people, of a panel that listens at ``address`` (``https://0.0.0.0:8377/``)."""
    for host in EVERYWHERE:
        if f"//{host}:" in address or f"//[{host}]:" in address:
            at = address.rpartition(":")[2]
            scheme = address.partition(":")[0]
            return tuple(f"{scheme}://{own}:{at}" for own in own_addresses())
    return (address,)


@dataclass(frozen=True, slots=True)
class PanelAccess:
    """Where the panel is (``served_at``: by its server), and the account and one-time password until ``entered``."""

    served_at: str
    login: tuple[str, ...]
    entered: Callable[[], bool]

    def lines(self) -> tuple[str, ...]:
        """For a projector."""
        where = addresses(self.served_at)[:1] or ("connect this computer to a network",)
        return ("velatura", *where, *(() if self.entered() else self.login))


def keep_first_login(runtime: Path, account: str, password: str) -> None:
    """Where only the services' user and root read it, and only until the computer is switched off."""
    write_atomically(runtime / FIRST_LOGIN, f"{account} {password}\n".encode(), mode=0o600)
