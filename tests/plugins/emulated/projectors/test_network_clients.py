"""The emulated projectors on their LAN port against clients by other authors: pySDCP, pyjvcprojector,
jvc-projector-remote and christie-mseries.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import pysdcp
import pytest
from christie_mseries import ChristieClient, ChristieError, PowerState
from jvc_projector_remote import JVCProjector
from jvc_projector_remote.jvcprojector import JVCHandshakeError
from jvcprojector import JvcProjector, JvcProjectorAuthError
from jvcprojector.command import Input, LightPower, LightTime, Power  # type: ignore[attr-defined]

from lab.emulated.projectors.boards import BOARDS, login_of
from lab.emulated.projectors.boards_marked import ChristieBoard
from lab.emulated.projectors.network import GATES, EmulatedNetworkProjector, JvcHashedGate
from plugins.emulated.projectors.lamp import EmulatedLamp, LampPhase, LampTiming
from tests.waiting import wait_for

TIMING = LampTiming(warm_up_s=0.3, cool_down_s=0.5)
Start = Callable[..., tuple[EmulatedLamp, int]]


@pytest.fixture
def start() -> Iterator[Start]:
    """Start a projector of a family; returns its lamp and its TCP port."""
    started: list[EmulatedNetworkProjector] = []

    def make(family: str, **kwargs: Any) -> tuple[EmulatedLamp, int]:
        lamp = EmulatedLamp(TIMING)
        kwargs.setdefault("gate", GATES[login_of(family)])
        projector = EmulatedNetworkProjector(lamp, kwargs.pop("board", BOARDS[family])(lamp), **kwargs)
        projector.start()
        started.append(projector)
        return lamp, int(projector.address.rpartition(":")[2])

    yield make
    for projector in started:
        projector.stop()


def test_pysdcp_switches_a_sony(start: Start) -> None:
    lamp, port = start("sony-sdcp")
    client = pysdcp.Projector("127.0.0.1")
    client.TCP_PORT = port
    assert client.get_power() is False
    client.set_power(True)
    wait_for(lambda: lamp.phase is LampPhase.LIT)
    assert client.get_power() is True
    client.set_power(False)
    wait_for(lambda: lamp.phase is LampPhase.STANDBY)
    assert client.get_power() is False
    assert lamp.strikes == 1


@pytest.mark.parametrize(
    ("password", "gate"), [("", GATES["jvc"]), ("secret1234", GATES["jvc"]), ("secret1234", JvcHashedGate)]
)
def test_pyjvcprojector_logs_in_and_switches_a_jvc(start: Start, password: str, gate: Any) -> None:
    lamp, port = start("jvc", password=password, gate=gate)

    async def talk() -> None:
        client = JvcProjector("127.0.0.1", port=port, password=password or None)
        await client.connect()
        assert await client.get(Power) == Power.STANDBY
        await client.set(Power, Power.ON)
        while lamp.phase is not LampPhase.LIT:
            await asyncio.sleep(0.05)
        assert await client.get(Power) == Power.ON
        assert int(await client.get(LightTime)) == 1200
        assert await client.get(LightPower) == LightPower.LOW
        await client.set(LightPower, LightPower.HIGH)
        assert await client.get(LightPower) == LightPower.HIGH
        assert await client.get(Input) == Input.HDMI1
        await client.set(Power, Power.OFF)
        while await client.get(Power) != Power.STANDBY:
            await asyncio.sleep(0.05)
        await client.disconnect()

    asyncio.run(asyncio.wait_for(talk(), 60))
    assert lamp.strikes == 1


def test_pyjvcprojector_is_refused_with_another_password(start: Start) -> None:
    _, port = start("jvc", password="secret1234")

    async def talk() -> None:
        client = JvcProjector("127.0.0.1", port=port, password="wrong12345")
        with pytest.raises(JvcProjectorAuthError):
            await client.connect()
        await client.disconnect()

    asyncio.run(asyncio.wait_for(talk(), 60))


def test_jvc_projector_remote_makes_a_power_cycle(start: Start) -> None:
    lamp, port = start("jvc", password="secret12")
    client = JVCProjector("127.0.0.1", password="secret12", port=port)
    assert client.power_state() == "standby"
    client.power_on()
    wait_for(lambda: lamp.phase is LampPhase.LIT)
    assert client.is_on()
    client.power_off()
    wait_for(lambda: lamp.phase is LampPhase.STANDBY)
    assert client.power_state() == "standby"
    with pytest.raises(JVCHandshakeError):
        JVCProjector("127.0.0.1", password="wrong123", port=port).power_state()


def test_christie_mseries_reads_states_and_is_refused_what_is_not_there(start: Start) -> None:
    lamp, port = start("christie", board=partial(ChristieBoard, lamps=False))
    with ChristieClient("127.0.0.1", port=port) as client:
        assert client.query_value("PWR") == (0, "Standby")
        client.set("PWR", data=1)
        wait_for(lambda: lamp.phase is LampPhase.LIT)
        assert client.query_int("PWR") == PowerState.ON
        client.set("SHU", data=1)
        assert lamp.shutter_closed
        with pytest.raises(ChristieError):
            client.set("SHU", data=7)
        with pytest.raises(ChristieError):
            client.query("LPH")
        client.set("PWR", data=0)
    wait_for(lambda: lamp.phase is LampPhase.STANDBY)
    assert lamp.strikes == 1
