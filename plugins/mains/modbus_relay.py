"""Relays by Modbus TCP: boards whose relays are coils. The caller keeps the lamp rules."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

from hal.deadline import Deadline
from hal.errors import DeviceGone, DeviceRefused, PluginError
from hal.links import host_and_port
from hal.registry import Driver, OpenContext, setting
from hal.values import DeviceIdentity
from plugins.mains.outlets import Outlets, answering, require_library

PORT: Final = 502
_ANSWER_S: Final = 1.0


class ModbusRelays:
    """``hal.interfaces.PowerSwitch``. ``first``: address of the coil of channel 1. A connection for each call."""

    def __init__(self, host: str, port: int, *, unit: int, first: int, channels: int) -> None:
        self._outlets = Outlets(f"The relay board at {host}:{port}", channels)
        self._place = (host, port)
        self._unit = unit
        self._first = first

    def identity(self, *, deadline: Deadline) -> DeviceIdentity:
        self._outlets.run(self._coil(1), deadline)
        return DeviceIdentity("", f"Modbus relays, unit {self._unit}")

    def channels(self, *, deadline: Deadline) -> int:
        self._outlets.check(deadline)
        return self._outlets.count

    def state(self, channel: int, *, deadline: Deadline) -> bool:
        """See ``hal.interfaces.PowerSwitch.state``. Raises DeviceRefused("relay-no-channel")."""
        self._outlets.require(channel)
        return self._outlets.run(self._coil(channel), deadline)

    def switch(self, channel: int, closed: bool, *, deadline: Deadline) -> None:
        """Switch a relay, and check it. Raises DeviceRefused("relay-no-channel") or DeviceRefused("relay-stuck")."""
        self._outlets.require(channel)
        if self._outlets.run(self._coil(channel, closed), deadline) is not closed:
            raise self._outlets.stuck(channel, closed)

    def close(self) -> None:
        self._outlets.close()

    async def _coil(self, channel: int, closed: bool | None = None) -> bool:
        """Whether a coil is set, after it was written if ``closed`` is given. Nothing is written twice."""
        from pymodbus import ModbusException
        from pymodbus.client import AsyncModbusTcpClient

        host, port = self._place
        client = AsyncModbusTcpClient(host, port=port, timeout=_ANSWER_S, retries=0, reconnect_delay=0)
        address = self._first + channel - 1
        try:
            if not await client.connect():
                raise self._gone("it does not accept a connection")
            if closed is not None:
                self._checked(await client.write_coil(address, closed, device_id=self._unit))
            return bool(self._checked(await client.read_coils(address, count=1, device_id=self._unit)).bits[0])
        except ModbusException as error:
            raise self._gone(str(error)[:80]) from error
        finally:
            client.close()

    def _checked(self, answer: Any) -> Any:
        if answer.isError():
            raise DeviceRefused(
                "outlets-refused",
                what=f"{self._outlets.name} refused with exception {getattr(answer, 'exception_code', 'unknown')}.",
                remedy="Check unit, first and channels in stage.toml.",
            )
        return answer

    def _gone(self, why: str) -> DeviceGone:
        return DeviceGone(
            "outlets-gone",
            what=f"{self._outlets.name} can't be reached: {why}.",
            remedy="Check its power, its network cable, its address, and unit in stage.toml.",
        )


def _read(settings: Mapping[str, Any]) -> dict[str, Any]:
    host, port = host_and_port(str(setting(settings, "address", str)), PORT)
    numbers = {
        "unit": setting(settings, "unit", int, 1),
        "first": setting(settings, "first", int, 0),
        "channels": setting(settings, "channels", int),
    }
    allowed = {"unit": (0, 255), "first": (0, 65_000), "channels": (1, 256)}
    for key, (low, high) in allowed.items():
        if not low <= numbers[key] <= high:
            raise PluginError(
                "setting-wrong",
                what=f"The setting '{key}' is {numbers[key]}, not {low} to {high}.",
                remedy=f"Correct {key} in stage.toml.",
            )
    return {"host": host, "port": port, **numbers}


def open_modbus_relays(settings: Mapping[str, Any], context: OpenContext, deadline: Deadline) -> ModbusRelays:
    """Open the board of a stage's table: read its first coil."""
    require_library("pymodbus")
    return answering(ModbusRelays(**_read(settings)), deadline)


def check_modbus_relays(settings: Mapping[str, Any], context: OpenContext) -> None:
    """As ``hal.registry.Driver.check``."""
    _read(settings)


DRIVER: Final = Driver(
    kind="power_switch",
    name="modbus-relays",
    summary="Relay boards by Modbus TCP, whose relays are coils (needs the extra mains).",
    open=open_modbus_relays,
    settings={
        "address": 'host, or host:port for another port than 502, e.g. "192.168.0.31"',
        "channels": "how many relays it has, 1 to 256",
        "unit": "the board's unit number (default: 1)",
        "first": "address of the coil of channel 1, counted from 0 (default: 0)",
    },
    required=("address", "channels"),
    check=check_modbus_relays,
)
