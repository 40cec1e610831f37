"""The patterns of one projector to show, folders of their photographs, and photographs as linear light.

One file is developed; exposure brackets are merged to one image.
"""

from __future__ import annotations

import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from controller.core import channels
from controller.core.arrays import ByteImage, Float64, FloatImage, Mask, as_light
from controller.core.colour import Unsuitable
from controller.core.errors import UsageError, WorkError
from controller.core.files import read_text
from controller.optics.capture import brackets, linear_files, raw
from controller.optics.capture.brackets import MergedBracket
from controller.optics.capture.pattern_frames import device_frame
from controller.optics.capture.patterns import plan_patterns
from controller.optics.capture.profile import CameraNoise, CameraProfile, true_exposure


@dataclass(frozen=True, slots=True)
class Developed:
    """One photograph in linear light.

    ``image`` (rows, columns, 3) float32 camera RGB: 0 at the black level, 1 at full scale; noise may go below 0; NaN
    where the photograph is saturated: in that colour alone if it is not RAW
    ``saturated`` (rows, columns) bool: a sample that this pixel is made of was saturated
    ``noise``: variance of a sample of value v is ``noise.shot`` v + ``noise.read`` squared; None if it is unknown
    ``camera_to_xyz`` (3, 3) float64: linear camera RGB to CIE XYZ (D65); None if the file does not contain it
    ``bayer`` (2, 2) int64: colours of the interpolated samples (0 red, 1 green, 2 blue) at even
    and odd rows and columns; None if each pixel had three colours
    """

    image: FloatImage
    saturated: Mask
    noise: CameraNoise | None
    camera_to_xyz: Float64 | None
    bayer: npt.NDArray[np.int64] | None


def develop(path: Path | str, *, camera: CameraProfile | None = None) -> Developed:
    """Read one photograph as linear light.

    RAW files (all that LibRaw reads, from sensors with a Bayer pattern): black level subtracted, scaled to full scale,
    colours interpolated bilinearly. JPEG files: by the camera's measured response. PNG and TIFF files of 8 or 16 bits
    and EXR files are taken as linear light as they are; the largest whole number counts as saturated.

    Parameters
    ----------
    path : the file; the end of its name gives its kind
    camera : measurements of the camera (black level, clipping, bad pixels, response, noise), for example
        ``read_run(folder).camera``; they take precedence over the values in the file

    Errors: ``photograph-unreadable``, ``raw-not-bayer``, ``jpeg-response-missing``.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix in (*linear_files.SUFFIXES, ".png"):
        try:
            image, saturated = linear_files.read_linear(path, bits=(8, 16))
        except Unsuitable as error:
            raise _unreadable(path, error) from error
        return Developed(_measured(image, saturated), saturated, None, None, None)
    photograph = raw.read_photograph(path, profile=camera)
    noise = None if camera is None else camera.noise
    # a RAW sample spreads over its neighbours, of which not all are measured then
    several = photograph.colours is not None
    image = photograph.measured() if several else _measured(photograph.image, photograph.saturated)
    return Developed(image, photograph.saturated, noise, photograph.camera_to_xyz, photograph.colours)


def _measured(image: FloatImage, saturated: Mask) -> FloatImage:
    """NaN in the colours that are saturated, and in all colours of a pixel that does not show in which."""
    clipped = ~np.isfinite(image) | (image >= 1)
    clipped |= ~channels.some(clipped)[..., None]
    return np.where(saturated[..., None] & clipped, np.float32(np.nan), image)


def _unreadable(path: Path, reason: object) -> WorkError:
    return WorkError(
        "photograph-unreadable",
        what=f"The photograph {path.name} can't be read ({reason}).",
        remedy="Check that the file exists and opens in another program.",
    )


def merge_brackets(
    images: Sequence[npt.ArrayLike], exposures_s: Sequence[float], *, noise: CameraNoise | None = None
) -> MergedBracket:
    """Merge exposures of one still scene into one HDR image.

    Each sample is weighted by the inverse of its variance, which the noise model gives from a first estimate.

    Parameters
    ----------
    images : of one size, (rows, columns, 3) float32, 0 at black and 1 at full scale, NaN where saturated
        (``Developed.image``)
    exposures_s : exposure time of each image, seconds, above 0
    noise : the camera's; without it, as the images themselves show it

    Returns
    -------
    ``MergedBracket``: ``radiance`` (rows, columns, 3) float32, full scales per second, NaN where no exposure measured
    it, and ``sigma`` of the same shape, its standard deviation.

    Errors: ``bracket-mismatch``.
    """
    return brackets.merge_brackets([as_light(one) for one in images], exposures_s, noise=noise)


DESCRIPTION: Final = "captures.toml"
_KEYS: Final = ("projector_px", "exposure_s", "pictures", "gray", "phase")
_SUFFIXES: Final = (*raw.RAW_SUFFIXES, *linear_files.SUFFIXES, ".png", ".jpg", ".jpeg")
Pictures = Mapping[str, "str | Sequence[tuple[str, float]]"]


@dataclass(frozen=True, slots=True)
class CaptureSet:
    """Camera pictures of one projector's patterns.

    ``pictures``: by pattern name (``draw_patterns``), (rows, columns) or (rows, columns, 3) float32 linear light, in
    one unit, NaN where saturated. A dictionary of arrays, or a mapping that loads each at its use.
    ``projector_px``: (width, height) of the projector
    ``camera_to_xyz`` (3, 3) float64: linear camera RGB to CIE XYZ (D65); None if it is unknown
    ``from_bayer``: the pictures were interpolated bilinearly from a Bayer pattern, as by ``develop``
    """

    pictures: Mapping[str, FloatImage]
    projector_px: tuple[int, int]
    camera_to_xyz: Float64 | None = None
    from_bayer: bool = False


def draw_patterns(projector_px: tuple[int, int], *, response: npt.ArrayLike | None = None) -> dict[str, ByteImage]:
    """The pictures to show, one after the other, to calibrate one projector while the others show black.

    ``black``, ``white``; ``gray-x-0``.., ``gray-y-0``..: Gray code of cells 12 projector pixels wide, coarsest bit
    first; ``mosaic-0``..: coloured tiles, from which the response is measured; ``phase-x-0`` to ``2``, ``phase-y-..``:
    sinusoids of 24 pixels in three steps of a third of a period; ``blur-x-..``, ``blur-y-..``, ``blur-d-..``: fine
    sinusoids of 5, 5 and 7 pixels; ``random-0``: a picture to check the result with.

    Sinusoids and the random picture need the projector's response: photograph the others first, then use
    ``measure_response``.

    Parameters
    ----------
    projector_px : (width, height), at least 24 pixels a side
    response : (3, 256) linear light of each device value per channel, 0 at black, 1 at white
        (``Radiometry.response``); without it, only the pictures that need none are returned

    Returns
    -------
    by name, in the order to show them: (rows, columns, 3) uint8 device values

    Errors: ``projector-too-small``, ``response-not-rising``.
    """
    table = None if response is None else np.asarray(response, np.float64)
    return {
        pattern.name: device_frame(pattern, projector_px, table)
        for pattern in plan_patterns(projector_px)
        if table is not None or not pattern.needs_response
    }


def read_captures(
    folder: Path | str,
    *,
    projector_px: tuple[int, int] | None = None,
    pictures: Pictures | None = None,
    exposure_s: float | None = None,
    camera: CameraProfile | None = None,
) -> CaptureSet:
    """The photographs of one projector's patterns from a folder. Each is developed at its use.

    ``captures.toml`` in the folder lists the file of each pattern; arguments take precedence. Without a table
    ``[pictures]``, each file has the name of its pattern, for example ``gray-x-0.CR2``; other kinds of files are left
    out, and of several photographs a RAW file counts before an EXR, TIFF, PNG and JPEG.

    ::

        projector_px = [1400, 1050]     # width, height
        exposure_s = 0.05               # of every picture without its own

        [pictures]
        black = "IMG_0001.CR2"
        gray-x-0 = "IMG_0004.CR2"
        white = [
            { file = "IMG_0002.CR2", exposure_s = 0.0125 },
            { file = "IMG_0003.CR2", exposure_s = 0.05 },
        ]

    Parameters
    ----------
    projector_px : (width, height)
    pictures : by pattern name, a file's name in the folder, or several (file name, exposure in seconds) that are merged
    exposure_s : seconds; 1 if it is given nowhere
    camera : as ``develop``

    Returns
    -------
    ``CaptureSet``: (rows, columns, 3) float32 pictures in full scales per second

    Errors: ``captures-description-wrong``, ``capture-file-missing``; those of ``develop`` when a picture is used.
    """
    folder = Path(folder)
    said = description_of(folder / DESCRIPTION)
    size = projector_px or said.get("projector_px")
    if size is None:
        raise unfit(folder, "it does not give the size of the projector", "Give projector_px = [width, height].")
    named = pictures if pictures is not None else _pictures(folder, said.get("pictures"))
    each_s = exposure_s if exposure_s is not None else said.get("exposure_s", 1.0)
    files = _existing_files(folder, named, each_s)
    first = next(iter(files.values()), None)
    if first is None:
        raise unfit(folder, "it has no picture of a pattern", "Name the files after the patterns, or list them.")
    sample = develop(first[0][0], camera=camera)
    width, height = size
    return CaptureSet(
        _Folder(files, camera), (int(width), int(height)), sample.camera_to_xyz, from_bayer=sample.bayer is not None
    )


def _existing_files(folder: Path, named: Pictures, each_s: float) -> dict[str, list[tuple[Path, float]]]:
    """The files of each pattern with their exposures in seconds; ``each_s`` where none is given.

    Raises UsageError("capture-file-missing").
    """
    files: dict[str, list[tuple[Path, float]]] = {}
    for name, value in named.items():
        taken = [(value, each_s)] if isinstance(value, str) else [(file, seconds or each_s) for file, seconds in value]
        if not all(brackets.is_time(seconds) for _, seconds in taken):
            raise unfit(folder, f"an exposure time of {name} is not a number above 0", "Give it in seconds.")
        files[name] = [(folder / file, float(seconds)) for file, seconds in taken]
        missing = next((path for path, _ in files[name] if not path.is_file()), None)
        if missing is not None:
            raise UsageError(
                "capture-file-missing",
                what=f"The file {missing} for the pattern {name} does not exist.",
                remedy="Correct its name in captures.toml, or copy the file into the folder.",
            )
    return files


class _Folder(Mapping[str, FloatImage]):
    """Photographs by pattern name, developed at each use."""

    def __init__(self, files: Mapping[str, Sequence[tuple[Path, float]]], camera: CameraProfile | None) -> None:
        self._files = files
        self._camera = camera

    def __getitem__(self, name: str) -> FloatImage:
        taken = self._files[name]
        images = [develop(path, camera=self._camera).image for path, _ in taken]
        seconds = [true_exposure(self._camera, exposure_s) for _, exposure_s in taken]
        if len(images) > 1:
            noise = None if self._camera is None else self._camera.noise
            return merge_brackets(images, seconds, noise=noise).radiance
        return np.asarray(images[0] / np.float32(seconds[0]), np.float32)

    def __iter__(self) -> Iterator[str]:
        return iter(self._files)

    def __len__(self) -> int:
        return len(self._files)


def description_of(path: Path) -> dict[str, Any]:
    """The content of captures.toml, {} without one. Raises UsageError("captures-description-wrong")."""
    if not path.exists():
        return {}
    try:
        said = tomllib.loads(read_text(path))
    except UnicodeDecodeError as error:
        raise unfit(path, "it is not UTF-8 text", "Save it as UTF-8.") from error
    except tomllib.TOMLDecodeError as error:
        raise unfit(path, f"it is not TOML ({error})", "Correct the line.") from error
    unknown = sorted(set(said) - set(_KEYS))
    if unknown:
        raise unfit(path, f"the key {unknown[0]} is not known", f"Use {', '.join(_KEYS)}.")
    size = said.get("projector_px", [1, 1])
    if not (isinstance(size, list) and len(size) == 2 and all(isinstance(side, int) and side > 0 for side in size)):
        raise unfit(path, "projector_px is not two whole numbers", "Write it as [1400, 1050].")
    if not brackets.is_time(said.get("exposure_s", 1)):
        raise unfit(path, "exposure_s is not a number above 0", "Write the exposure time in seconds.")
    return said


def _pictures(folder: Path, table: Any) -> Pictures:
    """Files by pattern from the table ``[pictures]``; without it, from the names of the files."""
    if table is None:
        # What says most of light comes last, and wins: RAW before a JPEG that the camera wrote beside it.
        photographs = [path for path in folder.iterdir() if path.suffix.lower() in _SUFFIXES and path.is_file()]
        photographs.sort(key=lambda path: (-_SUFFIXES.index(path.suffix.lower()), path.name))
        return {path.stem: path.name for path in photographs if _is_pattern(path.stem)}
    if not isinstance(table, dict):
        raise unfit(folder, "pictures is not a table", "Write one line for each pattern below [pictures].")
    found: dict[str, str | Sequence[tuple[str, float]]] = {}
    for name, value in table.items():
        rows = value if isinstance(value, list) else [{"file": value}]
        if not rows or not all(_is_taken(row) for row in rows):
            raise unfit(
                folder,
                f"the pattern {name} has no file name, or no exposure time above 0",
                'Write "FILE", or a list of { file = "FILE", exposure_s = SECONDS }.',
            )
        found[name] = [(row["file"], float(row.get("exposure_s", 0))) for row in rows]
    return found


def _is_pattern(stem: str) -> bool:
    first, _, rest = stem.partition("-")
    return stem in ("black", "white") or (first in ("gray", "mosaic", "phase", "blur", "random") and bool(rest))


def _is_taken(row: Any) -> bool:
    if not isinstance(row, dict) or set(row) - {"file", "exposure_s"} or not isinstance(row.get("file"), str):
        return False
    return brackets.is_time(row.get("exposure_s", 1))


def unfit(where: Path, why: str, remedy: str) -> UsageError:
    """``why`` completes "FILE can't be used: ..."."""
    return UsageError("captures-description-wrong", what=f"{where} can't be used: {why}.", remedy=remedy)
