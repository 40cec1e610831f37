"""Cameras on video devices, and their permissions. No picture is taken."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from hal.deadline import Deadline
from hal.errors import DeviceError, DeviceGone
from hal.finding import Finder, Found, SearchScope
from hal.notices import Notice
from plugins.v4l2.kernel import identify_path, paths


def find(wanted: SearchScope, deadline: Deadline) -> Sequence[Found]:
    """Every video device that takes pictures, and its problems."""
    found = []
    for path in paths():
        deadline.check(
            "doctor-too-slow", what="The search took too long.", remedy="Unplug devices that are not needed."
        )
        try:
            node = identify_path(path)
        except DeviceGone:
            continue  # it was just unplugged
        except DeviceError as error:
            problems = (Notice.of(error),)
            found.append(Found("video", str(path), "video device", "camera", "v4l2", {}, str(path), problems))
            continue
        if node is not None:
            settings = {"serial": node.serial} if node.serial else {"address": str(path)}
            what = f"video camera, {node.model}"
            found.append(Found("video", str(path), what, "camera", "v4l2", settings, node.serial or node.bus))
    return found


FINDER: Final = Finder("video", find)
