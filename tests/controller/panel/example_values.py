"""What the kiosk in memory tells where nothing has changed: one stage with three projectors, of which one is silent."""

from __future__ import annotations

import io
from collections.abc import Sequence
from functools import cache
from pathlib import Path

from PIL import Image, ImageDraw, ImageOps

from controller.kiosk.state import BundleIdentity, DeviceRow, KioskState, Lamp, LiveValue, NextEvent, Place
from controller.kiosk.values import Aiming, Change, Changes, FoundDevice, LampDay, ProjectorAim, Sharpness
from hal.notices import Level, Notice
from tests.controller.kiosk.vase import TEXT

BORN = 1_767_600_000.0
OUTPUTS = ("left", "middle", "right")


def devices() -> tuple[DeviceRow, ...]:
    lamp = (LiveValue.said("Lamp", "lit"), LiveValue.said("Hours", "{0} h with Velatura, {1} strikes", 1204, 88))
    lost = "It has not answered for 12 s."
    return (
        DeviceRow("left", "projector", "serial", lamp),
        DeviceRow("middle", "projector", "pjlink", lamp),
        DeviceRow("right", "projector", "serial", lamp[:1], lost, "Check its mains plug and the serial cable."),
        DeviceRow("camera", "camera", "ptp", (LiveValue("Model", "EOS R5"), LiveValue.said("Battery", "{0} %", 87))),
        DeviceRow("display", "display", "player", ()),
    )


def state(playing: str) -> KioskState:
    return KioskState(
        revision=1,
        stage="Head of a boy",
        state="playing",
        reason="Everything is well but one projector, whose part the others took over.",
        since_unix_s=BORN,
        devices=devices(),
        playing=playing,
        next_event=NextEvent("Closes", BORN + 7200),
        bundle=BundleIdentity(17, "9f2c" * 16, BORN),
        lamps=(Lamp("left", 1204.0, 88, True, 3000), Lamp("right", 3120.0, 203, False, 3000)),
        places=(
            Place("left", "left", -32.0, 4.0),
            Place("middle", "above", 3.0, 25.0),
            Place("right", "right", 35.0, 0.0),
        ),
    )


def draw_ball(file: Path, name: str, shade: int) -> None:
    """A ball in soft light, of another colour for each name; ``file``: of a PNG."""
    file.write_bytes(_ball(sum(name.encode()) % 3, shade))


@cache
def _ball(tint: int, shade: int) -> bytes:
    """Kept: each kiosk of a test would draw them again, for 50 ms."""
    light = ImageOps.invert(Image.radial_gradient("L")).resize((300, 300)).crop((70, 30, 310, 190))
    ball = Image.new("L", (240, 160))
    ImageDraw.Draw(ball).ellipse((50, 10, 190, 150), fill=255)
    channels = [light, light.point(lambda value: value * shade // 255), light.point(lambda value: value // 3)]
    picture = Image.merge("RGB", channels[tint:] + channels[:tint])
    Image.composite(picture, Image.new("RGB", (240, 160), (10, 9, 8)), ball).save(out := io.BytesIO(), "PNG")
    return out.getvalue()


def lamp_history() -> Sequence[LampDay]:
    days = ("2026-01-02", "2026-01-03", "2026-01-05")
    left = [LampDay("left", day, 1190.0 + 7 * at, 84 + at) for at, day in enumerate(days)]
    return [*left, LampDay("right", days[0], 3120.0, 203)]


def findings() -> Sequence[Notice]:
    return [
        Notice("", "It does not answer.", "Check its mains plug.", Level.ERROR, "Projector right"),
        Notice.warning("", "It is 91 % full.", "Remove old runs.", about="Disk"),
    ]


def changes() -> Changes:
    change = Change(
        "kernel", "", "6.1.0-28-amd64", "6.1.0-37-amd64",
        "The kernel was 6.1.0-28-amd64, and is now 6.1.0-37-amd64.",
        "If the picture is worse than before, install the version of before.", BORN,
    )  # fmt: skip
    return Changes(BORN, "20260101-100000-calibrate", (change,), ("The camera",))


def aiming(picture: Path) -> Aiming:
    aims = (ProjectorAim("left", 0.82, 0.9), ProjectorAim("middle", 0.9, 0.7), ProjectorAim("right", 0.4, 0.2))
    hints = ("Turn right's focus ring; its pixels are soft.",)
    focus = ({"left": 0.5, "right": 0.1}, {"left": 0.8, "right": 0.2}, {"left": 0.9, "middle": 0.7, "right": 0.2})
    history = tuple(Sharpness(BORN - 60 * (2 - n), 0.6 + 0.1 * n, one) for n, one in enumerate(focus))
    levels = tuple(abs(15 - n) / 240 for n in range(32))
    return Aiming(aims, 0.77, 0.04, 0.06, 0.8, 0.93, hints, "test shots", BORN, picture, True, 0.002,
                  levels, history)  # fmt: skip


def found_devices() -> Sequence[FoundDevice]:
    tables = TEXT.partition("[[projectors]]")[2].partition("[[appearances]]")[0]
    projector, _, rest = tables.partition("[camera]")
    camera, _, display = rest.partition("[display]")
    return [
        FoundDevice("tty0", "projector", "serial", "Optoma on ttyUSB0", f"[[projectors]]{projector}"),
        FoundDevice("usb", "camera", "ptp", "Canon EOS R5 on USB", f"[camera]{camera}"),
        FoundDevice("screen", "display", "player", "One output of the graphics card", f"[display]{display}"),
    ]
