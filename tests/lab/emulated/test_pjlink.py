"""The emulated PJLink projector against a client by other authors (aiopjlink)."""

from __future__ import annotations

import socket
from typing import Any

import pytest
from aiopjlink import Lamp as PjLamp
from aiopjlink import PJLinkERR3, PJLinkPassword

from hal.errors import DeviceError
from lab.emulated.projectors.pjlink import EmulatedPjLinkProjector
from plugins.emulated.projectors.lamp import EmulatedLamp, LampTiming
from tests.aiopjlink_client import talk


def test_an_independent_client_switches_it_on_and_off() -> None:
    lamp = EmulatedLamp(LampTiming(0.0, 600.0))

    async def cycle(link: Any) -> list[str]:
        seen = [(await link.power.get()).name]
        await link.power.turn_on()
        seen.append((await link.power.get()).name)
        await link.power.turn_off()
        seen.append((await link.power.get()).name)
        with pytest.raises(PJLinkERR3):
            await link.power.turn_on()
        return seen

    with EmulatedPjLinkProjector(lamp) as emulator:
        assert talk(emulator.address, cycle) == ["OFF", "ON", "COOLING"]
    assert lamp.strikes == 1


def test_an_independent_client_reads_everything_it_knows() -> None:
    lamp = EmulatedLamp(LampTiming(0.0, 600.0), hours=321.0)
    lamp.warm_now()

    async def read(link: Any) -> tuple[Any, ...]:
        await link.mute.video(True)
        muted = await link.mute.status()
        await link.sources.set(link.sources.Mode.DIGITAL, 2)
        return (
            muted,
            await link.lamps.status(),
            await link.sources.get(),
            await link.sources.available(),
            await link.info.manufacturer_name(),
            await link.info.projector_name(),
            await link.info.serial_number(),
            await link.errors.query(),
        )

    with EmulatedPjLinkProjector(lamp, name="left") as emulator:
        muted, lamps, source, sources, maker, name, serial, errors = talk(emulator.address, read, None)
    assert muted == (True, False)
    assert lamps == [(321, PjLamp.State.ON)]
    assert (source[0].name, source[1]) == ("DIGITAL", "2")
    assert len(sources) == 4
    assert (maker, name, serial) == ("Velatura", "left", "VE-0001")
    assert {level.name for level in errors.values()} == {"OK"}
    assert lamp.light_level() == 0.0


def test_an_independent_client_passes_the_password_and_fails_without() -> None:
    async def power(link: Any) -> str:
        return str((await link.power.get()).name)

    with EmulatedPjLinkProjector(EmulatedLamp(LampTiming(0.0, 0.0)), password="JBMIAProjectorLink") as emulator:
        assert talk(emulator.address, power, "JBMIAProjectorLink") == "OFF"
        with pytest.raises(PJLinkPassword):
            talk(emulator.address, power, "wrong")
        with pytest.raises(PJLinkPassword):
            talk(emulator.address, power, None)


def test_a_port_in_use_is_named() -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        with pytest.raises(DeviceError) as caught:
            EmulatedPjLinkProjector(EmulatedLamp(LampTiming(0.0, 0.0)), port=port).start()
    assert caught.value.code == "port-in-use"
    assert str(port) in caught.value.what


def test_a_flood_without_an_end_is_cut_off() -> None:
    with EmulatedPjLinkProjector(EmulatedLamp(LampTiming(0.0, 0.0))) as emulator:
        host, port = emulator.address.split(":")
        with socket.create_connection((host, int(port)), timeout=20) as client:
            assert client.recv(100) == b"PJLINK 0\r"
            client.sendall(b"x" * 1000)
            assert client.recv(100) == b""


@pytest.mark.parametrize(
    ("command", "answer"),
    [
        (b"%1POWR 2\r", b"%1POWR=ERR2\r"),
        (b"%1NONE ?\r", b"%1NONE=ERR1\r"),
        (b"%1INPT ?\r", b"%1INPT=ERR3\r"),
        (b"%1powr ?\r", b"%1POWR=0\r"),
        (b"%1SNUM ?\r", b"%1SNUM=ERR1\r"),
    ],
)
def test_it_answers_mistakes_as_the_specification_says(command: bytes, answer: bytes) -> None:
    with EmulatedPjLinkProjector(EmulatedLamp(LampTiming(0.0, 0.0))) as emulator:
        host, port = emulator.address.split(":")
        with socket.create_connection((host, int(port)), timeout=20) as client:
            client.recv(100)
            client.sendall(command)
            assert client.recv(100) == answer
