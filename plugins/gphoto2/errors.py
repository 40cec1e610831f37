"""Converts libgphoto2's errors."""

from __future__ import annotations

from typing import Any

from hal.codecs.ptp.values import printable
from hal.errors import DeviceBusy, DeviceError, DeviceGone, DeviceRefused, DeviceTimeout


def translated(library: Any, error: Exception) -> DeviceError:
    code: int = getattr(error, "code", library.GP_ERROR)
    said = printable(str(error))
    if code in (library.GP_ERROR_CAMERA_BUSY, library.GP_ERROR_IO_USB_CLAIM, library.GP_ERROR_IO_LOCK):
        return DeviceBusy(
            "camera-in-use",
            what=f"The camera is busy, or another program holds it ({said}).",
            remedy="Close photo programs and the desktop's file manager (gvfs-gphoto2-volume-monitor), then try again.",
        )
    if code == library.GP_ERROR_TIMEOUT:
        return DeviceTimeout(
            "camera-no-answer",
            what="The camera did not answer libgphoto2 in time.",
            remedy="Check that it is awake. If it does not answer, switch it off and on.",
        )
    if code in (library.GP_ERROR_MODEL_NOT_FOUND, library.GP_ERROR_UNKNOWN_PORT) or -60 <= code <= -50 or code == -7:
        return DeviceGone(
            "camera-disconnected",
            what=f"libgphoto2 has lost the camera ({said}).",
            remedy="Check the cable and the battery, and switch automatic power-off off.",
        )
    return DeviceRefused(
        "camera-refused",
        what=f"The camera refused a command of libgphoto2 ({said}).",
        remedy="Check the mode dial (M), the lens switch (manual focus) and the card, then try again.",
    )
