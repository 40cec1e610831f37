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
MONITORS: Final = ("gvfs-gphoto2-volume-monitor", "gvfsd-gphoto2", "gphoto2", "digikam", "darktable", "entangle")
"""Programs that claim a camera when it is plugged in, or while they run."""


def find(wanted: SearchScope, deadline: Deadline) -> Sequence[Found]:
    """Every still camera and its problems. Nothing is sent to a camera."""
    found = []
    for camera in usb_cameras():
        deadline.check(
            "doctor-too-slow", what="The search took too long.", remedy="Unplug devices that are not needed."
        )
        found.append(_found(camera))
    return found


def _found(camera: UsbCamera) -> Found:
    node = Path(f"/dev/bus/usb/{camera.device.bus:03d}/{camera.device.address:03d}")
    address = f"usb:{camera.serial}" if camera.serial else f"usb:{camera.port}"
    what = f"still camera, {_name(camera.device)}{camera.vendor:04x}:{camera.product:04x}"
    problems = [problem for problem in (forbidden(node, "camera", RULES, "usb"), _held(node)) if problem is not None]
    identity = camera.serial or f"{camera.vendor:04x}:{camera.product:04x}"
    table = {"address": address}
    return Found("usb", f"port {camera.port}", what, "camera", "ptp", table, identity, tuple(problems))


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
