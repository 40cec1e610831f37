"""The calls of the kernel's video interface that a still camera needs (include/uapi/linux/videodev2.h), by ctypes, and
the video devices of this computer.
"""

from __future__ import annotations

import ctypes
import errno
import fcntl
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from ctypes import c_char, c_int32, c_long, c_size_t, c_uint8, c_uint32, c_void_p
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Final

from hal.codecs.ptp.values import printable
from hal.errors import DeviceError, DeviceGone, DeviceRefused

CAPTURE: Final = 1
"""V4L2_BUF_TYPE_VIDEO_CAPTURE, and the capability of the same number."""
STREAMING: Final = 0x04000000
HAS_DEVICE_CAPS: Final = 0x80000000
MMAP: Final = 1
BAD_FRAME: Final = 0x40
DISCRETE: Final = 1
UNUSABLE: Final = 0x1 | 0x4
"""Flags of a control: disabled, read-only."""
EXPOSURE_ABSOLUTE: Final = 0x009A0902
EXPOSURE: Final = 0x00980911
EXPOSURE_AUTO: Final = 0x009A0901
MANUAL: Final = 1
AUTOMATIC: Final = {
    EXPOSURE_AUTO: MANUAL,
    0x009A0903: 0,  # exposure decides the frame rate
    0x009A090C: 0,  # focus
    0x009A0915: 0,  # wide dynamic range
    0x009A0918: 0,  # ISO
    0x0098090C: 0,  # white balance
    0x00980912: 0,  # gain
    0x00980918: 0,  # against flicker of lamps
    0x00980919: 0,  # hue
    0x0098091C: 0,  # backlight compensation
    0x00980920: 0,  # brightness
}
"""Controls by which a camera changes a picture by itself, and the value that stops it."""
UVC_GAMMA: Final = (0x00980910, 100)
"""A USB camera's gamma of 1 (UVC 1.5, 4.2.2.3.8)."""
_GONE: Final = frozenset({errno.ENODEV, errno.ENXIO, errno.ENOENT, errno.EBADF})


class Capability(ctypes.Structure):
    _fields_: ClassVar = [
        ("driver", c_char * 16), ("card", c_char * 32), ("bus_info", c_char * 32), ("version", c_uint32),
        ("capabilities", c_uint32), ("device_caps", c_uint32), ("reserved", c_uint32 * 3),
    ]  # fmt: skip


class FormatDescription(ctypes.Structure):
    _fields_: ClassVar = [
        ("index", c_uint32), ("type", c_uint32), ("flags", c_uint32), ("description", c_char * 32),
        ("pixelformat", c_uint32), ("mbus_code", c_uint32), ("reserved", c_uint32 * 3),
    ]  # fmt: skip


class _Pixels(ctypes.Structure):
    _fields_: ClassVar = [(name, c_uint32) for name in (
        "width", "height", "pixelformat", "field", "bytesperline", "sizeimage", "colorspace", "priv", "flags",
        "ycbcr_enc", "quantization", "xfer_func",
    )]  # fmt: skip


class _FormatUnion(ctypes.Union):
    _fields_: ClassVar = [("pix", _Pixels), ("aligned", c_void_p), ("raw", c_uint8 * 200)]


class Format(ctypes.Structure):
    _fields_: ClassVar = [("type", c_uint32), ("fmt", _FormatUnion)]


class FrameSize(ctypes.Structure):
    """Discrete: ``sides[0:2]`` are width and height; else width from, to, step, height from, to, step."""

    _fields_: ClassVar = [
        ("index", c_uint32), ("pixelformat", c_uint32), ("type", c_uint32), ("sides", c_uint32 * 6),
        ("reserved", c_uint32 * 2),
    ]  # fmt: skip


class FrameInterval(ctypes.Structure):
    """Discrete: ``parts[0:2]`` are numerator and denominator; else those of the shortest, the longest and the step."""

    _fields_: ClassVar = [
        ("index", c_uint32), ("pixelformat", c_uint32), ("width", c_uint32), ("height", c_uint32), ("type", c_uint32),
        ("parts", c_uint32 * 6), ("reserved", c_uint32 * 2),
    ]  # fmt: skip


class Parameters(ctypes.Structure):
    _fields_: ClassVar = [
        ("type", c_uint32), ("capability", c_uint32), ("capturemode", c_uint32), ("numerator", c_uint32),
        ("denominator", c_uint32), ("rest", c_uint8 * 184),
    ]  # fmt: skip


class Buffers(ctypes.Structure):
    _fields_: ClassVar = [
        ("count", c_uint32), ("type", c_uint32), ("memory", c_uint32), ("capabilities", c_uint32),
        ("flags", c_uint32),
    ]  # fmt: skip


class _Place(ctypes.Union):
    _fields_: ClassVar = [("offset", c_uint32), ("aligned", c_size_t)]


class Buffer(ctypes.Structure):
    _fields_: ClassVar = [
        ("index", c_uint32), ("type", c_uint32), ("bytesused", c_uint32), ("flags", c_uint32), ("field", c_uint32),
        ("seconds", c_long), ("microseconds", c_long), ("timecode", c_uint32 * 4), ("sequence", c_uint32),
        ("memory", c_uint32), ("m", _Place), ("length", c_uint32), ("reserved2", c_uint32), ("request", c_int32),
    ]  # fmt: skip


class ControlQuery(ctypes.Structure):
    _fields_: ClassVar = [
        ("id", c_uint32), ("type", c_uint32), ("name", c_char * 32), ("minimum", c_int32), ("maximum", c_int32),
        ("step", c_int32), ("default", c_int32), ("flags", c_uint32), ("reserved", c_uint32 * 2),
    ]  # fmt: skip


class Control(ctypes.Structure):
    _fields_: ClassVar = [("id", c_uint32), ("value", c_int32)]


_READ, _WRITE = 2, 1


def _number(direction: int, number: int, kind: type[ctypes.Structure | c_int32]) -> int:
    return direction << 30 | ctypes.sizeof(kind) << 16 | ord("V") << 8 | number


QUERYCAP: Final = _number(_READ, 0, Capability)
ENUM_FMT: Final = _number(_READ | _WRITE, 2, FormatDescription)
S_FMT: Final = _number(_READ | _WRITE, 5, Format)
REQBUFS: Final = _number(_READ | _WRITE, 8, Buffers)
QUERYBUF: Final = _number(_READ | _WRITE, 9, Buffer)
QBUF: Final = _number(_READ | _WRITE, 15, Buffer)
DQBUF: Final = _number(_READ | _WRITE, 17, Buffer)
STREAMON: Final = _number(_WRITE, 18, c_int32)
STREAMOFF: Final = _number(_WRITE, 19, c_int32)
S_PARM: Final = _number(_READ | _WRITE, 22, Parameters)
G_CTRL: Final = _number(_READ | _WRITE, 27, Control)
S_CTRL: Final = _number(_READ | _WRITE, 28, Control)
QUERYCTRL: Final = _number(_READ | _WRITE, 36, ControlQuery)
ENUM_FRAMESIZES: Final = _number(_READ | _WRITE, 74, FrameSize)
ENUM_FRAMEINTERVALS: Final = _number(_READ | _WRITE, 75, FrameInterval)


def call(handle: int, request: int, argument: ctypes.Structure | c_int32) -> None:
    """One ioctl, which fills ``argument``. Raises DeviceGone or DeviceRefused."""
    try:
        fcntl.ioctl(handle, request, argument)
    except OSError as error:
        raise device_error(error) from error


def answered(handle: int, request: int, argument: ctypes.Structure) -> bool:
    """As ``call``, for what a driver need not have; whether it has it. Raises DeviceGone."""
    try:
        call(handle, request, argument)
    except DeviceRefused:
        return False
    return True


def device_error(error: OSError) -> DeviceError:
    """What an error of the kernel says about the camera."""
    if error.errno in _GONE:
        return DeviceGone(
            "camera-off",
            what=f"The camera's video device is gone ({error.strerror}).",
            remedy="Check its power and its cable. Velatura uses it again when it is plugged in.",
        )
    if error.errno == errno.EBUSY:
        return DeviceRefused(
            "camera-taken", what="Another program uses the camera.", remedy="End it: `fuser /dev/video0` names it."
        )
    if error.errno in (errno.EACCES, errno.EPERM):
        return DeviceRefused(
            "camera-not-opened", what="This user may not open the camera.", remedy="Put this user into the group video."
        )
    return DeviceRefused(
        "camera-refused",
        what=f"The camera refused a command ({error.strerror}).",
        remedy="Unplug it and plug it in again. If this happens again, choose another format or size in stage.toml.",
    )


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
        raise device_error(error) from error
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
    told = Capability()
    if not answered(handle, QUERYCAP, told):
        return None
    can = told.device_caps if told.capabilities & HAS_DEVICE_CAPS else told.capabilities
    if not (can & CAPTURE and can & STREAMING):
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
