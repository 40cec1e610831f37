"""Photographs that are linear light already: OpenEXR files, and TIFF files."""

from __future__ import annotations

import tempfile
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from controller.core import channels
from controller.core.arrays import FloatImage, Mask
from controller.core.colour import Unsuitable
from controller.core.files import check_pixels, require_regular
from controller.core.pictures import read_picture_file
from controller.core.text import printable

SUFFIXES: Final = (".exr", ".tif", ".tiff")


def is_linear(path: Path) -> bool:
    """Whether a photograph is linear light with three colours for each pixel, by its name."""
    return path.suffix.lower() in SUFFIXES


def read_linear(path: Path, *, bits: tuple[int, ...] = (16,)) -> tuple[FloatImage, Mask]:
    """(rows, columns, 3) float32 from 0 (black) to 1, and (rows, columns) bool where it is saturated.

    A TIFF or PNG has one of these numbers of ``bits``; its largest number is 1 and counts as saturated; a picture of
    one channel has three equal colours. It lies as on the sensor. An EXR or a TIFF of floats has its values as they
    are; a pixel that is not finite counts as saturated. Raises Unsuitable.
    """
    if path.suffix.lower() == ".exr":
        values: npt.NDArray[Any] = read_exr(path)[..., :3]
    else:
        values = read_picture_file(path, upright=False).values
        values = np.repeat(values, 3, axis=2) if values.shape[2] == 1 else values
    if values.dtype.kind == "f":
        image = np.ascontiguousarray(values)
        return image, np.asarray(~channels.finite(image))
    if 8 * values.itemsize not in bits:
        raise Unsuitable(f"it is not a picture of {' or '.join(map(str, bits))} bits")
    full = np.iinfo(values.dtype).max
    return np.asarray(values / np.float32(full), np.float32), channels.some(values == full)


def read_exr(path: Path) -> FloatImage:
    """(rows, columns, 3 or 4) float32 of the display window, black beside the data; alpha is premultiplied.

    From channels R, G, B and A, or Y alone: of the file itself, or of its one layer or part that has them.
    Raises Unsuitable.
    """
    import OpenEXR

    try:
        require_regular(path)
        with OpenEXR.File(str(path), header_only=True) as file:
            for part in file.parts:
                for window in ("dataWindow", "displayWindow"):
                    low, high = (np.asarray(corner, np.int64) for corner in part.header[window])
                    check_pixels(path, (int(high[0] - low[0] + 1), int(high[1] - low[1] + 1)))
        with OpenEXR.File(str(path), separate_channels=True) as file:
            part, names = _layer(file.parts)
            planes = [np.asarray(part.channels[name].pixels) for name in names]
            return _displayed(planes, part.header["dataWindow"], part.header["displayWindow"])
    except OSError as error:
        raise Unsuitable(f"it can't be read: {error.strerror or printable(str(error))}") from error
    except (RuntimeError, ValueError, TypeError, KeyError) as error:
        raise Unsuitable(f"it could not be decoded ({printable(str(error))})") from error


def _layer(parts: Sequence[Any]) -> tuple[Any, list[str]]:
    """The part of the picture, and its channels in the order of colours. Raises Unsuitable."""
    layers: dict[str, tuple[Any, list[str]]] = {}
    for part in parts:
        by_layer: dict[str, dict[str, str]] = {}
        for name in part.channels:
            layer, _, channel = name.rpartition(".")
            by_layer.setdefault(layer, {})[channel.upper()] = name
        for layer, own in by_layer.items():
            colours = ["R", "G", "B"] if {"R", "G", "B"} <= set(own) else ["Y", "Y", "Y"]
            # Y beside these is a colour's luminance, or a coordinate
            if set(colours) <= set(own) and (colours[0] == "R" or not {"RY", "BY", "X"} & set(own)):
                full_name = ".".join(filter(None, (part.name() if len(parts) > 1 else "", layer)))
                layers[full_name] = part, [own[channel] for channel in (*colours, *({"A"} & set(own)))]
    first = next(iter(layers), "")
    plain = [name for name, (_, names) in layers.items() if "." not in names[0]]
    combined = [name for name in layers if name.endswith("Combined")]  # Blender's name of the picture itself
    for choice in (list(layers), plain, combined):
        if len(choice) == 1:
            return layers[choice[0]]
    if plain and first == plain[0]:
        return layers[first]  # the first part, as viewers show
    if layers:
        raise Unsuitable(f"it has several pictures, and only one can be used: export one of {_listed(layers)} alone")
    raise Unsuitable(f"it has the channels {_listed(name for part in parts for name in part.channels)}, not R, G and B")


def _listed(names: Iterable[str]) -> str:
    return printable(", ".join(sorted(set(names))))


def _displayed(planes: Sequence[npt.NDArray[Any]], data: Any, display: Any) -> FloatImage:
    """The planes of a data window in the display window; both as (left, top), (right, bottom), these included."""
    (left, top), (right, bottom) = (np.asarray(corner, np.int64) for corner in data)
    if any(plane.dtype.kind not in "fu" or plane.shape != (bottom - top + 1, right - left + 1) for plane in planes):
        raise Unsuitable("its channels differ in size, or are deep")
    (x, y), (last_x, last_y) = (np.asarray(corner, np.int64) for corner in display)
    shown = np.zeros((last_y - y + 1, last_x - x + 1, len(planes)), np.float32)
    rows = slice(max(top, y), min(bottom, last_y) + 1)
    columns = slice(max(left, x), min(right, last_x) + 1)
    if rows.start < rows.stop and columns.start < columns.stop:
        inside = np.s_[rows.start - top : rows.stop - top, columns.start - left : columns.stop - left]
        shown[rows.start - y : rows.stop - y, columns.start - x : columns.stop - x] = np.stack(
            [plane[inside] for plane in planes], axis=2
        )
    return shown


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
