"""Reads the complete calibration from a run's folder."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from controller.core.arrays import FloatImage, Mask, array_in_file, strips
from controller.core.channels import smallest
from controller.optics.calibrate.geometry.background import room_beside_planes, room_pixels
from controller.optics.calibrate.values import Calibration, Correspondence, PhaseMap, ProjectorCalibration
from controller.optics.capture.brackets import MergedBracket, merge_brackets
from controller.optics.capture.raw import CAMERA_BLUR_PX
from controller.stage.artefacts.geometry import known_points_m, read_geometry_figures, read_shape
from controller.stage.artefacts.outline import read_outline
from controller.stage.artefacts.photographs import BLACK, TakenPhotograph, codes_of, light_of
from controller.stage.artefacts.projectors import (
    Light,
    Pixels,
    mode_of,
    read_indirect,
    read_metapixels,
    read_white_gain,
)

LIT_SHARE = 0.004
"""A camera pixel counts as lit if a projector's white is above this share of the brightest white."""


def merged(taken: Sequence[TakenPhotograph]) -> MergedBracket:
    """Radiance in full scales per second, and its noise, from photographs of one picture."""
    noise = taken[0].profile.noise if taken and taken[0].profile is not None else None
    return merge_brackets([t.measured() for t in taken], [t.exposure_s for t in taken], noise=noise)


def merge_photographs(taken: Sequence[TakenPhotograph]) -> FloatImage:
    """The radiance of ``merged``."""
    return merged(taken).radiance


def read_black(folder: Path) -> FloatImage:
    """The HDR black image of a run, merged from its photographs."""
    return merge_photographs(BLACK.read(folder))


def read_captures(folder: Path, projector: str) -> dict[str, TakenPhotograph]:
    """All photographs of one projector's patterns, by the pattern's name."""
    return {**light_of(projector).by_name(folder), **codes_of(projector).by_name(folder)}


def read_correspondence(folder: Path, projector: str) -> Correspondence:
    """The correspondences decoded from the sinusoids of a projector."""
    return Pixels.read(folder, projector).correspondence


def projectors_of(folder: Path) -> list[str]:
    """The run's projectors, in its order. Raises OSError, ValueError or KeyError for a run without geometry."""
    return list(read_geometry_figures(folder)["projectors"])


def _drawn(run: Path, shape: tuple[int, ...]) -> Mask | None:
    """(rows, columns): inside the outline that a person drew; None where none was."""
    regions = read_outline(run)
    inside = np.zeros(shape, np.uint8)
    for region in regions:
        # one by one: where two overlap, both are the object
        cv2.fillPoly(inside, [np.rint(np.array(region) * (shape[1], shape[0])).astype(np.int32)], 1)
    return inside > 0 if regions else None


def read_calibration(folder: Path, projectors: Sequence[str]) -> Calibration:
    """The calibration of the finished run in ``folder``."""
    parts = []
    mosaic: npt.NDArray[np.int64] | None = None
    found = read_indirect(folder, projectors)
    for number, name in enumerate(projectors):
        light = Light.read(folder, name)
        pixels = _phase_pixels(folder, name)
        phase_map = spread = None
        if pixels is not None:
            phase_map, spread = pixels.phase_map, pixels.surface_spread
            mosaic = mosaic if pixels.known_mosaic is None else pixels.known_mosaic
        white, radiometry = _known(light.white), light.radiometry
        gain = read_white_gain(folder, name) if found is None else found[number].white_gain
        if gain is not None:
            white = _times(white, gain, folder)
        indirect = stripes = None
        if found is not None:
            radiometry = found[number].radiometry
            white, indirect = _parted(white, found[number].share, folder)
            stripes = found[number].stripes
        metapixels = read_metapixels(folder, name)
        parts.append(ProjectorCalibration(name, metapixels, radiometry, white, phase_map, indirect, stripes, spread))
    black = _known(light.black)
    red, green, blue = CAMERA_BLUR_PX
    camera_blur_px = (red, green, blue)
    mask = object_mask(parts)
    if (drawn := _drawn(folder, mask.shape)) is not None:
        mask &= drawn
    elif (points_m := known_points_m(folder)) is not None:
        flat = read_shape(folder).shape == "plane"
        mask &= ~(room_beside_planes(points_m, mask) if flat else room_pixels(points_m))
    return Calibration(tuple(parts), black, mask, light.camera_to_xyz, camera_blur_px, mosaic)


def _known(image: FloatImage) -> FloatImage:
    """The same picture, 0 where it was not measured.

    In place: of a mapped file, only the pages with saturated pixels become memory of this process.
    """
    np.copyto(image, np.float32(0), where=np.isnan(image))
    return image


def _times(white: FloatImage, gain: npt.NDArray[np.floating], folder: Path) -> FloatImage:
    """Their product, in a nameless file of the run's disk where it is large."""
    product = array_in_file(folder, white.shape)
    for rows in strips(len(white)):
        np.multiply(gain[rows].astype(np.float32), white[rows], out=product[rows])
    return product


def _parted(white: FloatImage, share: npt.NDArray[np.floating], folder: Path) -> tuple[FloatImage, FloatImage]:
    """The direct and the indirect part of a white image, in nameless files of the run's disk where they are large."""
    direct, indirect = (array_in_file(folder, white.shape) for _ in range(2))
    for rows in strips(len(white)):
        np.multiply(share[rows].astype(np.float32), white[rows], out=indirect[rows])
        np.subtract(white[rows], indirect[rows], out=direct[rows])
    return direct, indirect


def read_phase_map(folder: Path, projector: str) -> tuple[PhaseMap | None, npt.NDArray[np.int64] | None]:
    """A projector's phase map and the camera's mosaic; None if the run has none, or its metapixels are from dots."""
    pixels = _phase_pixels(folder, projector)
    return (None, None) if pixels is None else (pixels.phase_map, pixels.known_mosaic)


def _phase_pixels(folder: Path, projector: str) -> Pixels | None:
    """What the sinusoids showed of a projector; None if no phase map is used."""
    if mode_of(folder) == "paper":
        return None
    pixels = Pixels.read(folder, projector)
    return None if pixels.phase_map is None else pixels


def object_mask(parts: Sequence[ProjectorCalibration]) -> Mask:
    """Camera pixels that any projector lights noticeably in every channel."""
    brightest = max(float(np.percentile(part.white, 99.9)) for part in parts)
    masks = [smallest(part.white) > LIT_SHARE * brightest for part in parts]
    lit: Mask = np.logical_or.reduce(masks)
    return lit
