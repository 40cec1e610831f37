"""Relays by Modbus TCP: boards whose relays are coils."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

from hal.errors import DeviceGone, DeviceRefused
from hal.links import host_and_port
from hal.outlets import Outlets, outlets_driver, whole_number
from hal.registry import setting

PORT: Final = 502
_ANSWER_S: Final = 1.0


@dataclass(frozen=True, slots=True)
class ModbusBoard:
    """A board and where its coils begin: ``first`` is the address of the coil of channel 1. Each call connects."""

    host: str
    port: int
    unit: int
    first: int

    @property
    def name(self) -> str:
        return f"The relay board at {self.host}:{self.port}"

    def describe(self) -> str:
        """Its name, once it answers."""
        self.coil(1)
        return f"Modbus relays, unit {self.unit}"

    def coil(self, channel: int) -> bool:
        """Whether a relay is closed."""
        return asyncio.run(self._coil(self.first + channel - 1))

    def write_coil(self, channel: int, closed: bool) -> None:
        """Close or open a relay; the command is sent once."""
        asyncio.run(self._coil(self.first + channel - 1, closed))

    async def _coil(self, address: int, closed: bool | None = None) -> bool:
        from pymodbus import ModbusException
        from pymodbus.client import AsyncModbusTcpClient

        client = AsyncModbusTcpClient(self.host, port=self.port, timeout=_ANSWER_S, retries=0, reconnect_delay=0)
        try:
            if not await client.connect():
                raise self._gone("it does not accept a connection")
            if closed is not None:
                self._checked(await client.write_coil(address, closed, device_id=self.unit))
                return closed
            return bool(self._checked(await client.read_coils(address, count=1, device_id=self.unit)).bits[0])
        except ModbusException as error:
            raise self._gone(str(error)[:80]) from error
        finally:
            client.close()

    def _checked(self, answer: Any) -> Any:
        if answer.isError():
            raise DeviceRefused(
                "outlets-refused",
                what=f"{self.name} refused with exception {getattr(answer, 'exception_code', 'unknown')}.",
                remedy="Check unit, first and channels in stage.toml.",
            )
        return answer

    def _gone(self, why: str) -> DeviceGone:
        return DeviceGone(
            "outlets-gone",
            what=f"{self.name} can't be reached: {why}.",
            remedy="Check its power, its network cable, its address, and unit in stage.toml.",
        )


def _outlets(settings: Mapping[str, Any]) -> Outlets:
    host, port = host_and_port(str(setting(settings, "address", str)), PORT)
    unit, first = whole_number(settings, "unit", 0, 255, 1), whole_number(settings, "first", 0, 65_000, 0)
    board = ModbusBoard(host, port, unit, first)
    channels = whole_number(settings, "channels", 1, 256)
    return Outlets(board.name, channels, board.coil, board.write_coil, board.describe)


DRIVER: Final = outlets_driver(
    "modbus-relays",
    summary="Relay boards by Modbus TCP, whose relays are coils (needs the extra mains).",
    settings={
        "address": 'host, or host:port for another port than 502, e.g. "192.168.0.31"',
        "channels": "how many relays it has, 1 to 256",
        "unit": "the board's unit number (default: 1)",
        "first": "address of the coil of channel 1, counted from 0 (default: 0)",
    },
    required=("address", "channels"),
    outlets=_outlets,
    library="pymodbus",
)
