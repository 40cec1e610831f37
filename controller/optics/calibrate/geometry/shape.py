"""Which shape of the object a calibration gives: a surface, planes, or none, which most of the work does not need."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

from controller.core.errors import CalibrationError
from controller.optics.calibrate.geometry.self_calibration import reconstruct
from controller.optics.calibrate.geometry.values import CameraPrior, Reconstruction
from controller.optics.calibrate.values import Correspondence

AskedShape = Literal["auto", "surface", "plane", "unknown"]
Shape = Literal["surface", "plane", "unknown"]


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
    try:
        found = reconstruct(correspondences, camera_size, projector_sizes, prior, progress=progress)
        return FoundShape("surface", camera_size, found)
    except CalibrationError as error:
        if asked == "surface":
            raise
        return FoundShape("unknown", camera_size, why=error)
