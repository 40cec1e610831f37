"""Outlets of a PDU by SNMP version 1 or 2c: APC, and others whose object identifiers are in stage.toml.

Source: APC's PowerNet MIB (rPDUOutletControlOutletCommand, sPDUOutletCtl).
"""

from __future__ import annotations

import asyncio
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

from hal.errors import DeviceRefused, DeviceTimeout, PluginError, ProtocolError
from hal.links import host_and_port
from hal.outlets import Outlets, outlets_driver, whole_number
from hal.registry import setting

PORT: Final = 161
PDUS: Final = {"apc": "1.3.6.1.4.1.318.1.1.12.3.3.1.1.4", "apc-masterswitch": "1.3.6.1.4.1.318.1.1.4.4.2.1.3"}
"""Control column of each family: 1 switches on, 2 off, and reads the same."""
_DESCRIPTION: Final = "1.3.6.1.2.1.1.1.0"
_OID: Final = re.compile(r"\d+(?:\.\d+){3,60}")
_ANSWER_S: Final = 1.0
_SETTLE_S: Final = 5.0
"""A PDU switches some time after it has accepted."""


@dataclass(frozen=True, slots=True)
class SnmpAgent:
    """The SNMP agent of a PDU, and the community that it is asked with. ``version``: 1, or 2 for 2c."""

    host: str
    port: int
    community: str
    version: int

    @property
    def name(self) -> str:
        return f"The PDU at {self.host}:{self.port}"

    def describe(self) -> str:
        """The printable part of its description, at most 80 characters."""
        words = "".join(character for character in str(self.get(_DESCRIPTION)) if character.isprintable()).strip()
        return words[:80] or "PDU"

    def get(self, oid: str) -> object:
        """The value of an object."""
        return asyncio.run(self._request(oid))

    def set(self, oid: str, value: int) -> None:
        """Set an object; the command is sent once."""
        asyncio.run(self._request(oid, value))

    async def _request(self, oid: str, value: int | None = None) -> object:
        from pysnmp.hlapi.v1arch import asyncio as snmp
        from pysnmp.proto.rfc1902 import Integer32

        identity = snmp.ObjectIdentity(oid)
        thing = snmp.ObjectType(identity) if value is None else snmp.ObjectType(identity, Integer32(value))
        with snmp.SnmpDispatcher() as dispatcher:
            retries = 0 if value is not None else 1
            target = await snmp.UdpTransportTarget.create((self.host, self.port), timeout=_ANSWER_S, retries=retries)
            ask = snmp.get_cmd if value is None else snmp.set_cmd
            data = snmp.CommunityData(self.community, mpModel=self.version - 1)
            failure, status, _, bound = await ask(dispatcher, data, target, thing)
        if failure:
            raise DeviceTimeout(
                "outlets-no-answer",
                what=f"{self.name} did not answer ({failure}).",
                remedy="Check its address, its network cable, and the community in stage.toml.",
            )
        if status:
            raise DeviceRefused(
                "outlets-refused",
                what=f"{self.name} refused: {status.prettyPrint()}.",
                remedy="Check that the community may write, and that the outlet exists.",
            )
        return bound[0][1]


@dataclass(frozen=True, slots=True)
class ControlColumn:
    """Where a PDU's outlets are switched: the channel follows ``column``; ``on`` and ``off`` are its values."""

    agent: SnmpAgent
    column: str
    on: int
    off: int

    def get(self, channel: int) -> bool:
        """Whether an outlet is on. Raises ProtocolError("outlets-garbage")."""
        value = str(self.agent.get(f"{self.column}.{channel}"))
        if value not in (str(self.on), str(self.off)):
            raise ProtocolError(
                "outlets-garbage",
                what=f"{self.agent.name} reports {value[:40]!r} for channel {channel}.",
                remedy="Check pdu, or column, on and off in stage.toml.",
            )
        return value == str(self.on)

    def set(self, channel: int, on: bool) -> None:
        """Switch an outlet."""
        self.agent.set(f"{self.column}.{channel}", self.on if on else self.off)


def _outlets(settings: Mapping[str, Any]) -> Outlets:
    host, port = host_and_port(str(setting(settings, "address", str)), PORT)
    column, pdu = setting(settings, "column", str, ""), setting(settings, "pdu", str, "apc")
    on, off = setting(settings, "on", int, 1), setting(settings, "off", int, 2)
    if not column and pdu not in PDUS:
        raise _wrong("pdu", f"it is not one of {', '.join(PDUS)}")
    if column and not _OID.fullmatch(column):
        raise _wrong("column", "it is not an object identifier such as 1.3.6.1.4.1.318.1.1.12.3.3.1.1.4")
    if on == off:
        raise _wrong("off", "it is the same as on")
    community, version = setting(settings, "community", str, "private"), whole_number(settings, "version", 1, 2, 1)
    agent = SnmpAgent(host, port, community, version)
    outlets = ControlColumn(agent, column or PDUS[pdu], on, off)
    channels = whole_number(settings, "channels", 1, 96)
    return Outlets(agent.name, channels, outlets.get, outlets.set, agent.describe, settle_s=_SETTLE_S)


def _wrong(key: str, why: str) -> PluginError:
    return PluginError(
        "setting-wrong", what=f"The setting '{key}' of the PDU is wrong: {why}.", remedy=f"Correct {key} in stage.toml."
    )


DRIVER: Final = outlets_driver(
    "snmp-pdu",
    summary="Outlets of a PDU by SNMP version 1 or 2c, such as APC's (needs the extra mains).",
    settings={
        "address": 'host, or host:port for another port than 161, e.g. "192.168.0.30"',
        "channels": "how many outlets it has, 1 to 96",
        "community": 'the community that may write (default: "private")',
        "version": "1 (default), or 2 for version 2c",
        "pdu": '"apc" (default), or "apc-masterswitch" for older ones',
        "column": "object identifier of the outlets' control column, for other makers",
        "on": "the value that switches on (default: 1)",
        "off": "the value that switches off (default: 2)",
    },
    required=("address", "channels"),
    outlets=_outlets,
    library="pysnmp",
)
