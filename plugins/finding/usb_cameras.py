"""Still cameras on USB, their permissions, and the programs that use them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

from hal.codecs.ptp.values import printable
from hal.deadline import Deadline
from hal.finding import Finder, Found, SearchScope
from hal.notices import Notice
from plugins.finding.access import forbidden, holders, running
from plugins.ptp.usb.bus import UsbCamera, usb_cameras

RULES: Final = "70-velatura-camera.rules"
BY_GPHOTO2: Final = (0x04B0, 0x054C)
"""The USB numbers of makers whose cameras have commands of their own that libgphoto2 knows: Nikon, Sony."""
MONITORS: Final = ("gvfs-gphoto2-volume-monitor", "gvfsd-gphoto2", "gphoto2", "digikam", "darktable", "entangle")
"""Programs that claim a camera when it is plugged in, or while they run."""


def find(wanted: SearchScope, deadline: Deadline) -> Sequence[Found]:
    """Every still camera and its problems. Nothing is sent to a camera."""
    found = []
    cameras = usb_cameras()
    for camera in cameras:
        deadline.check(
            "doctor-too-slow", what="The search took too long.", remedy="Unplug devices that are not needed."
        )
        found.append(_found(camera, alone=len(cameras) == 1))
    return found


def _found(camera: UsbCamera, *, alone: bool) -> Found:
    bus, device = f"{camera.device.bus:03d}", f"{camera.device.address:03d}"
    node = Path(f"/dev/bus/usb/{bus}/{device}")
    table = {"address": f"usb:{camera.serial}" if camera.serial else f"usb:{camera.port}"}
    driver = "ptp"
    if camera.vendor in BY_GPHOTO2:
        # Its port has another number each time the camera is plugged in, so only where it is needed.
        driver, table = "gphoto2", {} if alone else {"address": f"usb:{bus},{device}"}
    what = f"still camera, {_name(camera.device)}{camera.vendor:04x}:{camera.product:04x}"
    problems = [problem for problem in (forbidden(node, "camera", RULES, "usb"), _held(node)) if problem is not None]
    identity = camera.serial or f"{camera.vendor:04x}:{camera.product:04x}"
    return Found("usb", f"port {camera.port}", what, "camera", driver, table, identity, tuple(problems))


def _held(node: Path) -> Notice | None:
    who = holders(node)
    if who:
        return Notice.warning(
            "camera-taken",
            what=f"The camera at {node} is in use by {', '.join(who)}.",
            remedy="End that program. The desktop's own: systemctl --user mask --now gvfs-gphoto2-volume-monitor, and "
            "gio mount -u its mount.",
        )
    waiting = running(*MONITORS)
    if waiting:
        return Notice.warning(
            "camera-may-be-taken",
            what=f"{', '.join(waiting)} is running, and may claim the camera at any time.",
            remedy="End it before a run: systemctl --user mask --now gvfs-gphoto2-volume-monitor keeps the desktop's "
            "own away for good.",
        )
    return None


def _name(device: Any) -> str:
    """Its product name with a space after it; "" if it can't be read."""
    try:
        return printable(f"{device.product or ''}"[:60]).strip() + " "
    except (ValueError, NotImplementedError, OSError):
        return ""


FINDER: Final = Finder("usb", find)
