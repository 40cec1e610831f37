"""Photographs as linear light: RAW files of any Bayer camera, EXR and TIFF files that are linear already, and JPEG
files where the camera's response is known.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from controller.core import channels
from controller.core.arrays import Float64, FloatImage, Mask
from controller.core.colour import Unsuitable
from controller.core.errors import UsageError, WorkError
from controller.core.files import check_pixels, require_regular
from controller.core.pictures import HEIC, is_heic, read_picture_file
from controller.optics.capture import linear_files
from controller.optics.capture.demosaic import SensorLevels, demosaic, fill_bad
from controller.optics.capture.profile import CameraProfile

SATURATED_SHARE = 0.985
"""Of full scale: sensors become nonlinear shortly before they clip."""
JPEG_SATURATED = 254
RAW_SUFFIXES = (
    ".dng", ".cr3", ".cr2", ".crw", ".nef", ".nrw", ".arw", ".sr2", ".srf", ".raf", ".rw2", ".raw", ".orf", ".pef",
    ".srw", ".3fr", ".fff", ".iiq", ".erf", ".mef", ".mos", ".mrw", ".dcr", ".kdc", ".x3f",
)  # fmt: skip
SINGULAR = 1e-6
SRGB_TO_XYZ = np.array([[0.412453, 0.357580, 0.180423], [0.212671, 0.715160, 0.072169], [0.019334, 0.119193, 0.950227]])
"""D65, with the digits that LibRaw uses."""


OPTICS_BLUR_PX = 0.5
"""Standard deviation of a sharp lens with its sensor's pixel, in camera pixels."""
CAMERA_BLUR_PX = tuple(math.hypot(OPTICS_BLUR_PX, math.sqrt(variance)) for variance in (1 / 2, 1 / 4, 1 / 2))
"""Red, green and blue, with the bilinear interpolation of this module: its variance along an axis, averaged over the
sites of the colour pattern, is 1/2 for red and blue and 1/4 for green."""


@dataclass(frozen=True, slots=True)
class Photograph:
    """One exposure in linear light.

    ``image`` (rows, columns, 3) float32 camera RGB, 0 at the black level, 1 at full scale; noise may go below 0
    ``saturated`` (rows, columns) bool: some sample that this pixel is made of was clipped
    ``camera_to_xyz`` (3, 3) linear camera RGB to CIE XYZ as the file states it, None where it does not
    ``colours`` (2, 2) the Bayer pattern it was interpolated from (0 red, 1 green, 2 blue; see ``bayer_kernels``), None
    for a file with three colours for each pixel, whose interpolation is the camera's secret
    """

    image: FloatImage
    saturated: Mask
    camera_to_xyz: Float64 | None
    colours: npt.NDArray[np.int64] | None = None

    def measured(self) -> FloatImage:
        """The image with NaN where it was saturated: NaN means not measured everywhere in ``calibrate``."""
        image = self.image.copy()
        image[self.saturated] = np.nan
        return image


@dataclass(frozen=True, slots=True)
class RawMosaic:
    """A RAW file's samples as the sensor gave them: ``samples`` (rows, columns) uint16, and what they mean."""

    samples: npt.NDArray[np.uint16]
    levels: SensorLevels
    camera_to_xyz: Float64 | None

    def developed(self) -> Photograph:
        """Interpolated to an image in linear light."""
        image, saturated = demosaic(self.samples, self.levels)
        return Photograph(image, saturated, self.camera_to_xyz, self.levels.colours)

    def linear(self) -> tuple[FloatImage, Mask]:
        """(rows, columns) float32 samples, 0 at black and 1 at full scale, and which were clipped."""
        linear = np.empty(self.samples.shape, np.float32)
        clipped = np.empty(self.samples.shape, np.bool_)
        for row, column in np.ndindex(2, 2):
            site = self.samples[row::2, column::2]
            black, white = self.levels.black[row, column], self.levels.white[row, column]
            linear[row::2, column::2] = (site - np.float32(black)) / np.float32(white - black)
            clipped[row::2, column::2] = site >= self.levels.clip[row, column]
        return linear, clipped


def read_photograph(path: Path, *, response: Float64 | None = None, profile: CameraProfile | None = None) -> Photograph:
    """Read a RAW file (any kind that LibRaw knows, Bayer sensors), an EXR or a TIFF of 16 bits, or a JPEG with its
    ``response`` (3, 256).

    ``profile`` is what was measured of the camera: its black level, its limits, bad pixels and JPEG response go before
    what the file says.

    Raises
    ------
    WorkError("photograph-unreadable")  no such file, or damaged
    UsageError("raw-not-bayer")  the sensor has no 2x2 colour pattern
    UsageError("jpeg-response-missing")  a JPEG says nothing of light without the camera's response table
    """
    if is_jpeg(path):
        if response is None and profile is not None:
            response = profile.response
        if response is None:
            raise UsageError(
                "jpeg-response-missing",
                what=f"{path.name} is a JPEG, and the camera's response is not known.",
                remedy="Set the camera to RAW, or measure its response first.",
            )
        return _read_jpeg(path, response)
    if linear_files.is_linear(path):
        return Photograph(*_read_linear(path), None)
    return read_mosaic(path, profile=profile).developed()


def read_samples(path: Path) -> tuple[FloatImage, Mask]:
    """What a RAW, EXR or TIFF file says of light, before any interpolation.

    (rows, columns) float32 of a mosaic or (rows, columns, 3) of three colours, 0 at black and 1 at full scale; and
    (rows, columns) bool where it was clipped. Raises as ``read_photograph``.
    """
    return _read_linear(path) if linear_files.is_linear(path) else read_mosaic(path).linear()


def _read_linear(path: Path) -> tuple[FloatImage, Mask]:
    try:
        return linear_files.read_linear(path)
    except Unsuitable as error:
        raise _unreadable(path, error) from error


def is_jpeg(path: Path) -> bool:
    """Whether a photograph is a JPEG, by its name."""
    return path.suffix.lower() in (".jpg", ".jpeg")


def read_mosaic(path: Path, *, profile: CameraProfile | None = None) -> RawMosaic:
    """A RAW file before its interpolation; raises as ``read_photograph``."""
    import rawpy

    try:
        require_regular(path)
        with rawpy.imread(str(path)) as raw:
            check_pixels(path, (raw.sizes.raw_width, raw.sizes.raw_height))
            mosaic = raw.raw_image_visible.copy()
            sites = _sites(raw)
            colours = _colour_of_sites(raw, sites, path)
            black, white = _levels(raw, sites[:2, :2])
            camera_to_xyz = _camera_to_xyz(raw)
    except (rawpy.LibRawError, OSError) as error:
        raise _unreadable(path, error) from error
    clip = black + SATURATED_SHARE * (white - black)
    steps = _black_steps(path)
    if steps is not None:
        row, column = (np.arange(side) % 2 for side in mosaic.shape)
        clipped = mosaic >= clip[row[:, None], column]
        mosaic = np.where(clipped, mosaic, np.clip(np.rint(mosaic - steps), 0, 65535)).astype(np.uint16)
        white = white - steps.max()  # full scale is counted from the highest black (DNG, chapter 5)
    if profile is not None:
        mosaic = fill_bad(mosaic, profile.bad_px)
        black = black + profile.black_offset
        clip = np.minimum(clip, profile.clip)
    return RawMosaic(mosaic, SensorLevels(colours, black, white, clip), camera_to_xyz)


def raw_size(path: Path) -> tuple[int, int]:
    """(width, height) of a RAW file's picture. Raises WorkError("photograph-unreadable")."""
    import rawpy

    try:
        with rawpy.imread(str(path)) as raw:
            return int(raw.sizes.width), int(raw.sizes.height)
    except (rawpy.LibRawError, OSError) as error:
        raise _unreadable(path, error) from error


def _unreadable(path: Path, reason: Exception) -> WorkError:
    words = reason.strerror if isinstance(reason, OSError) and reason.strerror else reason
    remedy = "Take it again; if this happens often, check the camera's card and cable."
    if isinstance(reason, Unsuitable):
        remedy = "Take it again, or convert it to a TIFF of 16 bits in red, green and blue."
    elif reason.args and isinstance(reason.args[0], bytes):  # LibRaw's
        words = reason.args[0].decode("ascii", "replace")
        with path.open("rb") as file:
            if is_heic(file.read(12)):
                words, remedy = HEIC, "Set the camera to RAW or JPEG, and take it again."
    return WorkError(
        "photograph-unreadable", what=f"The photograph {path.name} can't be read ({words}).", remedy=remedy
    )


def _sites(raw: Any) -> npt.NDArray[np.int64]:
    """(4, 4) LibRaw's numbers of the colours at the visible area's first rows and columns; empty without a pattern.

    One by one: LibRaw's table of all samples takes as long as reading the file.
    """
    if raw.raw_pattern is None:
        return np.empty((0, 0), np.int64)
    top, left = raw.sizes.top_margin, raw.sizes.left_margin
    return np.array([[raw.raw_color(top + row, left + column) for column in range(4)] for row in range(4)], np.int64)


def _colour_of_sites(raw: Any, sites: npt.NDArray[np.int64], path: Path) -> npt.NDArray[np.int64]:
    """(2, 2) of 0 red, 1 green, 2 blue at the visible area's first rows and columns."""
    letters = raw.color_desc.decode("ascii")
    regular = sites.shape == (4, 4) and np.array_equal(sites[:2, :2], sites[2:, 2:]) and sites.max() < len(letters)
    names = "".join(sorted(letters[index] for index in sites[:2, :2].ravel())) if regular else ""
    if names != "BGGR":
        raise UsageError(
            "raw-not-bayer",
            what=f"The sensor of {path.name} has no Bayer pattern.",
            remedy="Use a camera with a Bayer sensor, or JPEG.",
        )
    return np.array([["RGB".index(letters[index]) for index in row] for row in sites[:2, :2]], np.int64)


_DELTA_ACROSS, _DELTA_DOWN, _MOSAIC = 50715, 50716, 32803


def _black_steps(path: Path) -> Float64 | None:
    """(rows, columns): what a DNG adds to the black level by row and column (1.7, BlackLevelDeltaV and H).

    None where it adds nothing. LibRaw counts their rounded means alone.
    """
    if path.suffix.lower() != ".dng":
        return None
    import tifffile

    with tifffile.TiffFile(path) as file:
        pages: list[Any] = [one for page in file.pages for one in (page, *(getattr(page, "pages", None) or ()))]
        tags: Any = next((page.tags for page in pages if page.photometric == _MOSAIC), {})
        values = [tags[code].value if code in tags else (0, 1) for code in (_DELTA_DOWN, _DELTA_ACROSS)]
    pairs = [np.reshape(value, (-1, 2)).astype(np.float64) for value in values]
    down, across = (pair[:, 0] / pair[:, 1] for pair in pairs)
    if not down.any() and not across.any():
        return None
    counted = sum(np.floor(one.mean() + 0.5) for one in (down, across))
    return np.asarray(down[:, None] + across - counted)


def _levels(raw: Any, sites: npt.NDArray[np.int64]) -> tuple[Float64, Float64]:
    """(2, 2) black and white level at each of the ``sites`` (2, 2) of the colour pattern."""
    black = np.asarray(raw.black_level_per_channel, np.float64)[sites]
    per_channel = raw.camera_white_level_per_channel
    known = per_channel is not None and min(np.asarray(per_channel)[sites].ravel()) > 0
    white = np.asarray(per_channel, np.float64)[sites] if known else np.full((2, 2), float(raw.white_level))
    return black, white


def _camera_to_xyz(raw: Any) -> Float64 | None:
    """From LibRaw's XYZ-to-camera matrix where it knows the camera, else from the DNG's own matrix.

    LibRaw keeps a DNG's matrix only as balanced camera RGB to sRGB, with the daylight balance beside it.
    """
    to_camera = np.asarray(raw.rgb_xyz_matrix, np.float64)[:3]
    if abs(np.linalg.det(to_camera)) > SINGULAR:
        return np.asarray(np.linalg.inv(to_camera), np.float64)
    to_srgb = np.asarray(raw.color_matrix, np.float64)[:, :3] * np.asarray(raw.daylight_whitebalance[:3], np.float64)
    return SRGB_TO_XYZ @ to_srgb if abs(np.linalg.det(to_srgb)) > SINGULAR else None


def develop(
    mosaic: npt.NDArray[np.uint16],
    colours: npt.NDArray[np.int64],
    black: Float64,
    white: Float64,
    *,
    camera_to_xyz: Float64 | None = None,
) -> Photograph:
    """Black level off, scaled to full scale, bilinear interpolation of the colours: linear in every sample.

    ``mosaic`` (rows, columns) uint16; ``colours``, ``black``, ``white`` (2, 2) of the colour pattern's sites. The exact
    kernels of the interpolation: ``controller.optics.capture.demosaic.bayer_kernels(photograph.colours)``.
    """
    levels = SensorLevels(colours, black, white, black + SATURATED_SHARE * (white - black))
    return RawMosaic(mosaic, levels, camera_to_xyz).developed()


def read_jpeg_values(path: Path) -> npt.NDArray[np.uint8]:
    """(rows, columns, 3) uint8 RGB of a JPEG as it lies on the sensor, without light. Raises WorkError as above."""
    try:
        values = read_picture_file(path, upright=False).values
    except Unsuitable as error:
        raise _unreadable(path, error) from error
    return np.ascontiguousarray(np.broadcast_to(values, (*values.shape[:2], 3)), np.uint8)


def _read_jpeg(path: Path, response: Float64) -> Photograph:
    decoded = read_jpeg_values(path)
    table = np.asarray(response, np.float32)
    image = np.stack([table[channel][decoded[:, :, channel]] for channel in range(3)], axis=2)
    return Photograph(image, channels.some(decoded >= JPEG_SATURATED), None)
