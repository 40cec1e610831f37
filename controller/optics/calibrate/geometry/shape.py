"""Which shape of the object a calibration gives: a surface, planes, or none, which most of the work does not need."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final, Literal

from controller.core.errors import CalibrationError
from controller.optics.calibrate.geometry.planes import THICK, THIN, reconstruct_planes
from controller.optics.calibrate.geometry.self_calibration import reconstruct
from controller.optics.calibrate.geometry.values import CameraPrior, Reconstruction
from controller.optics.calibrate.values import Correspondence

AskedShape = Literal["auto", "surface", "plane", "unknown"]
Shape = Literal["surface", "plane", "unknown"]

SURE: Final = 0.01
"""Share of their distance to which points of a plane are to be known."""


@dataclass(frozen=True, slots=True)
class FoundShape:
    """``camera_size``: (width, height) of the camera's picture.

    ``reconstruction``: None where ``shape`` is unknown; ``why``: what spoke against a surface, None if nothing did
    """

    shape: Shape
    camera_size: tuple[int, int]
    reconstruction: Reconstruction | None = None
    why: CalibrationError | None = None


def find_shape(
    asked: AskedShape,
    correspondences: Sequence[Correspondence],
    camera_size: tuple[int, int],
    projector_sizes: Sequence[tuple[int, int]],
    prior: CameraPrior,
    *,
    progress: Callable[[float], None] | None = None,
) -> FoundShape:
    """The shape that is asked for; with "auto" the most that the correspondences give.

    ``correspondences``, ``camera_size``, ``projector_sizes`` and ``prior``: as ``reconstruct``.
    Raises as ``reconstruct``; with "auto" only UsageErrors.
    """
    if asked == "unknown":
        return FoundShape("unknown", camera_size)
    seen = correspondences, camera_size, projector_sizes, prior
    if asked == "plane":
        return FoundShape("plane", camera_size, reconstruct_planes(*seen))
    try:
        return FoundShape("surface", camera_size, reconstruct(*seen, progress=progress))
    except CalibrationError as error:
        if asked == "surface":
            raise
        why = error
    # Two planes fit any gentle curve if they may be thick.
    for planes, thick in ((1, THICK), (2, THIN)):
        with contextlib.suppress(CalibrationError):
            return FoundShape("plane", camera_size, reconstruct_planes(*seen, most=planes, thick=thick), why)
    return FoundShape("unknown", camera_size, why=why)


def shape_sentence(found: FoundShape) -> str:
    """For a technician: the shape, apart from why it is not a surface."""
    known = found.reconstruction
    if known is None:
        return (
            "No shape of the object is measured. Pictures, recolouring, live and refining work without one. "
            "Table and walls that are lit count as the object: draw an outline around it in the panel's Settings."
        )
    if found.shape == "surface":
        return "The object's surface is measured."
    turned = "" if known.shape_rel_sigma < SURE else (
        f" How far it is turned is not certain (distances to {known.shape_rel_sigma:.1%}): four measured sides of it,"
        " [[object.distances]] in stage.toml, say it."
    )  # fmt: skip
    return f"The object is flat, and has the shape of a plane.{turned}"
