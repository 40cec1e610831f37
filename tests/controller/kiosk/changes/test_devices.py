"""What people change at projectors and camera is named: real drivers on pseudo terminals and TCP, not doubles."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from PIL import Image

from controller.config import load_stage
from controller.kiosk.changes.devices import (
    ASK_S,
    camera_facts,
    lens_facts,
    projector_facts,
    settings_facts,
    shown_facts,
)
from controller.kiosk.changes.inventory import Fact, Inventory
from controller.kiosk.changes.watch import changes, unknown
from controller.kiosk.outputs import connected
from controller.kiosk.world import World
from hal.deadline import Deadline, in_seconds
from hal.registry import OpenContext
from hal.values import DeviceIdentity, Power
from lab.emulated.cameras.camera import EmulatedPtpCamera
from lab.emulated.projectors.boards import BOARDS
from lab.emulated.projectors.boards_text import BenqBoard, BenqQuirks, EpsonBoard
from lab.emulated.projectors.pjlink import PjLinkOddities
from plugins.emulated.cameras.body import CameraNames
from plugins.emulated.projectors.lamp import EmulatedLamp, LampTiming
from plugins.ptp.camera import open_camera
from tests.controller.kiosk.install.test_outputs import LEFT, OFF, RIGHT
from tests.controller.kiosk.vase import vase
from tests.plugins.conftest import hasty, open_network, open_pjlink, open_serial, taped, wait_for_power
from tests.plugins.ptp.ptp_rig import Studio

__all__ = ["open_network", "open_pjlink", "open_serial", "taped"]
SOON = 30.0
LAMP = LampTiming(warm_up_s=0.2, cool_down_s=0.2)


def compared(before: tuple[Fact, ...], now: tuple[Fact, ...]) -> list[str]:
    return [one.sentence for one in changes(Inventory(1.0, "run", before), Inventory(2.0, "", now))]


def lit(pair: Any) -> Any:
    pair.driver.switch_on(deadline=in_seconds(SOON))
    wait_for_power(pair.driver, Power.ON)
    return pair


def adjusted(pair: Any) -> tuple[Fact, ...]:
    return tuple(projector_facts("left", pair.driver))


@pytest.mark.parametrize(
    ("command", "named"),
    [
        (b"SOURCE A0", "The input of projector left was 30, and is now A0."),
        (b"VKEYSTONE 140", "The keystone of projector left was 128, and is now 140."),
        (b"LUMINANCE 01", "The lamp mode of projector left was 00, and is now 01."),
    ],
)
def test_a_menu_of_a_serial_projector(open_serial: Any, command: bytes, named: str) -> None:
    lamp = EmulatedLamp(LAMP)
    board = EpsonBoard(lamp)
    pair = open_serial(profile="epson-escvp21", lamp=lamp, board=lambda _: board, edit=hasty)
    dark = adjusted(pair)
    assert {fact.kind for fact in dark if fact.value is None} == {"input", "keystone", "lamp mode"}
    before = adjusted(lit(pair))
    # A remote control does to the projector what this command does.
    assert board.feed(command + b"\r") == [b":"]
    now = adjusted(pair)
    assert compared(before, now) == [named]
    assert compared(before, dark) == []
    assert len(unknown(Inventory(1.0, "run", before), Inventory(2.0, "", dark))) == 3
    assert pair.driver.notices() == []


@pytest.mark.parametrize(
    ("profile", "commands", "named"),
    [
        ("benq", (b"\r*sour=RGB#\r", b"\r*vkeystone=+3#\r", b"\r*lampm=eco#\r"),
         ("input", "HDMI", "RGB", "keystone", "0", "+3", "lamp mode", "LNOR", "ECO")),
        ("jvc", (b"!\x89\x01IP7\n", b"!\x89\x01PMLP1\n"), ("input", "6", "7", "lamp mode", "0", "1")),
        ("panasonic-dz", (b"\x02ADZZ;IIS:SD1\x03", b"\x02ADZZ;LPM:3\x03"),
         ("input", "HD1", "SD1", "lamp mode", "0", "3")),
        ("sony-adcp", (b'input "hdmi2"\r\n', b'light_output_mode "low"\r\n'),
         ("input", "hdmi1", "hdmi2", "lamp mode", "high", "low")),
    ],
)  # fmt: skip
def test_menus_of_other_families(
    open_serial: Any, open_network: Any, profile: str, commands: tuple[bytes, ...], named: tuple[str, ...]
) -> None:
    lamp = EmulatedLamp(LAMP)
    board = BOARDS[profile](lamp)
    make = open_network if profile == "sony-adcp" else open_serial
    pair = make(profile=profile, lamp=lamp, board=lambda _: board, edit=hasty)
    before = adjusted(lit(pair))
    for command in commands:
        assert board.feed(command)
    told = [f"The {kind} of projector left was {old}, and is now {new}." for kind, old, new in batched(named)]
    assert sorted(compared(before, adjusted(pair))) == sorted(told)
    assert pair.driver.notices() == []


def batched(names: tuple[str, ...]) -> list[tuple[str, ...]]:
    return [names[at : at + 3] for at in range(0, len(names), 3)]


def test_a_serial_projector_whose_model_has_no_such_menu_says_nothing(open_serial: Any) -> None:
    pair = lit(open_serial(profile="benq", board=lambda lamp: BenqBoard(lamp, BenqQuirks(menus=False)), edit=hasty))
    assert pair.driver.adjustments(deadline=in_seconds(SOON)) == {}
    assert pair.driver.notices() == []


def test_input_firmware_and_body_of_a_projector_on_the_network(open_pjlink: Any) -> None:
    pair = lit(open_pjlink(edit=hasty))
    before = adjusted(pair)
    pair.emulator.set_oddities(PjLinkOddities(answers={"INPT": b"32"}))
    assert compared(before, adjusted(pair)) == ["The input of projector left was 31, and is now 32."]
    pair.emulator.set_oddities(PjLinkOddities(answers={"SVER": b"2.0"}))
    assert compared(before, adjusted(pair)) == ["The firmware of projector left was 1.0, and is now 2.0."]
    pair.emulator.set_oddities(PjLinkOddities(answers={"SNUM": b"VE-0002"}))
    assert compared(before, adjusted(pair)) == [
        "The projector left was Velatura Emulated PJLink projector VE-0001, and is now "
        "Velatura Emulated PJLink projector VE-0002."
    ]


def test_a_projector_that_is_not_there_is_not_called_changed(open_pjlink: Any) -> None:
    before = adjusted(lit(open_pjlink(edit=hasty)))
    assert compared(before, tuple(projector_facts("left", None))) == []


def camera(folder: Path, names: CameraNames) -> tuple[Fact, ...]:
    with EmulatedPtpCamera(Studio().expose, flavour="generic", names=names, time_scale=0.01) as emulator:
        opened = open_camera({"address": emulator.address}, OpenContext(folder), in_seconds(20))
        try:
            return tuple(camera_facts(opened))
        finally:
            opened.close()


def test_another_body_and_new_firmware_of_the_camera(tmp_path: Path) -> None:
    before = camera(tmp_path, CameraNames())
    other = camera(tmp_path, CameraNames(serial="999"))
    (body,) = compared(before, other)
    assert body.startswith("The camera was Velatura Emulated camera 0123456789, and is now ")
    assert "999" in body
    assert compared(before, camera(tmp_path, CameraNames(firmware="1.1.0"))) == [
        "The firmware of the camera was 1.0.0, and is now 1.1.0."
    ]


def photograph(stage: Path, run: str, lens: str | None, focal_mm: float | None) -> None:
    tags = Image.Exif()
    told = {0xA434: lens, 0x920A: focal_mm}
    tags.get_ifd(0x8769).update({tag: value for tag, value in told.items() if value is not None})
    folder = stage / "runs" / run / "captures" / "left"
    folder.mkdir(parents=True)
    Image.new("RGB", (8, 8)).save(folder / "0001.jpg", exif=tags)


def test_another_lens_and_a_turned_zoom(tmp_path: Path) -> None:
    photograph(tmp_path, "20260501-100000-calibrate", "EF 24-70mm f/2.8L", 50.0)
    before = tuple(lens_facts(tmp_path))
    photograph(tmp_path, "20260502-100000-drift", "EF 24-70mm f/2.8L", 52.0)
    assert compared(before, tuple(lens_facts(tmp_path))) == [
        "The camera's lens focal length was 50 mm, and is now 52 mm."
    ]
    photograph(tmp_path, "20260503-100000-drift", "EF 50mm f/1.8", 50.0)
    assert compared(before, tuple(lens_facts(tmp_path))) == [
        "The camera's lens was EF 24-70mm f/2.8L, and is now EF 50mm f/1.8."
    ]
    photograph(tmp_path, "20260503-110000-drift", None, None)
    assert [fact.value for fact in lens_facts(tmp_path)] == ["EF 50mm f/1.8", "50 mm"], "of the newest that tells one"
    photograph(tmp_path, "20260503-120000-drift", "Old 50mm", None)
    assert [fact.value for fact in lens_facts(tmp_path)] == ["Old 50mm", None]
    photograph(tmp_path, "20260503-130000-drift", None, 35.0)
    assert [fact.value for fact in lens_facts(tmp_path)] == ["unnamed", "35 mm"]
    broken = tmp_path / "runs/20260504-100000-drift/captures"
    broken.mkdir(parents=True)
    (broken / "0001.jpg").write_bytes(b"no photograph")
    assert compared(before, tuple(lens_facts(tmp_path))) != []


def test_a_setting_is_named_by_its_key_and_a_secret_is_not_written_down(tmp_path: Path) -> None:
    stage = vase(tmp_path / "stage")
    text = (stage / "stage.toml").read_text() + '\n[alerts]\nwebhook = "https://example.org/SECRET"\n'
    (stage / "stage.toml").write_text(text)
    before = tuple(settings_facts(load_stage(stage).tables))
    assert "SECRET" not in repr(before)
    (stage / "stage.toml").write_text("# a comment\n" + text.replace("iso = 100", "iso = 200"))
    assert compared(before, tuple(settings_facts(load_stage(stage).tables))) == [
        "In stage.toml, camera.iso was 100, and is now 200."
    ]
    (stage / "stage.toml").write_text(text.replace("SECRET", "OTHER"))
    (secret,) = compared(before, tuple(settings_facts(load_stage(stage).tables)))
    assert secret.startswith("In stage.toml, alerts.webhook was secret ")


def test_mode_and_order_that_the_x_server_shows_now() -> None:
    def shown(told: str) -> tuple[Fact, ...]:
        return tuple(shown_facts(connected(told)))

    told = LEFT + OFF + RIGHT
    assert compared(shown(told), shown(told.replace("148.500MHz", "146.000MHz"))) == [
        "The mode of output HDMI-2 was 1920x1080 at 60.0 Hz, and is now 1920x1080 at 59.0 Hz."
    ]
    moved = compared(shown(told), shown(told.replace("+0+0", "+1920+0").replace("+1400+0", "+0+0")))
    assert moved[0] == (
        "The place of output HDMI-1 was number 1 from the left, at 0 0, and is now number 2 from the left, at 1920 0."
    )
    assert len(moved) == 2


class Waiting(World):
    """Whose time stands still."""

    def monotonic(self) -> float:
        return 7.0


class Patient:
    """Says how long it may take to answer."""

    def __init__(self) -> None:
        self.left_s: list[float] = []

    def identity(self, *, deadline: Deadline) -> DeviceIdentity:
        self.left_s.append(deadline.left_s())
        return DeviceIdentity("Model", "Lamp")

    def adjustments(self, *, deadline: Deadline) -> dict[str, str]:
        self.left_s.append(deadline.left_s())
        return {}


def test_devices_are_asked_with_deadlines_of_the_time_that_the_kiosk_lives_in() -> None:
    asked = Patient()
    list(projector_facts("left", asked, Waiting().deadline))
    assert asked.left_s == [ASK_S, ASK_S], "to the last bit: no real time passes between"
