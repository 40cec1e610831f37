"""Outlets of a PDU by SNMP version 1 or 2c: APC, and others whose object identifiers are in stage.toml.

Source: APC's PowerNet MIB (rPDUOutletControlOutletCommand, sPDUOutletCtl). The caller keeps the lamp rules.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any, Final

from hal.deadline import Deadline
from hal.errors import DeviceRefused, DeviceTimeout, PluginError, ProtocolError
from hal.links import host_and_port
from hal.registry import Driver, OpenContext, setting
from hal.values import DeviceIdentity
from plugins.mains.outlets import Outlets, answering, require_library

PORT: Final = 161
PDUS: Final = {
    "apc": "1.3.6.1.4.1.318.1.1.12.3.3.1.1.4",
    "apc-masterswitch": "1.3.6.1.4.1.318.1.1.4.4.2.1.3",
}
"""Control column of each family: 1 switches on, 2 off, and reads the same."""
_DESCRIPTION: Final = "1.3.6.1.2.1.1.1.0"
_OID: Final = re.compile(r"\d+(?:\.\d+){3,60}")
_ANSWER_S: Final = 1.0
_SETTLE_S: Final = 5.0
"""A PDU switches some time after it has accepted."""


class SnmpPdu:
    """``hal.interfaces.PowerSwitch``. ``column``: OID of the control column; the channel follows it.

    ``on``, ``off``: its values.
    """

    def __init__(
        self, host: str, port: int, *, community: str, version: int, column: str, on: int, off: int, channels: int
    ) -> None:
        self._outlets = Outlets(f"The PDU at {host}:{port}", channels)
        self._target = (host, port)
        self._community = (community, version - 1)
        self._column = column
        self._values = {True: on, False: off}

    def identity(self, *, deadline: Deadline) -> DeviceIdentity:
        reply = self._outlets.run(self._request(_DESCRIPTION), deadline)
        words = "".join(character for character in str(reply) if character.isprintable()).strip()
        return DeviceIdentity("", words[:80] or "PDU")

    def channels(self, *, deadline: Deadline) -> int:
        self._outlets.check(deadline)
        return self._outlets.count

    def state(self, channel: int, *, deadline: Deadline) -> bool:
        """See ``hal.interfaces.PowerSwitch.state``. Raises DeviceRefused("relay-no-channel") and ProtocolError."""
        self._outlets.require(channel)
        value = self._outlets.run(self._request(self._oid(channel)), deadline)
        for closed, number in self._values.items():
            if str(value) == str(number):
                return closed
        raise ProtocolError(
            "outlets-garbage",
            what=f"{self._outlets.name} reports {str(value)[:40]!r} for channel {channel}.",
            remedy="Check pdu, or column, on and off in stage.toml.",
        )

    def switch(self, channel: int, closed: bool, *, deadline: Deadline) -> None:
        """Switch an outlet, and check it; no effect if it is so already. Raises DeviceRefused("relay-stuck") too."""
        if self.state(channel, deadline=deadline) is closed:
            return
        self._outlets.run(self._request(self._oid(channel), self._values[closed]), deadline)
        patience = deadline.within(_SETTLE_S)
        while self.state(channel, deadline=deadline) is not closed:
            if patience.passed:
                raise self._outlets.stuck(channel, closed)
            patience.sleep(0.2)

    def close(self) -> None:
        self._outlets.close()

    def _oid(self, channel: int) -> str:
        return f"{self._column}.{channel}"

    async def _request(self, oid: str, value: int | None = None) -> object:
        """The value of an object, after it was set to ``value`` if that is given. A set is sent once only."""
        from pysnmp.hlapi.v1arch import asyncio as snmp
        from pysnmp.proto.rfc1902 import Integer32

        identity = snmp.ObjectIdentity(oid)
        thing = snmp.ObjectType(identity) if value is None else snmp.ObjectType(identity, Integer32(value))
        community, model = self._community
        with snmp.SnmpDispatcher() as dispatcher:
            retries = 0 if value is not None else 1
            target = await snmp.UdpTransportTarget.create(self._target, timeout=_ANSWER_S, retries=retries)
            ask = snmp.get_cmd if value is None else snmp.set_cmd
            data = snmp.CommunityData(community, mpModel=model)
            failure, status, _, bound = await ask(dispatcher, data, target, thing)
        if failure:
            raise DeviceTimeout(
                "outlets-no-answer",
                what=f"{self._outlets.name} did not answer ({failure}).",
                remedy="Check its address, its network cable, and the community in stage.toml.",
            )
        if status:
            raise DeviceRefused(
                "outlets-refused",
                what=f"{self._outlets.name} refused: {status.prettyPrint()}.",
                remedy="Check that the community may write, and that the outlet exists.",
            )
        return bound[0][1]


def _read(settings: Mapping[str, Any]) -> dict[str, Any]:
    host, port = host_and_port(str(setting(settings, "address", str)), PORT)
    column = setting(settings, "column", str, "")
    pdu = setting(settings, "pdu", str, "apc")
    version = setting(settings, "version", int, 1)
    channels = setting(settings, "channels", int)
    on, off = setting(settings, "on", int, 1), setting(settings, "off", int, 2)
    if not column and pdu not in PDUS:
        raise _wrong("pdu", f"it is not one of {', '.join(PDUS)}")
    if column and not _OID.fullmatch(column):
        raise _wrong("column", "it is not an object identifier such as 1.3.6.1.4.1.318.1.1.12.3.3.1.1.4")
    if version not in (1, 2):
        raise _wrong("version", "it is not 1 or 2")
    if not 1 <= channels <= 96 or on == off:
        raise _wrong("channels", "it is not 1 to 96, or on and off are the same")
    return {
        "host": host, "port": port, "community": setting(settings, "community", str, "private"), "version": version,
        "column": column or PDUS[pdu], "on": on, "off": off, "channels": channels,
    }  # fmt: skip


def _wrong(key: str, why: str) -> PluginError:
    return PluginError(
        "setting-wrong", what=f"The setting '{key}' of the PDU is wrong: {why}.", remedy=f"Correct {key} in stage.toml."
    )


def open_snmp_pdu(settings: Mapping[str, Any], context: OpenContext, deadline: Deadline) -> SnmpPdu:
    """Open the PDU of a stage's table: ask it for its description."""
    require_library("pysnmp")
    return answering(SnmpPdu(**_read(settings)), deadline)


def check_snmp_pdu(settings: Mapping[str, Any], context: OpenContext) -> None:
    """As ``hal.registry.Driver.check``."""
    _read(settings)


DRIVER: Final = Driver(
    kind="power_switch",
    name="snmp-pdu",
    summary="Outlets of a PDU by SNMP version 1 or 2c, such as APC's (needs the extra mains).",
    open=open_snmp_pdu,
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
    check=check_snmp_pdu,
)
