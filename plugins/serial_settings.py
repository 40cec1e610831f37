"""What a profile and the settings in stage.toml mean for the serial driver."""

from __future__ import annotations

from hal.errors import PluginError
from hal.profiles import ProjectorProfile
from hal.serial_table import SerialTable
from hal.values import Power


def serial_table(profile: ProjectorProfile) -> SerialTable:
    """The serial part of a profile. PluginError("profile-not-serial") if it has none."""
    if profile.serial is None:
        raise PluginError(
            "profile-not-serial",
            what=f"The profile {profile.name!r} has no serial commands.",
            remedy='Use another profile, or the driver "pjlink".',
        )
    return profile.serial


def told_powers(table: SerialTable) -> frozenset[Power]:
    """The power states that this family names in its answers."""
    values = table.queries["power"].values if "power" in table.queries else {}
    return frozenset(Power(word) for word in values.values())


def checked_address(table: SerialTable, address: str | None) -> str:
    """The address to use; it must look like the profile's own, e.g. two digits. PluginError("setting-wrong")."""
    if address is None:
        return table.address
    alike = len(address) == len(table.address) and address.isascii() and address.isalnum()
    if not alike or (table.address.isdigit() and not address.isdigit()):
        raise PluginError(
            "setting-wrong",
            what=f"The address {address!r} is not like {table.address!r}.",
            remedy="Set address in stage.toml to the projector's own number, or leave it out.",
        )
    return address
