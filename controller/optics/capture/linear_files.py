"""Photographs that are linear light already: OpenEXR files, and TIFF files."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
import numpy.typing as npt

from controller.core import channels
from controller.core.arrays import FloatImage, Mask
from controller.core.files import check_pixels, require_regular
from controller.core.text import printable

SUFFIXES: Final = (".exr", ".tif", ".tiff")


class Unreadable(Exception):
    """A file that can't be decoded; the text completes "The file can't be read: ..."."""


def is_linear(path: Path) -> bool:
    """Whether a photograph is linear light with three colours for each pixel, by its name."""
    return path.suffix.lower() in SUFFIXES


def read_linear(path: Path, *, bits: tuple[int, ...] = (16,)) -> tuple[FloatImage, Mask]:
    """(rows, columns, 3) float32 from 0 (black) to 1, and (rows, columns) bool where it is saturated.

    A TIFF or PNG has one of these numbers of ``bits``; its largest number is 1 and counts as saturated; a picture of
    one channel has three equal colours. An EXR has its values as they are; a pixel that is not finite counts as
    saturated. Raises Unreadable.
    """
    if path.suffix.lower() == ".exr":
        image = np.ascontiguousarray(read_exr(path)[..., :3])
        return image, np.asarray(~channels.finite(image))
    try:
        require_regular(path)
        data = np.fromfile(path, np.uint8)
        decoded = cv2.imdecode(data, cv2.IMREAD_UNCHANGED) if data.size else None
    except (OSError, cv2.error) as error:
        raise Unreadable(getattr(error, "strerror", None) or "it could not be decoded") from error
    if decoded is None or decoded.dtype.kind != "u" or 8 * decoded.itemsize not in bits:
        raise Unreadable(f"it is not a picture of {' or '.join(map(str, bits))} bits")
    full = 2 ** (8 * decoded.itemsize) - 1
    colours = np.repeat(decoded[..., None], 3, axis=2) if decoded.ndim == 2 else decoded[..., 2::-1]
    return np.asarray(colours / np.float32(full), np.float32), channels.some(colours == full)


def read_exr(path: Path) -> FloatImage:
    """(rows, columns, 3 or 4) float32 from channels R, G, B and A, or Y alone. Raises Unreadable."""
    import OpenEXR

    try:
        require_regular(path)
        with OpenEXR.File(str(path), header_only=True) as file:
            low, high = (np.asarray(corner, np.int64) for corner in file.header()["dataWindow"])
            check_pixels(path, (int(high[0] - low[0] + 1), int(high[1] - low[1] + 1)))
        with OpenEXR.File(str(path), separate_channels=True) as file:
            planes_by_name = {name: np.asarray(channel.pixels) for name, channel in file.channels().items()}
    except OSError as error:
        raise Unreadable(f"it can't be read: {error.strerror or printable(str(error))}") from error
    except (RuntimeError, ValueError, TypeError, KeyError) as error:
        raise Unreadable(f"it could not be decoded ({printable(str(error))})") from error
    names = ["R", "G", "B"] if "R" in planes_by_name else ["Y", "Y", "Y"]
    if not set(names) <= set(planes_by_name):
        raise Unreadable(f"it has the channels {', '.join(sorted(planes_by_name))}, not R, G and B")
    planes = [planes_by_name[name] for name in names + (["A"] if "A" in planes_by_name else [])]
    if any(plane.shape != planes[0].shape for plane in planes):
        raise Unreadable("its channels differ in size")
    return np.stack(planes, axis=2).astype(np.float32)


def exr_chromaticities(path: Path) -> tuple[float, ...] | None:
    """CIE x and y of red, green, blue and white, eight numbers, where an EXR says them."""
    import OpenEXR

    with OpenEXR.File(str(path), header_only=True) as file:
        coordinates = file.header().get("chromaticities")
    return None if coordinates is None else tuple(float(one) for one in coordinates)


def exr_bytes(planes: Mapping[str, npt.NDArray[Any]], *, half: bool = False) -> bytes:
    """An OpenEXR file, floats of 32 bits, or of 16 (``half``).

    ``planes``: channels (rows, columns) by name; (rows, columns, 3) under the name "RGB"
    """
    import OpenEXR

    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    channels = {name: np.ascontiguousarray(plane, np.float16 if half else np.float32) for name, plane in planes.items()}
    with tempfile.TemporaryDirectory() as folder:  # the library writes files by name only
        name = Path(folder) / "image.exr"
        OpenEXR.File(header, channels).write(str(name))
        return name.read_bytes()
