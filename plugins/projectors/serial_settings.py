"""Settings of the serial driver from a profile and stage.toml."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from hal.codecs.projectors.profiles import ProjectorProfile
from hal.codecs.projectors.serial_table import SerialTable
from hal.errors import PluginError
from hal.registry import OpenContext, setting
from hal.values import Power
from plugins.projectors.network.device_server import is_url, parse_url
from plugins.projectors.profile_files import load_profile


def serial_table(profile: ProjectorProfile) -> SerialTable:
    """The serial part of a profile. PluginError("profile-not-serial") if it has none."""
    if profile.serial is None:
        raise PluginError(
            "profile-not-serial",
            what=f"The profile {profile.name!r} has no serial commands.",
            remedy='Use another profile, or the driver "pjlink".',
        )
    return profile.serial


def reported_powers(table: SerialTable) -> frozenset[Power]:
    """The power states in this family's answers."""
    values = table.queries["power"].values if "power" in table.queries else {}
    return frozenset(Power(word) for word in values.values())


def checked_address(table: SerialTable, address: str | None) -> str:
    """The address to use, in the same form as the profile's, e.g. two digits. PluginError("setting-wrong")."""
    if address is None:
        return table.address
    alike = len(address) == len(table.address) and address.isascii() and address.isalnum()
    if not alike or (table.address.isdigit() and not address.isdigit()):
        raise PluginError(
            "setting-wrong",
            what=f"The address {address!r} is not like {table.address!r}.",
            remedy="Set address in stage.toml to the projector's number, or remove it.",
        )
    return address


def read_settings(
    settings: Mapping[str, Any], context: OpenContext
) -> tuple[ProjectorProfile, Path | str, int, str | None]:
    """Profile, port, baud rate and address of a stage.toml table. Raises PluginError and ProtocolError.

    The port is a file, or the URL of a device server.
    """
    profile = load_profile(setting(settings, "profile", str), context.stage)
    table = serial_table(profile)
    address = setting(settings, "address", str)
    checked_address(table, address)
    baud = setting(settings, "baud", int, table.baud)
    if not baud:
        raise PluginError(
            "profile-not-serial",
            what=f"The profile {profile.name!r} is for a network port.",
            remedy='Use the driver "network" with the projector\'s address.',
        )
    port = setting(settings, "port", str)
    if is_url(port):
        parse_url(port)
        return profile, port, baud, address
    # Not resolved: the symlink is the stable name, and leads elsewhere after the adapter was unplugged.
    return profile, context.stage / port, baud, address
