"""From captures to a calibration, step by step or at once; and reading the folder of a Velatura run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path

import numpy as np
import numpy.typing as npt

from controller.api.captures import CaptureSet
from controller.core.arrays import FloatImage, as_light
from controller.core.errors import CalibrationError, UsageError
from controller.optics.calibrate.correspondence import decode as correspondence_decode
from controller.optics.calibrate.correspondence.captures import check_still, inconsistent
from controller.optics.calibrate.correspondence.colour_alignment import ColourPlaces, colour_shifts, colours_apart
from controller.optics.calibrate.metapixels.from_phase import FittedPixels, fit_pixels
from controller.optics.calibrate.photometry.colour_tiles import tile_code
from controller.optics.calibrate.photometry.radiometry import (
    SinusoidLight,
    TilePhotographs,
    measure_radiometry,
    tell_direct_light,
)
from controller.optics.calibrate.photometry.separation import sinusoid_contrast
from controller.optics.calibrate.photometry.waveform import coarse_waves
from controller.optics.calibrate.values import Calibration, Correspondence, Geometry, ProjectorCalibration, Radiometry
from controller.optics.capture.patterns import PatternPlan, plan_patterns
from controller.optics.capture.profile import CameraProfile, load_profile
from controller.optics.capture.raw import CAMERA_BLUR_PX, SRGB_TO_XYZ
from controller.optics.transport import LightTransport
from controller.optics.transport.indirect.indirect_light import IndirectLight
from controller.optics.transport.indirect.stripes import dark_light
from controller.stage.artefacts.calibrated import Calibrated
from controller.stage.artefacts.calibration import object_mask, projectors_of
from controller.stage.artefacts.geometry import read_geometry
from controller.stage.artefacts.grade import graded
from controller.stage.artefacts.solved import Solved, read_solved


def decode(captures: CaptureSet) -> Correspondence:
    """The position in the projector's picture that each camera pixel sees, from Gray code and phase shift.

    The Gray code gives the period of the 24-pixel sinusoid, the phase of that sinusoid gives the period of the fine
    sinusoids, and their phase gives the position. Positions are fitted by planes over neighbours on one surface.

    Parameters
    ----------
    captures : needs ``black``, ``gray-*``, ``phase-*`` and ``blur-*``

    Returns
    -------
    ``Correspondence``: ``projector_px`` (camera rows, columns, 2) float32, x and y in projector pixels, NaN where not
    valid; ``modulation`` (rows, columns) float32, contrast of the sinusoids, 0 to 1; ``valid`` (rows, columns) bool

    Errors: ``capture-missing``, ``capture-shape-wrong``, ``captures-inconsistent`` (photographs in the wrong order,
    a camera that moved, exchanged colours), ``projector-size-wrong``.
    """
    return _decoded(captures, None)


def _plan(captures: CaptureSet) -> PatternPlan:
    plan = plan_patterns(captures.projector_px)
    own = {pattern.name for axis in range(2) for pattern in plan.gray(axis)}
    other = sorted(name for name in captures.pictures if name.startswith("gray-") and name not in own)
    if other:
        width, height = captures.projector_px
        raise CalibrationError(
            "projector-size-wrong",
            what=f"A projector of {width}x{height} has no pattern {other[0]}, and there is a photograph of it.",
            remedy="Correct the projector's size: width first, then height, as its own picture has them.",
        )
    return plan


def _decoded(captures: CaptureSet, colours: ColourPlaces | None) -> Correspondence:
    plan = _plan(captures)
    _check_same_camera(captures, [pattern.name for pattern in plan.sinusoids("phase-x")])
    blur_px = float(np.mean(np.square(CAMERA_BLUR_PX)) ** 0.5) if captures.from_bayer else 0.0
    return correspondence_decode.decode(captures.pictures, plan, camera_blur_px=blur_px, colours=colours)


def _check_same_camera(captures: CaptureSet, steps: list[str]) -> None:
    """The steps of a sinusoid add up to white and black: the same place, and the same order of colours."""
    pictures = captures.pictures
    if not {"black", "white", *steps} <= set(pictures):
        return
    ends = np.asarray(pictures["black"] + pictures["white"], np.float32)
    mean = np.asarray(sum(pictures[step] for step in steps), np.float32)
    if ends.shape != mean.shape or not np.nanmean(ends) > 0 or not np.nanmean(mean) > 0:
        return
    if ends.ndim == 3:
        colours, later = (np.nanmean(one, axis=(0, 1)) / np.nanmean(one) for one in (ends, mean))
        off, exchanged = np.abs(later - colours).max(), np.abs(later[::-1] - colours).max()
        if off > EXCHANGED and exchanged < off / 4:
            raise inconsistent(
                "red and blue of the sinusoids are exchanged against those of black and white",
                "Read all photographs in one way: OpenCV's imread gives blue first.",
            )
        ends, mean = ends.sum(axis=2), mean.sum(axis=2)
    check_still(ends, mean, "white and the sinusoids")


EXCHANGED = 0.04
"""Of the mean of a photograph's colours."""


def measure_response(captures: CaptureSet) -> Radiometry:
    """The projector's light for each device value, from pictures of coloured tiles.

    Parameters
    ----------
    captures : (rows, columns, 3) pictures; needs ``black``, ``white``, ``gray-*`` and ``mosaic-*``

    Returns
    -------
    ``Radiometry``: ``response`` (3, 256) float64, light of each device value per channel, rising from 0 to 1;
    ``mixing`` (3, 3) float64, camera channel by projector channel, each row adds up to 1

    Errors: ``capture-missing``, ``capture-shape-wrong``, ``projector-dark``, ``captures-overexposed``,
    ``projector-size-wrong``, ``colours-do-not-add``, ``colours-alike``.
    """
    return measure_radiometry(captures.pictures, _plan(captures))[0]


def fit_metapixels(captures: CaptureSet, correspondence: Correspondence) -> FittedPixels:
    """Position and shape of each projector pixel's light in the camera picture (metapixels, paper 4.2.2, eq. 8).

    Parameters
    ----------
    captures : needs ``black``, ``phase-*`` and ``blur-*``
    correspondence : from ``decode``, of the same captures

    Returns
    -------
    ``FittedPixels``: ``metapixels`` with ``centre_px`` (projector rows, columns, 2) float32, camera x and y;
    ``covariance_px2`` (projector rows, columns, 3) float32, xx, xy, yy in camera pixels squared; ``valid`` bool; NaN
    where not valid. ``phase_map``: the same measurement for each camera pixel. ``mosaic``: the camera's Bayer pattern

    Errors: ``capture-missing``, ``capture-shape-wrong``.
    """
    return fit_pixels(captures.pictures, plan_patterns(captures.projector_px), correspondence)


def calibrate(captures: Mapping[str, CaptureSet], *, indirect: bool = False) -> Calibration:
    """Calibrate several projectors from their captures: response, correspondence and metapixels of each.

    The same steps as ``velatura calibrate`` in its fast mode, those for colours that lie apart included. Geometry
    (poses and points) is not part of it.

    Parameters
    ----------
    captures : by projector name; (rows, columns, 3) pictures of one camera position, all in one unit. Needs all
        patterns but ``random-*``. The black picture of the first projector counts for all
    indirect : tell direct from indirect light, by the contrast of the sinusoids (Nayar et al. 2006), and measure the
        response in direct light. They must have been drawn with the response that ``measure_response`` gives

    Returns
    -------
    ``Calibration``: ``projectors`` in the order given, each with ``name``, ``metapixels``, ``radiometry``, ``white``
    (camera rows, columns, 3) float32 and ``phase_map``; with ``indirect`` the white is the direct light, and
    ``indirect`` of the same shape the rest of it; ``black`` (camera rows, columns, 3) float32; ``object_mask``
    (camera rows, columns) bool; ``camera_to_xyz`` (3, 3), of sRGB where the pictures do not say it

    Errors: those of ``measure_response``, ``decode`` and ``fit_metapixels``; ``projector-reaches-nothing``,
    ``captures-missing``.
    """
    if not captures:
        raise UsageError("captures-missing", what="No captures were given.", remedy="Give at least one CaptureSet.")
    parts, mosaics = [], []
    for name, one in captures.items():
        part, mosaic = _calibrated(name, one, indirect=indirect)
        parts.append(part)
        mosaics.append(mosaic)
    first = next(iter(captures.values()))
    red, green, blue = CAMERA_BLUR_PX if first.from_bayer else (0.0, 0.0, 0.0)
    to_xyz = SRGB_TO_XYZ if first.camera_to_xyz is None else first.camera_to_xyz
    black = np.nan_to_num(first.pictures["black"])
    return Calibration(tuple(parts), black, object_mask(parts), to_xyz, (red, green, blue), mosaics[-1])


def _calibrated(
    name: str, captures: CaptureSet, *, indirect: bool
) -> tuple[ProjectorCalibration, npt.NDArray[np.int64] | None]:
    radiometry, plan = measure_response(captures), plan_patterns(captures.projector_px)
    white = np.maximum(captures.pictures["white"] - captures.pictures["black"], 0).astype(np.float32)
    apart_px = colour_shifts(colours_apart(captures.pictures, plan, white, radiometry.mixing)).sure_px
    colours = None if apart_px is None else ColourPlaces.of(apart_px, white, radiometry.mixing)
    correspondence = _decoded(captures, colours)
    if not correspondence.valid.any():
        raise CalibrationError(
            "projector-reaches-nothing",
            what=f"No pixel of projector {name} was found on the object.",
            remedy="Check that it points at the object, is in focus and not blocked, and that the room is dark.",
        )
    fitted = fit_pixels(captures.pictures, plan, correspondence, colours, white)
    white = np.nan_to_num(white, copy=False)
    plain = ProjectorCalibration(
        name, fitted.metapixels, radiometry, white, fitted.phase_map, spread=fitted.spread
    )  # fmt: skip
    if not indirect:
        return plain, fitted.mosaic
    seen = sinusoid_contrast(captures.pictures, plan, white)
    waves = coarse_waves(captures.pictures, plan, white, fitted.phase_map, correspondence.valid, radiometry.response)
    black = captures.pictures["black"]
    code = tile_code(captures.pictures, plan, black, captures.pictures["white"] - black)
    white = np.nan_to_num(seen.white)
    share, radiometry, _ = tell_direct_light(
        TilePhotographs(captures.pictures, plan, code),
        SinusoidLight(seen, waves, correspondence.projector_px, fitted.spread),
        white,
        radiometry,
    )
    thrown = share * white
    stripes = dark_light(captures.pictures, plan, fitted.phase_map.projector_px)
    part = replace(plain, radiometry=radiometry, white=white - thrown, indirect=thrown, stripes=stripes)
    return part, fitted.mosaic


class CalibratedRun:
    """The folder of a calibration run; each part is read at its first use, and kept.

    ``folder``: the run's; ``projectors``: their names
    """

    def __init__(self, folder: Path, projectors: Sequence[str]) -> None:
        self.folder = folder
        self.projectors = tuple(projectors)
        self._calibrated = Calibrated(folder, self.projectors)

    @property
    def calibration(self) -> Calibration:
        """Metapixels, response and white image of each projector, and the black image."""
        return self._calibrated.calibration

    @property
    def transport(self) -> LightTransport:
        """The light transport."""
        return self._calibrated.transport

    @property
    def indirect(self) -> IndirectLight | None:
        """The light by way of other surfaces without table and walls (these: ``predicted``); None if none counts."""
        return self._calibrated.indirect

    def predicted(self, frames: Sequence[npt.ArrayLike]) -> FloatImage:
        """What the camera sees of linear ``frames``, (rows, columns, 3) each, 0 to 1, one a projector.

        (camera rows, columns, 3) float32, as for the grade: the black image, direct light, and what object and room
        throw back.
        """
        light = self.calibration.black.astype(np.float32)
        for n, frame in enumerate(frames):
            shown = as_light(frame)
            back = self._calibrated.indirect_of(n, shown)
            light += self.transport.forward_part(n, shown)
            light += 0 if back is None else back
        return light

    def appearance(self, name: str) -> Solved:
        """A solved appearance of the run, with its present frames: refined ones, where there are.

        Errors: ``appearance-not-solved``.
        """
        return read_solved(self.folder, name, self.projectors)

    @cached_property
    def geometry(self) -> Geometry:
        """Poses and surface: ``points_m`` (camera rows, columns, 3) float32, metres in the camera's frame.

        Errors: ``shape-unknown``.
        """
        return read_geometry(self.folder, self.projectors)

    @cached_property
    def camera(self) -> CameraProfile | None:
        """The run's measurements of its camera; None if there are none."""
        return load_profile(self.folder)

    @cached_property
    def grade(self) -> dict[str, float]:
        """Error of the prediction by projector name, per cent of the light; empty if the run was not graded."""
        return graded(self.folder) or {}


def read_run(folder: Path | str, projectors: Sequence[str] | None = None) -> CalibratedRun:
    """Open the folder of a finished calibration, ``STAGE/runs/...``.

    Parameters
    ----------
    folder : the run's
    projectors : names of those to use, in this order; without it all of the run

    Returns
    -------
    ``CalibratedRun`` with ``calibration``, ``transport``, ``geometry``, ``camera`` and ``grade``; ``predicted(frames)``
    and ``appearance(name)``

    Errors: ``not-calibrated``, ``projector-unknown``; ``array-file-unreadable`` when a part is damaged.
    """
    folder = Path(folder)
    try:
        found = projectors_of(folder)
    except (OSError, ValueError, KeyError) as error:
        raise UsageError(
            "not-calibrated",
            what=f"{folder} has no finished calibration.",
            remedy="Give the folder of a finished calibration: STAGE/runs/...",
        ) from error
    unknown = next((name for name in projectors or () if name not in found), None)
    if unknown is not None:
        raise UsageError(
            "projector-unknown", what=f"The run has no projector {unknown}.", remedy=f"Choose from {', '.join(found)}."
        )
    return CalibratedRun(folder, found if projectors is None else projectors)
