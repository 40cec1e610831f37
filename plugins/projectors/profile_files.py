"""Finds a projector's profile: a shipped one by its name, or a file of the stage; and what the profile and stage.toml
together say about a serial line.
"""

from __future__ import annotations

from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import Any

from hal.codecs.projectors.profiles import ProjectorProfile, parse_profile
from hal.codecs.projectors.serial_table import SerialTable
from hal.errors import PluginError
from hal.registry import OpenContext, setting
from hal.runtime.files import read_text
from hal.values import Power
from plugins.projectors.network.device_server import is_url, parse_url


def shipped_profiles() -> tuple[str, ...]:
    """Names of the shipped projector profiles, sorted."""
    folder = resources.files("firmware_configs") / "projectors"
    return tuple(sorted(entry.name.removesuffix(".toml") for entry in folder.iterdir() if entry.name.endswith(".toml")))


def profile_text(profile: str, stage: Path) -> tuple[str, str]:
    """The text of a profile, and its name for messages.

    ``profile`` is the name of a shipped profile, or a path, relative to the stage folder, that ends in ``.toml``.
    Raises PluginError("profile-missing") or PluginError("profile-unreadable").
    """
    if not profile.endswith(".toml"):
        if profile not in shipped_profiles():
            raise _missing(f"The projector profile {profile!r} does not exist.")
        shipped = resources.files("firmware_configs") / "projectors" / f"{profile}.toml"
        return shipped.read_text(encoding="utf-8"), f"{profile}.toml"
    path = stage / profile
    try:
        return read_text(path), str(path)
    except FileNotFoundError as error:
        raise _missing(f"The profile file {path} does not exist.") from error
    except OSError as error:
        raise _unreadable(path, error.strerror or "it can't be read") from error
    except UnicodeDecodeError as error:
        raise _unreadable(path, "it is not UTF-8 text") from error


def load_profile(profile: str, stage: Path) -> ProjectorProfile:
    """Find and read a profile; as ``profile_text``, and ProtocolError("profile-wrong") for wrong content."""
    text, file = profile_text(profile, stage)
    return parse_profile(text, file=file)


def _missing(what: str) -> PluginError:
    return PluginError(
        "profile-missing",
        what=what,
        remedy=f"Use one of {', '.join(shipped_profiles())}, or a .toml file in the stage folder.",
    )


def _unreadable(path: Path, why: str) -> PluginError:
    return PluginError(
        "profile-unreadable", what=f"The profile {path} could not be read: {why}.", remedy="Check the file."
    )


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
