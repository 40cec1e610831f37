"""Projectors on the network with a table of commands: their own LAN port, with the login of their family. A packet by
Wake-on-LAN wakes a projector whose network sleeps in standby; it strikes no lamp.
"""

from __future__ import annotations

import contextlib
import re
import socket
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

from hal.codecs.projectors.profiles import LONGEST_PASSWORD, NetworkTable, ProjectorProfile
from hal.deadline import Deadline
from hal.errors import DeviceError, DeviceGone, DeviceTimeout, PluginError
from hal.links import ByteLink, host_and_port
from hal.registry import Driver, OpenContext, setting
from hal.transcript import Transcript
from plugins.projectors.network.logins import Account, open_logged_in
from plugins.projectors.profile_files import load_profile, serial_table
from plugins.projectors.serial import SerialProjector

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


CHECK: Final = "its network cable, its address, and that its network is on in standby"
WAKING_S: Final = 20.0
"""A network that sleeps needs some seconds to answer."""


@dataclass(frozen=True, slots=True)
class Settings:
    """A projector's table of stage.toml. ``wake``: MAC address to wake, "" for none; ``wake_to``: host and UDP port."""

    profile: ProjectorProfile
    network: NetworkTable
    host: str
    port: int
    account: Account
    wake: str
    wake_to: tuple[str, int]


def read_settings(settings: Mapping[str, Any], context: OpenContext) -> Settings:
    """Raises PluginError and ProtocolError."""
    profile = load_profile(setting(settings, "profile", str), context.stage)
    serial_table(profile)
    if profile.network is None:
        raise PluginError(
            "profile-not-network",
            what=f"The profile {profile.name!r} has no network port.",
            remedy='Add a table [network] to the profile, or use the driver "serial".',
        )
    address = str(setting(settings, "address", str))
    host, port = host_and_port(address, profile.network.port)
    password = setting(settings, "password", str)
    longest = LONGEST_PASSWORD.get(profile.network.login, 0)
    if password is not None and not 0 < len(password.encode("utf-8")) <= longest:
        allowed = f"1 to {longest} characters" if longest else "none"
        raise PluginError(
            "setting-wrong",
            what=f"The password has {len(password)} characters; this family allows {allowed}.",
            remedy="Correct password in stage.toml, or remove it.",
        )
    sleeper = setting(settings, "wake", str, "")
    if sleeper:
        magic_packet(sleeper)
    to = host_and_port(str(setting(settings, "wake_to", str, BROADCAST)), PORT)
    account = Account(address, setting(settings, "user", str, ""), password)
    return Settings(profile, profile.network, host, port, account, sleeper, to)


def check_network_projector(settings: Mapping[str, Any], context: OpenContext) -> None:
    """As ``hal.registry.Driver.check``."""
    read_settings(settings, context)


class _Line:
    """Opens the connection, and wakes a network that sleeps."""

    def __init__(self, settings: Settings, transcript: Transcript | None) -> None:
        self._settings = settings
        self._transcript = transcript

    def open(self, deadline: Deadline) -> ByteLink:
        parsed = self._settings
        if not parsed.wake:
            return self._once(deadline)
        with contextlib.suppress(DeviceGone, DeviceTimeout):
            return self._once(deadline.within(min(WAKING_S, deadline.left_s() / 4)))
        wake(parsed.wake, parsed.wake_to)
        patience = deadline.within(WAKING_S)
        while True:
            try:
                return self._once(patience)
            except (DeviceGone, DeviceTimeout) as error:
                if patience.passed or isinstance(error, DeviceTimeout):
                    raise
                patience.sleep(0.5)

    def _once(self, deadline: Deadline) -> ByteLink:
        parsed = self._settings
        return open_logged_in(
            parsed.host, parsed.port, parsed.network, parsed.account, deadline=deadline, transcript=self._transcript
        )


def open_network_projector(settings: Mapping[str, Any], context: OpenContext, deadline: Deadline) -> SerialProjector:
    """Open the projector of a stage.toml table; see ``DRIVER`` for the settings."""
    parsed = read_settings(settings, context)
    transcript = context.transcript("tcp", f"{parsed.host}-{parsed.port}", secret=parsed.account.password or "")
    projector = SerialProjector(
        _Line(parsed, transcript).open, parsed.profile, name=parsed.account.name, transcript=transcript, check=CHECK
    )
    try:
        projector.open(deadline)
    except DeviceError:
        projector.close()
        raise
    return projector


DRIVER: Final = Driver(
    kind="projector",
    name="network",
    summary="Projectors on the network with the commands of their family, on their own LAN port.",
    open=open_network_projector,
    settings={
        "profile": "the family's table: a shipped name such as panasonic-dz, or a .toml file of the stage",
        "address": 'host, or host:port for another port than the family\'s, e.g. "192.168.0.20"',
        "password": "the password of the projector's network menu, if it has one",
        "user": "the account of the password, for families with accounts (default: the profile's)",
        "wake": "the projector's MAC address: a Wake-on-LAN packet is sent if its network does not answer",
        "wake_to": 'where that packet is sent (default: "255.255.255.255:9")',
    },
    required=("profile", "address"),
    check=check_network_projector,
)
