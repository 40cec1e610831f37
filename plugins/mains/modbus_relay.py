"""Relays by Modbus TCP: boards whose relays are coils."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

from hal.errors import DeviceBusy, DeviceError, DeviceGone, DeviceRefused
from hal.links import host_and_port
from hal.outlets import Outlets, outlets_driver, whole_number
from hal.registry import setting

PORT: Final = 502
_ANSWER_S: Final = 1.0
_ATTEMPTS: Final = 3
_AGAIN_S: Final = 0.3
_SETTLE_S: Final = 5.0
"""A board may switch some time after it has accepted."""
_ACCEPTED: Final = 5
_BUSY: Final = 6
_BEHIND: Final = (10, 11)
_WORDS: Final = {
    1: "it has no such function, so its relays are not coils",
    2: "it has no coil at this address",
    3: "it does not take this value",
    4: "it has a fault",
    5: "it has accepted a request and still works on it",
    6: "it is busy with another request",
    10: "the gateway has no path to this unit",
    11: "the unit behind the gateway does not answer",
}
"""Exception codes of the MODBUS Application Protocol Specification, section 7."""


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

        for attempt in range(_ATTEMPTS):
            client = AsyncModbusTcpClient(self.host, port=self.port, timeout=_ANSWER_S, retries=0, reconnect_delay=0)
            sent = False
            try:
                if not await client.connect():
                    raise self._gone("it does not accept a connection")
                sent = closed is not None
                if closed is None:
                    answer: Any = await client.read_coils(address, count=1, device_id=self.unit)
                else:
                    answer = await client.write_coil(address, closed, device_id=self.unit)
                if not answer.isError():
                    return bool(answer.bits[0])
                refusal = getattr(answer, "exception_code", 0)
                if closed is not None and refusal == _ACCEPTED:
                    return closed  # it does so later
                if attempt + 1 == _ATTEMPTS or refusal not in (_ACCEPTED, _BUSY):
                    raise self._refused(refusal)
            except (ModbusException, DeviceGone) as error:
                # Boards with few connections close some for no reason. A command that may have arrived is sent once.
                if sent or attempt + 1 == _ATTEMPTS:
                    raise error if isinstance(error, DeviceGone) else self._gone(str(error)[:80]) from error
            finally:
                client.close()
            await asyncio.sleep(_AGAIN_S)
        raise AssertionError("the last attempt ends in an answer or an error")

    def _refused(self, code: int) -> DeviceError:
        busy = code in (_ACCEPTED, _BUSY)
        remedy = "Check unit, first and channels in stage.toml."
        if busy:
            remedy = "Check that no other program uses the board, and try again."
        elif code in _BEHIND:
            remedy = "Check unit in stage.toml, and the board behind the gateway: its power and its cable."
        return (DeviceBusy if busy else DeviceRefused)(
            "outlets-refused",
            what=f"{self.name} refused: {_WORDS.get(code, 'it gives no reason')} (exception {code}).",
            remedy=remedy,
        )

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
    return Outlets(board.name, channels, board.coil, board.write_coil, board.describe, settle_s=_SETTLE_S)


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
