"""Photographs as linear light: development of one file, and exposure brackets merged to one image."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from controller.api.arrays import as_images
from controller.core.arrays import Float64, FloatImage, Mask
from controller.core.errors import WorkError
from controller.optics.capture import brackets, linear_files, raw
from controller.optics.capture.brackets import MergedBracket
from controller.optics.capture.profile import CameraNoise, CameraProfile


@dataclass(frozen=True, slots=True)
class Developed:
    """One photograph in linear light.

    ``image`` (rows, columns, 3) float32 camera RGB: 0 at the black level, 1 at full scale; noise may go below 0; NaN
    where the photograph is saturated
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
        except linear_files.Unreadable as error:
            raise _unreadable(path, error) from error
        image[saturated] = np.nan
        return Developed(image, saturated, None, None, None)
    photograph = raw.read_photograph(path, profile=camera)
    noise = None if camera is None else camera.noise
    return Developed(photograph.measured(), photograph.saturated, noise, photograph.camera_to_xyz, photograph.colours)


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
    noise : the camera's; without it that of a 12-bit APS-C camera

    Returns
    -------
    ``MergedBracket``: ``radiance`` (rows, columns, 3) float32, full scales per second, NaN where no exposure measured
    it, and ``sigma`` of the same shape, its standard deviation.

    Errors: ``bracket-mismatch``.
    """
    return brackets.merge_brackets(as_images(images), exposures_s, noise=noise)
