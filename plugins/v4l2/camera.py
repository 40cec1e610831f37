"""The driver ``v4l2``: cameras on a video device of Linux, such as USB cameras (UVC)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

from hal.deadline import Deadline
from hal.registry import Driver, OpenContext
from plugins.library_process import LibraryCamera
from plugins.v4l2.formats import EXPLAINED, VideoSettings, video_settings


class VideoCamera(LibraryCamera):
    """A camera by the kernel's video interface; a process of its own calls the kernel.

    ``serial``: the number it must have; "" takes any, and stays with it.
    """

    def __init__(self, settings: VideoSettings, *, serial: str, deadline: Deadline) -> None:
        super().__init__(
            "plugins.v4l2.worker", "the kernel's video driver", start=(settings,), serial=serial, deadline=deadline
        )


def open_camera(settings: Mapping[str, Any], context: OpenContext, deadline: Deadline) -> VideoCamera:
    """Open the camera of a ``[camera]`` table."""
    return VideoCamera(video_settings(settings), serial=str(settings.get("serial", "")), deadline=deadline)


DRIVER: Final = Driver(
    kind="camera",
    name="v4l2",
    summary="USB cameras (UVC) and other video devices of Linux (V4L2).",
    open=open_camera,
    settings=EXPLAINED,
    check=lambda settings, context: video_settings(settings),
)
