"""Projectors and cameras on the network: PJLink's search (class 2, UDP port 4352) and notifications, and the addresses
in stage.toml.
"""

from __future__ import annotations

import contextlib
import dataclasses
import errno
import select
import socket
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import TracebackType
from typing import Any, Final

from hal.codecs.projectors.pjlink import LONGEST_DATAGRAM, PORT, SEARCH, Notification, SearchAck, parse_datagram
from hal.deadline import SLICE_S, Deadline
from hal.errors import DeviceBusy, DeviceError, DeviceGone, DeviceRefused, ProtocolError
from hal.finding import Finder, Found, SearchScope
from hal.links import host_and_port
from hal.notices import Notice
from hal.registry import OpenContext
from plugins.projectors.pjlink import open_pjlink_projector

PATIENCE_S: Final = 30.0
"""Time for answers to a search, from the specification."""
BROADCAST: Final = "255.255.255.255"
MOST_FOUND: Final = 256


@dataclass(frozen=True, slots=True)
class FoundProjector:
    """A projector that answered a search: its IP address, and its MAC address, which never changes."""

    host: str
    mac: str


@dataclass(frozen=True, slots=True)
class Heard:
    """A notification from ``host``. The sender of UDP can't be trusted: query the projector before acting."""

    host: str
    notification: Notification


class PjLinkListener:
    """Listens on UDP. One thread at a time; use it in a ``with`` statement, or ``close`` it.

    Parameters
    ----------
    host, port : where to listen; projectors answer and notify to port 4352

    ``ignored`` counts datagrams that were not PJLink.

    Raises
    ------
    DeviceBusy     another program listens there
    DeviceRefused  this user may not
    """

    def __init__(self, host: str = "", port: int = PORT) -> None:
        self.ignored = 0
        self._kept: list[Heard] = []
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
            self._socket.setblocking(False)
            self._socket.bind((host, port))
        except OSError as error:
            self._socket.close()
            kind = DeviceBusy if error.errno == errno.EADDRINUSE else DeviceRefused
            raise kind(
                "pjlink-port-taken",
                what=f"Velatura can't listen on UDP port {port}: {error.strerror}.",
                remedy=f"End the program that uses the port (ss -lunp | grep {port} shows it).",
            ) from error

    @property
    def port(self) -> int:
        return int(self._socket.getsockname()[1])

    def __enter__(self) -> PjLinkListener:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def search(
        self, *, deadline: Deadline, to: tuple[str, int] = (BROADCAST, PORT), patience_s: float = PATIENCE_S
    ) -> tuple[FoundProjector, ...]:
        """Send a search and collect answers for ``patience_s``, or until the deadline.

        Notifications that arrive meanwhile are kept for ``heard``. Raises DeviceGone if the network is down.
        """
        try:
            self._socket.sendto(SEARCH, to)
        except OSError as error:
            raise DeviceGone(
                "network-down",
                what=f"The search for projectors could not be sent: {error.strerror}.",
                remedy="Check the network cable and that this machine has an address.",
            ) from error
        projectors: dict[str, FoundProjector] = {}
        patience = deadline.within(patience_s)
        while not patience.passed and len(projectors) < MOST_FOUND:
            patience.sleep(0)
            for heard in self._received(patience):
                if isinstance(heard.notification, SearchAck):
                    projectors.setdefault(heard.notification.mac, FoundProjector(heard.host, heard.notification.mac))
                elif len(self._kept) < MOST_FOUND:
                    self._kept.append(heard)
        return tuple(projectors.values())

    def heard(self, *, deadline: Deadline) -> Heard:
        """The next notification of a projector. DeviceTimeout if none came before the deadline."""
        while not self._kept:
            deadline.check(
                "pjlink-nothing-heard",
                what="No PJLink notification was received.",
                remedy="To receive notifications, register this computer's address in the projector's network menu.",
            )
            self._kept += self._received(deadline)
        return self._kept.pop(0)

    def close(self) -> None:
        with contextlib.suppress(OSError):
            self._socket.close()

    def _received(self, deadline: Deadline) -> list[Heard]:
        """The content of one datagram, after a short wait; nothing if none came."""
        try:
            readable, _, _ = select.select([self._socket], [], [], min(SLICE_S, deadline.left_s()))
            if not readable:
                return []
            data, sender = self._socket.recvfrom(LONGEST_DATAGRAM + 1)
        except (BlockingIOError, ConnectionError):
            return []
        except (OSError, ValueError) as error:
            raise DeviceGone(
                "pjlink-listener-closed", what="The listener was closed.", remedy="Open it again."
            ) from error
        try:
            return [Heard(str(sender[0]), sent) for sent in parse_datagram(data)] if data != SEARCH else []
        except ProtocolError:
            self.ignored += 1
            return []


ANSWER_S: Final = 8.0


def find(wanted: SearchScope, deadline: Deadline) -> Sequence[Found]:
    """Projectors that answer the search (class 2), and those in stage.toml (any class)."""
    known = {str(settings.get("address", "")): settings for settings in wanted.of("projector", "pjlink")}
    devices = [_tried(address, settings, wanted, deadline) for address, settings in known.items()]
    hosts = {host for address in known if (host := _host(address))}
    try:
        answers = _searched(wanted, deadline)
    except DeviceError as error:
        problem = Notice.of(error)
        return [*devices, Found("network", "PJLink search", "search for projectors", problems=(problem,))]
    for host, mac in answers:
        if host in hosts:
            devices = [
                dataclasses.replace(device, identity=mac) if _host(device.address) == host else device
                for device in devices
            ]
        else:
            devices.append(dataclasses.replace(_tried(host, {"address": host}, wanted, deadline), identity=mac))
    return devices


def _searched(wanted: SearchScope, deadline: Deadline) -> list[tuple[str, str]]:
    if wanted.search is None:
        return []
    with PjLinkListener(*wanted.listen) as listener:
        answers = listener.search(deadline=deadline, to=wanted.search, patience_s=wanted.search_s)
        return [(answer.host, answer.mac) for answer in answers]


def _tried(address: str, settings: Mapping[str, Any], wanted: SearchScope, deadline: Deadline) -> Found:
    table = {"address": address, **{key: value for key, value in settings.items() if key in ("password", "profile")}}
    entry = Found("network", address, "PJLink projector", "projector", "pjlink", table)
    try:
        projector = open_pjlink_projector(table, OpenContext(wanted.stage), deadline.within(ANSWER_S))
    except DeviceError as error:
        return dataclasses.replace(entry, problems=(Notice.of(error),))
    with contextlib.closing(projector):
        try:
            identity = projector.identity(deadline=deadline.within(ANSWER_S))
        except DeviceError as error:
            return dataclasses.replace(entry, problems=(Notice.of(error),))
    return dataclasses.replace(entry, what=f"PJLink projector, {identity.maker} {identity.model}")


def _host(address: str) -> str:
    with contextlib.suppress(DeviceError):
        return host_and_port(address, PORT)[0]
    return ""


FINDER: Final = Finder("network", find)
