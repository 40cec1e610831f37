"""A session is recorded, and its devices are replayed: to the same driver, and to other programs."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import pytest
from aiopjlink import PJLink
from aiopjlink import Power as PjPower
from pypjlink import Projector as PyPjLink

from hal.deadline import in_seconds
from hal.interfaces import Projector
from hal.registry import OpenContext
from hal.tape import Tape
from hal.values import DeviceIdentity, ExposureSettings, Power, ProjectorStatus
from lab.emulated.cameras.camera import EmulatedPtpCamera, Flavour
from lab.emulated.projectors.boards import BOARDS, baud_of
from lab.emulated.projectors.pjlink import EmulatedPjLinkProjector
from lab.emulated.tape import serve_tape
from plugins.emulated.core.truth import DEFAULT_BOARD
from plugins.emulated.projectors.lamp import EmulatedLamp, LampTiming, quick_profile
from plugins.emulated.projectors.serial import EmulatedSerialProjector
from plugins.gphoto2.camera import open_camera as open_gphoto2
from plugins.projectors.pjlink import open_pjlink_projector
from plugins.projectors.serial import open_serial_projector
from plugins.ptp.camera import open_camera
from tests.campaigns.camera_peers import SIZE, network_peer
from tests.lab.emulated.tape.relay import ptpip_relays, stream_relay
from tests.plugins.ptp.ptp_rig import FLAVOURS, Studio

QUICK = LampTiming(0.1, 0.1)
EXPOSURE = ExposureSettings(0.125, 200, raw=False)
Seen = tuple[DeviceIdentity, ProjectorStatus]


@dataclass
class Served:
    """The devices of a tape: their addresses by kind."""

    addresses: dict[str, str] = field(default_factory=dict)

    def add(self, device: str, kind: str, address: str) -> None:
        self.addresses[kind] = address


@contextlib.contextmanager
def replayed(tape: Path) -> Iterator[dict[str, str]]:
    served = Served()
    with contextlib.ExitStack() as stack:
        assert serve_tape(tape, tape.parent / "run", stack, served.add, time_scale=0.0) == 1
        yield served.addresses


@contextlib.contextmanager
def recording(folder: Path) -> Iterator[Tape]:
    tape = Tape(folder / "session.tape")
    yield tape
    tape.close()


def looked_at(projector: Projector) -> Seen:
    """Its identity and state, seen by a driver that is closed then."""
    try:
        return projector.identity(deadline=in_seconds(20)), projector.status(deadline=in_seconds(20))
    finally:
        projector.close()


@pytest.mark.parametrize("family", [family for family in BOARDS if baud_of(family)])
def test_every_serial_family_is_replayed_to_its_driver(family: str, tmp_path: Path) -> None:
    (tmp_path / "p.toml").write_text(quick_profile(QUICK, base=family))
    lamp = EmulatedLamp(QUICK)
    lamp.warm_now()
    board = None if family == DEFAULT_BOARD else BOARDS[family](lamp)
    settings = {"profile": "p.toml", "port": "run/tty"}
    with recording(tmp_path) as tape, EmulatedSerialProjector(
        tmp_path / "run" / "tty", lamp, baud=baud_of(family), board=board
    ):  # fmt: skip
        real = looked_at(open_serial_projector(settings, OpenContext(tmp_path, tape=tape), in_seconds(20)))
    with replayed(tape.path) as addresses:
        again = {**settings, "port": addresses["serial"]}
        assert looked_at(open_serial_projector(again, OpenContext(tmp_path), in_seconds(20))) == real


def test_a_pjlink_session_is_replayed_with_its_lamp_and_without_its_password(tmp_path: Path) -> None:
    lamp = EmulatedLamp(QUICK)
    with recording(tmp_path) as tape, EmulatedPjLinkProjector(lamp, password="secret") as emulated:
        settings = {"address": emulated.address, "password": "secret"}
        driver = open_pjlink_projector(settings, OpenContext(tmp_path, tape=tape), in_seconds(20))
        assert driver.status(deadline=in_seconds(20)).power is Power.OFF
        driver.switch_on(deadline=in_seconds(20))
        ends = in_seconds(20)
        while driver.status(deadline=in_seconds(20)).power is not Power.ON:
            assert not ends.passed
            ends.sleep(0.05)
        driver.close()
    assert "secret" not in tape.path.read_text()
    with replayed(tape.path) as addresses:
        again = open_pjlink_projector({"address": addresses["pjlink"]}, OpenContext(tmp_path), in_seconds(20))
        for _ in range(5):  # however often it is asked before the command
            assert again.status(deadline=in_seconds(20)).power is Power.OFF
        again.switch_on(deadline=in_seconds(20))
        ends = in_seconds(20)
        while again.status(deadline=in_seconds(20)).power is not Power.ON:
            assert not ends.passed
        again.close()


def test_a_tape_of_one_pjlink_program_is_replayed_to_another(tmp_path: Path) -> None:
    """Recorded from pypjlink2, replayed to aiopjlink: neither is ours."""
    lamp = EmulatedLamp(QUICK)
    with recording(tmp_path) as tape, EmulatedPjLinkProjector(lamp, password="secret", name="hall") as emulated:
        host, port = emulated.address.split(":")
        with stream_relay(host, int(port), tape, kind="pjlink") as relay:
            program = PyPjLink.from_address("127.0.0.1", relay.port)
            program.authenticate(lambda: "secret")
            assert program.get_power() == "off"
            assert program.get_name() == "hall"
            program.set_power("on")
            program.f.close()
    assert lamp.strikes == 1

    async def other(address: str) -> tuple[PjPower.State, str]:
        host, port = address.split(":")
        async with PJLink(address=host, port=int(port), password=None) as link:
            before = await link.power.get()
            await link.power.turn_on()
            return before, await link.info.projector_name()

    with replayed(tape.path) as addresses:
        assert asyncio.run(other(addresses["pjlink"])) == (PjPower.State.OFF, "hall")


@pytest.mark.parametrize("flavour", FLAVOURS)
def test_every_camera_family_is_replayed_with_its_pictures(flavour: Flavour, tmp_path: Path) -> None:
    studio = Studio(size=40_000)
    pictures = []
    with recording(tmp_path) as tape, EmulatedPtpCamera(studio.expose, flavour=flavour, time_scale=0.1) as emulated:
        driver = open_camera({"address": emulated.address}, OpenContext(tmp_path, tape=tape), in_seconds(20))
        real = driver.identity(deadline=in_seconds(20))
        driver.configure(EXPOSURE, deadline=in_seconds(20))
        for number in range(2):
            files = driver.capture(tmp_path / str(number), deadline=in_seconds(20))
            pictures.append([file.path.read_bytes() for file in files])
        driver.close()
    assert pictures[0] != pictures[1]
    with replayed(tape.path) as addresses:
        again = open_camera({"address": addresses["camera"]}, OpenContext(tmp_path), in_seconds(20))
        assert again.identity(deadline=in_seconds(20)) == real
        again.configure(EXPOSURE, deadline=in_seconds(20))
        for number, picture in enumerate(pictures):
            files = again.capture(tmp_path / f"again-{number}", deadline=in_seconds(20))
            assert [file.path.read_bytes() for file in files] == picture
        again.close()


def test_a_tape_of_gphoto2_is_replayed_to_our_drivers(tmp_path: Path) -> None:
    """Recorded from Debian's gphoto2; the other library asks for more, and reads the file in blocks."""
    with recording(tmp_path) as tape, network_peer("generic") as peer:
        _, host, command, event = peer.port.split(":")
        commands, events = ptpip_relays(host, int(command), int(event), tape)
        with commands, events:
            peer.port = f"ptpip:127.0.0.1:{commands.port}:{events.port}"
            said = peer.gphoto2(
                *("--summary", "--set-config", "/main/capturesettings/shutterspeed=0.1"),
                *("--capture-image-and-download", "--filename", "shot.jpg"),
            )
            picture = (peer.folder / "shot.jpg").read_bytes()
    assert "Emulated camera" in said
    assert len(picture) > SIZE // 2
    with replayed(tape.path) as addresses:
        library = open_gphoto2({"address": addresses["camera"]}, OpenContext(tmp_path), in_seconds(20))
        files = library.capture(tmp_path / "library", deadline=in_seconds(20))
        assert [file.path.read_bytes() for file in files] == [picture]
        library.close()
