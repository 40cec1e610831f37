"""The video devices of this computer, and who they are."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from hal.codecs.ptp.values import printable
from hal.errors import DeviceGone, DeviceRefused
from plugins.v4l2 import kernel

DEVICES: Final = Path("/dev")
_CLASS: Final = Path("/sys/class/video4linux")
_LONGEST: Final = 126


@dataclass(frozen=True, slots=True)
class VideoNode:
    """A device that can take pictures. ``bus``: the place where it is plugged in; ``serial``: "" where it has none."""

    path: Path
    driver: str
    maker: str
    model: str
    serial: str
    bus: str


@contextmanager
def opened(path: Path) -> Iterator[int]:
    """The open device. Raises DeviceGone or DeviceRefused."""
    try:
        handle = os.open(path, os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC)
    except OSError as error:
        raise kernel.device_error(error) from error
    try:
        yield handle
    finally:
        os.close(handle)


def paths() -> list[Path]:
    """Every video device, by number."""
    found = {
        int(match[1]): path for path in DEVICES.glob("video*") if (match := re.fullmatch(r"video(\d+)", path.name))
    }
    return [found[number] for number in sorted(found)]


def identify_path(path: Path) -> VideoNode | None:
    """Who the device is; None for one that takes no pictures, such as a camera's second one, for its own data.

    Raises DeviceGone or DeviceRefused.
    """
    with opened(path) as handle:
        return identify(path, handle)


def identify(path: Path, handle: int) -> VideoNode | None:
    """As ``identify_path``, of an open device."""
    told = kernel.Capability()
    if not kernel.answered(handle, kernel.QUERYCAP, told):
        return None
    can = told.device_caps if told.capabilities & kernel.HAS_DEVICE_CAPS else told.capabilities
    if not (can & kernel.CAPTURE and can & kernel.STREAMING):
        return None
    driver, card, bus = (printable(text.decode(errors="replace")) for text in (told.driver, told.card, told.bus_info))
    usb = _CLASS / path.resolve().name / "device" / ".."
    return VideoNode(path, driver, _text_of(usb / "manufacturer") or driver, card, _text_of(usb / "serial"), bus)


def chosen(address: str, serial: str, bus: str) -> VideoNode:
    """The camera of these settings; without any, the first one. ``bus``: where it was before, "" at the beginning.

    A camera that was unplugged may come back under another number, so its serial number, or its place, comes first.
    Raises DeviceGone, or DeviceRefused("camera-other", "camera-not-opened").
    """
    refused: DeviceRefused | None = None
    others: list[str] = []
    for path in [Path(address)] if address else paths():
        try:
            node = identify_path(path)
        except DeviceGone:
            continue
        except DeviceRefused as error:
            refused = error
            continue
        if node is None:
            continue
        if serial and node.serial != serial:
            others.append(node.serial or "none")
        elif address or serial or bus in ("", node.bus):
            return node
    if refused is not None:
        raise refused
    if others:
        raise DeviceRefused(
            "camera-other",
            what=f"The connected camera has the serial number {', '.join(others)}, not {serial}.",
            remedy="Connect the right camera, or change serial in stage.toml and recalibrate.",
        )
    raise DeviceGone(
        "camera-off",
        what=f"There is no camera at {address}." if address else "No video device takes pictures.",
        remedy="Check its power and its cable. Velatura uses it again when it is plugged in.",
    )


def _text_of(file: Path) -> str:
    try:
        return printable(file.read_text("utf-8", "replace").strip()[:_LONGEST])
    except OSError:
        return ""
