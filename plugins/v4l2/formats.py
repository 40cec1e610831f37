"""Which formats of V4L2 are read, what files they become, and what a ``[camera]`` table says about them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from hal.errors import PluginError
from hal.registry import setting
from plugins.raw_file import LEVEL_SETTINGS, Levels, PixelFormat, levels_of, pixel_format

_GREY: Final = {"GREY": 8, "Y10 ": 10, "Y12 ": 12, "Y14 ": 14, "Y16 ": 16}
_BAYER: Final = {
    "BG": ("BA81", "BG10", "BG12", "BG14", "BYR2"), "GB": ("GBRG", "GB10", "GB12", "GB14", "GB16"),
    "GR": ("GRBG", "BA10", "BA12", "GR14", "GR16"), "RG": ("RGGB", "RG10", "RG12", "RG14", "RG16"),
}  # fmt: skip
"""The colours of the first two sites: the codes for 8, 10, 12, 14 and 16 bits."""
_DEPTHS: Final = (8, 10, 12, 14, 16)
_PFNC: Final = {code: f"Mono{bits}" for code, bits in _GREY.items()} | {
    code: f"Bayer{colours}{bits}"
    for colours, codes in _BAYER.items()
    for code, bits in zip(codes, _DEPTHS, strict=True)
}
_FINISHED: Final = ("YUYV", "UYVY", "RGB3", "BGR3", "MJPG", "JPEG")
"""Pictures that the camera has developed, best first: they become JPEG files."""
COMPRESSED: Final = frozenset({"MJPG", "JPEG"})
_QUALITY: Final = 98


@dataclass(frozen=True, slots=True)
class VideoFormat:
    """``code``: the four characters of V4L2; ``samples``: of a sensor without development, else None."""

    code: str
    samples: PixelFormat | None = None

    @property
    def raw(self) -> bool:
        return self.samples is not None

    @property
    def bytes_per_pixel(self) -> int:
        if self.samples is not None:
            return 1 if self.samples.bits == 8 else 2
        return 3 if self.code in ("RGB3", "BGR3") else 2


def video_format(code: str, bits: int = 0) -> VideoFormat | None:
    """The format of this code, or None for one that is not read; ``bits``: how many of 16 are used, 0 for all."""
    if code in _FINISHED:
        return VideoFormat(code)
    samples = pixel_format(_PFNC.get(code, ""))
    if samples is None:
        return None
    return VideoFormat(code, replace(samples, bits=bits) if bits and samples.bits > 8 else samples)


def rank(video: VideoFormat) -> tuple[bool, bool, int]:
    """Larger is better: raw before finished, colours before grey, then more bits or less compression."""
    if video.samples is not None:
        return True, bool(video.samples.bayer), video.samples.bits
    return False, True, -_FINISHED.index(video.code)


def code_of(number: int) -> str:
    """The four characters of a number of V4L2; "" for what is none, such as a big-endian one."""
    text = number.to_bytes(4, "little")
    return text.decode("ascii") if all(32 <= byte < 127 for byte in text) else ""


def number_of(code: str) -> int:
    return int.from_bytes(code.encode("ascii"), "little")


def is_complete_jpeg(data: bytes) -> bool:
    """Whether a frame of Motion JPEG begins and ends as one; after its end may be zeros."""
    return data[:2] == b"\xff\xd8" and data.rstrip(b"\0")[-2:] == b"\xff\xd9"


def jpeg_file(data: bytes, size_px: tuple[int, int], code: str) -> bytes:
    """A finished picture as a JPEG file. ``data``: whole rows without padding, or a frame of Motion JPEG."""
    if code in COMPRESSED:
        return _with_tables(data.rstrip(b"\0"))
    import cv2

    columns, rows = size_px
    if code in ("RGB3", "BGR3"):
        picture = np.frombuffer(data, np.uint8, rows * columns * 3).reshape(rows, columns, 3)
        return _encoded(cv2.cvtColor(picture, cv2.COLOR_RGB2BGR) if code == "RGB3" else picture)
    picture = np.frombuffer(data, np.uint8, rows * columns * 2).reshape(rows, columns, 2)
    way = cv2.COLOR_YUV2BGR_YUYV if code == "YUYV" else cv2.COLOR_YUV2BGR_UYVY
    return _encoded(cv2.cvtColor(picture, way))


def _encoded(picture: npt.NDArray[Any]) -> bytes:
    import cv2

    done, file = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
    assert done, "a picture of uint8 can be encoded"
    return file.tobytes()


def _with_tables(data: bytes) -> bytes:
    """Motion JPEG may leave out the Huffman tables of the standard (ITU-T T.81, annex K.3); files must have them."""
    if b"\xff\xc4" in data[: data.find(b"\xff\xda")]:
        return data
    plain = _encoded(np.zeros((16, 16, 3), np.uint8))
    return data[:2] + b"".join(_segments(plain, 0xC4)) + data[2:]


def _segments(file: bytes, kind: int) -> list[bytes]:
    """The segments of this kind before the picture's data."""
    found, at = [], 2
    while file[at + 1] != 0xDA:
        size = 2 + int.from_bytes(file[at + 2 : at + 4], "big")
        if file[at + 1] == kind:
            found.append(file[at : at + size])
        at += size
    return found


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
