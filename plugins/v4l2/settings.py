"""What a ``[camera]`` table says for this driver."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

from hal.errors import PluginError
from hal.registry import setting
from plugins.raw_file import LEVEL_SETTINGS, Levels, levels_of
from plugins.v4l2.formats import video_format

_MOST_SKIPPED: Final = 100


@dataclass(frozen=True, slots=True)
class VideoSettings:
    """``format`` "" and ``size_px`` None: the best; ``bits`` 0: all; ``exposure_step_s`` 0: unknown."""

    address: str
    format: str
    size_px: tuple[int, int] | None
    bits: int
    skip_frames: int
    exposure_step_s: float
    levels: Levels


EXPLAINED: Final = {
    "address": "the video device, such as /dev/video0 or a name in /dev/v4l/by-id (default: the first that is found)",
    "serial": "serial number that the camera must have (default: any)",
    "format": "V4L2's code of the pixel format, such as RG12, Y16 or MJPG (default: a mosaic with the most bits)",
    "size": "[width, height] in pixels (default: the largest)",
    "bits": "how many bits of a 16-bit sample are used, from below: 9 to 16 (default: as the format says)",
    "skip_frames": "frames that are passed over before each picture: 1 to 100 (default 2)",
    "exposure_step_s": "seconds of one step of the control Exposure, for a camera without Exposure, Absolute",
    **LEVEL_SETTINGS,
}


def video_settings(settings: Mapping[str, Any]) -> VideoSettings:
    """Raises PluginError for what can't be used."""
    code = setting(settings, "format", str, "").strip()
    if code and (len(code) > 4 or video_format(code.ljust(4)) is None):
        raise PluginError(
            "camera-format",
            what=f"The format {code!r} can't be read.",
            remedy='Write one without packing, such as "RG12", "Y16" or "MJPG", for format in the [camera] table.',
        )
    size = setting(settings, "size", list, [])
    bits = setting(settings, "bits", int, 0)
    skipped = setting(settings, "skip_frames", int, 2)
    step_s = float(setting(settings, "exposure_step_s", (int, float), 0.0))
    sides = [side for side in size if isinstance(side, int) and not isinstance(side, bool) and 0 < side < 1 << 16]
    sound = (not size or len(sides) == len(size) == 2) and (bits == 0 or 9 <= bits <= 16)
    if not (sound and 1 <= skipped <= _MOST_SKIPPED and math.isfinite(step_s) and 0 <= step_s <= 1):
        raise PluginError(
            "camera-setting",
            what="The camera's size, bits, skip_frames or exposure_step_s is wrong.",
            remedy="Write two whole numbers for size, 9 to 16 for bits, 1 to 100 for skip_frames, and seconds for"
            " exposure_step_s.",
        )
    return VideoSettings(
        address=setting(settings, "address", str, ""),
        format=code,
        size_px=(sides[0], sides[1]) if sides else None,
        bits=bits,
        skip_frames=skipped,
        exposure_step_s=step_s,
        levels=levels_of(settings),
    )
