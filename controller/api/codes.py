"""Photographs of Gray code and phase shift that any program has shown."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from controller.api.captures import DESCRIPTION, description_of, develop, unfit
from controller.core.arrays import FloatImage
from controller.core.errors import CalibrationError, UsageError
from controller.optics.calibrate.correspondence.any_code import Bits, Sinusoid, decode_any
from controller.optics.calibrate.values import Correspondence
from controller.optics.capture.profile import CameraProfile

_AS_THEY_ARE = CameraProfile(response=np.tile(np.linspace(0, 1, 256), (3, 1)))


def decode_folder(folder: Path | str, *, camera: CameraProfile | None = None) -> Correspondence:
    """Decode a folder of photographs of Gray code, and of phase shift if there is one, as any program showed them.

    ``captures.toml`` in the folder says what each picture is::

        projector_px = [1920, 1080]     # width, height

        [gray]
        cell_px = 1                     # projector pixels of the finest cell; 1 if left out
        x = [["01.png", "02.png"], ["03.png", "04.png"]]    # each bit, coarsest first, and its opposite
        y = [["05.png", "06.png"], ["07.png", "08.png"]]
        offset_px = [0, 0]              # of the code's first cell; [64, 128] where 1024 pixels show 896 x 768 of it
        mirrored = false                # true where a mirror or a screen lit from behind turns the picture

        [phase]                         # optional, for x, y or both
        x = { period_px = 16, files = ["09.png", "10.png", "11.png"] }

    Where bits have no opposite (``x = ["01.png", "03.png"]``), ``[pictures]`` names ``black`` and ``white``. Picture n
    of N of a phase shift shows A + B cos(2 pi x / period_px + phase), with the phase 360 n / N degrees, or the n-th
    of ``phases_deg``. All pictures need one exposure. RAW, EXR, TIFF, PNG and JPEG are read as by ``develop``; a
    JPEG of Gray code alone needs no response, since a bit only asks which picture is brighter.

    Parameters
    ----------
    camera : as ``develop``

    Returns
    -------
    ``Correspondence`` without ``as_seen_px``; not smoothed

    Errors: ``captures-description-wrong``, ``capture-file-missing``, ``capture-shape-wrong``; those of ``develop``;
    ``captures-inconsistent``, which says what is wrong with the pictures, their order or the projector's size.
    """
    folder = Path(folder)
    said = _description(folder)
    gray, phase = said["gray"], said["phase"]
    if camera is None and not phase:
        camera = _AS_THEY_ARE
    reader = _Reader(folder, camera)
    named = said.get("pictures", {})
    width, height = said["projector_px"]
    bits = (_bits(reader, gray, 0, named, width), _bits(reader, gray, 1, named, height))
    waves = (_wave(reader, phase, "x"), _wave(reader, phase, "y"))
    for axis in range(2):
        wave = waves[axis]
        if wave is not None and wave.period_px < 2 * bits[axis].cell_px:
            raise unfit(folder, "a period is shorter than two cells", "Use a finer Gray code, or a longer period.")
    return decode_any(bits, waves, (width, height), mirrored=gray.get("mirrored", False) is True)


def _description(folder: Path) -> dict[str, Any]:
    """What ``captures.toml`` says, with both tables. Raises the error ``captures-description-wrong``."""
    said = {"phase": {}, **description_of(folder / DESCRIPTION)}
    gray, phase = said.get("gray"), said["phase"]
    if not isinstance(gray, dict) or not isinstance(phase, dict) or "projector_px" not in said:
        raise unfit(
            folder, "it has no table [gray] or no projector_px", "Write both in captures.toml, as the reference shows."
        )
    if set(gray) - {"cell_px", "x", "y", "offset_px", "mirrored"} or set(phase) - {"x", "y"}:
        raise unfit(folder, "[gray] or [phase] has an unknown key", "Use x, y, cell_px, offset_px and mirrored.")
    return said


class _Reader:
    """Photographs as linear light, all of one size, NaN where clipped."""

    def __init__(self, folder: Path, camera: CameraProfile | None) -> None:
        self.folder, self._camera = folder, camera
        self._shape: tuple[int, ...] | None = None

    def read(self, name: str) -> FloatImage:
        path = self.folder / name
        if not path.is_file():
            raise UsageError(
                "capture-file-missing",
                what=f"The file {path} does not exist.",
                remedy="Correct its name in captures.toml, or copy the file into the folder.",
            )
        image = develop(path, camera=self._camera).image
        if self._shape is not None and image.shape != self._shape:
            raise CalibrationError(
                "capture-shape-wrong",
                what=f"{name} has another size than the pictures before it.",
                remedy="Give pictures that the camera took with one setting.",
            )
        self._shape = image.shape
        return image


def _bits(reader: _Reader, gray: Mapping[str, Any], axis: int, named: Any, size_px: int) -> Bits:
    name, cell_px, offset_px = "xy"[axis], gray.get("cell_px", 1), gray.get("offset_px", [0, 0])
    rows = gray.get(name)
    if not isinstance(rows, list) or not rows or not isinstance(cell_px, int) or cell_px < 1:
        raise unfit(
            reader.folder, f"[gray] has no list {name}, or cell_px is no whole number", "Name the picture of each bit."
        )
    if not (isinstance(offset_px, list) and len(offset_px) == 2 and all(type(one) is int for one in offset_px)):
        raise unfit(reader.folder, "offset_px is not two whole numbers", "Write it as [19, 0].")
    if 2 ** len(rows) * cell_px < size_px + offset_px[axis]:
        raise unfit(
            reader.folder,
            f"{len(rows)} bits of {name} are {2 ** len(rows)} cells of {cell_px} px, but the projector has {size_px}",
            "Give all bits, the coarsest one first, or correct cell_px or projector_px.",
        )
    if all(_are_names(row, 2) and len(row) == 2 for row in rows):
        return Bits(((reader.read(one), reader.read(other)) for one, other in rows), cell_px, offset_px[axis])
    ends: list[Any] = [named.get("black"), named.get("white")] if isinstance(named, dict) else []
    if not _are_names(rows, 1) or not _are_names(ends, 2):
        raise unfit(
            reader.folder,
            f"the bits of {name} are not pairs of files",
            "Give each bit with its opposite, or name black and white in [pictures].",
        )
    threshold = np.asarray((reader.read(ends[0]) + reader.read(ends[1])) / 2, np.float32)
    return Bits(((reader.read(one), threshold) for one in rows), cell_px, offset_px[axis], opposites=False)


def _wave(reader: _Reader, phase: Mapping[str, Any], axis: str) -> Sinusoid | None:
    said = phase.get(axis)
    if said is None:
        return None
    files = said.get("files") if isinstance(said, dict) else None
    unknown = not isinstance(said, dict) or set(said) - {"files", "period_px", "phases_deg"}
    if unknown or not isinstance(files, list) or not _are_names(files, 3) or not _is_positive(said.get("period_px")):
        raise unfit(
            reader.folder,
            f"[phase] {axis} has no period_px, fewer than three files, or an unknown key",
            "Write both, as the reference shows.",
        )
    degrees = said.get("phases_deg", [360 * n / len(files) for n in range(len(files))])
    numbers = isinstance(degrees, list) and all(isinstance(one, int | float) for one in degrees)
    if not numbers or len(degrees) != len(files) or len({round(one % 360, 6) for one in degrees}) < 3:
        raise unfit(reader.folder, "phases_deg are not three different angles", "Give one for each file.")
    return Sinusoid((reader.read(name) for name in files), np.deg2rad(degrees).tolist(), float(said["period_px"]))


def _are_names(value: Any, least: int) -> bool:
    return isinstance(value, list) and len(value) >= least and all(isinstance(one, str) for one in value)


def _is_positive(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and 0 < value < np.inf
