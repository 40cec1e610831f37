"""The emulated serial projectors against clients by other authors: benqprojector and epson-projector."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from pathlib import Path

import pytest
from benqprojector.benqprojector import BenQProjectorSerial
from epson_projector import Projector as EpsonProjector
from epson_projector.const import SERIAL

from lab.emulated.projectors.boards_text import BenqBoard, EpsonBoard
from plugins.emulated.projectors.board import Board
from plugins.emulated.projectors.lamp import EmulatedLamp, LampPhase, LampTiming
from plugins.emulated.projectors.serial import EmulatedSerialProjector

TIMING = LampTiming(warm_up_s=0.3, cool_down_s=0.6)


def talked(
    port: Path, make: Callable[[EmulatedLamp], Board], baud: int, talk: Callable[[str, EmulatedLamp], Awaitable[None]]
) -> None:
    """Run a client's conversation with a projector on ``port``; it must end within a minute."""
    lamp = EmulatedLamp(TIMING)
    with EmulatedSerialProjector(port, lamp, baud=baud, board=make(lamp)):
        asyncio.run(asyncio.wait_for(talk(str(port), lamp), 60))


async def until(lamp: EmulatedLamp, phase: LampPhase) -> None:
    while lamp.phase is not phase:
        await asyncio.sleep(0.05)


@pytest.mark.filterwarnings("ignore:open_text is deprecated:DeprecationWarning")
def test_benqprojector_finds_the_prompt_and_switches(tmp_path: Path) -> None:
    async def talk(port: str, lamp: EmulatedLamp) -> None:
        client = BenQProjectorSerial(port, 115200, model_hint="W1110")
        assert await client.connect()
        assert client.has_prompt
        assert client.power_status == client.POWERSTATUS_OFF
        assert await client.turn_on()
        await until(lamp, LampPhase.LIT)
        assert await client.send_command("pow") == "on"
        assert await client.send_command("ltim") == "1200"
        assert await client.send_command("lampm") == "lnor"
        assert await client.send_command("lampm", "eco") == "eco"
        assert await client.send_command("vkeystone") == "0"
        assert await client.send_command("blank", "on") == "on"
        assert lamp.shutter_closed
        # Its turn_off waits for half a minute after turn_on, so the command alone.
        assert await client.send_command("pow", "off") == "off"
        await until(lamp, LampPhase.STANDBY)
        assert await client.send_command("pow") == "off"
        assert lamp.strikes == 1
        await client.disconnect()

    talked(tmp_path / "benq", BenqBoard, 115200, talk)


def test_epson_projector_makes_whole_power_cycles(tmp_path: Path) -> None:
    async def talk(port: str, lamp: EmulatedLamp) -> None:
        for number in (1, 2, 3):
            client = EpsonProjector(port, type=SERIAL)  # another one: each keeps silent for 40 s after PWR ON
            assert await client.get_power() == "00"
            assert await client.send_command("PWR ON") == "", "the colon alone, once the lamp burns"
            assert lamp.phase is LampPhase.LIT
            client.close()
            client = EpsonProjector(port, type=SERIAL)
            assert await client.get_power() == "01"
            assert await client.get_property("LAMP") == "1200"
            assert await client.get_serial_number() == "VE0000001"
            assert await client.send_command("PWR OFF") == ""
            client.close()
            client = EpsonProjector(port, type=SERIAL)
            assert await client.get_power() in ("03", "00")
            await until(lamp, LampPhase.STANDBY)
            assert await client.get_power() == "00"
            assert lamp.strikes == number
            client.close()

    talked(tmp_path / "epson", EpsonBoard, 9600, talk)
