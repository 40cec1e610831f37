"""Entering a method of your own in ``velatura compare``.

A method is a function. It gets a stage, measures it with photographs of patterns of its choice, and returns a second
function, which makes the frames of one target::

    def plain(stage: ComparisonStage) -> Callable[[ComparisonTarget], list[np.ndarray]]:
        white = [np.full((height, width, 3), 255, np.uint8) for width, height in stage.projectors_px]
        lit = stage.photograph(white)

        def frames(target: ComparisonTarget) -> list[np.ndarray]:
            ...

        return frames
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

from controller.core.arrays import ByteImage, Float64, FloatImage, Mask
from controller.optics.calibrate.values import Calibration, Geometry
from controller.optics.capture.profile import CameraNoise
from controller.optics.transport import LightTransport
from controller.optics.transport.indirect.indirect_light import IndirectLight


@dataclass(frozen=True, slots=True)
class ComparisonTarget:
    """What the camera is to see, in the stage's unit of light. The arrays are the method's own copies.

    ``name``: of the target
    ``radiance`` (camera rows, columns, 3) float32, linear and finite, not below the light of black frames
    ``white``: radiance of a perfect white at this target's exposure
    ``in_reach`` (camera rows, columns) bool: where Velatura's own calibration says that the projectors can make it
    ``valid`` (camera rows, columns) bool: where the target says something
    """

    name: str
    radiance: FloatImage
    white: float
    in_reach: Mask
    valid: Mask


@dataclass(frozen=True, slots=True)
class ComparisonCalibration:
    """Velatura's own calibration of the stage.

    ``calibration``, ``transport``, ``indirect``: as of ``CalibratedRun``; of the projectors that were asked for
    ``geometry``: poses and points of the surface, of all projectors
    """

    calibration: Calibration
    transport: LightTransport
    indirect: IndirectLight | None
    geometry: Geometry


class ComparisonStage(Protocol):
    """A stage as a method sees it; the truth behind it is not available.

    ``projectors_px``: (width, height) of each projector, in the order of all frames
    ``camera_px``: (width, height) of the camera's picture
    ``object_mask`` (camera rows, columns) bool: where some projector lights the object
    ``camera_to_xyz`` (3, 3) float64: linear camera RGB to CIE XYZ
    ``white``: radiance of a bright spot with all projectors at white; photographs are exposed for it
    ``exposures_s``: the camera's shortest and longest exposure, seconds
    ``noise``: the camera's, as of ``Developed``; None where it was not measured
    ``photographs``: those counted so far, each exposure of a bracket as one
    ``photographs_left``: how many more may be taken
    """

    @property
    def projectors_px(self) -> tuple[tuple[int, int], ...]: ...

    @property
    def camera_px(self) -> tuple[int, int]: ...

    @property
    def object_mask(self) -> Mask: ...

    @property
    def camera_to_xyz(self) -> Float64: ...

    @property
    def white(self) -> float: ...

    @property
    def exposures_s(self) -> tuple[float, float]: ...

    @property
    def noise(self) -> CameraNoise | None: ...

    @property
    def photographs(self) -> int: ...

    @property
    def photographs_left(self) -> int: ...

    def photograph(self, frames: Sequence[ByteImage], *, white: float | None = None) -> FloatImage:
        """Show one frame on each projector, all at once, and photograph them.

        ``frames``: (rows, columns, 3) uint8 device values, one a projector; ``white``: radiance that is about the
        brightest, by which two exposures are chosen; without it the stage's. Returns (camera rows, columns, 3) float32
        linear radiance, finite: what is too bright for the shorter exposure has that one's full scale.

        Errors: ``benchmark-frames-wrong``, ``benchmark-white-wrong``, ``benchmark-photographs-spent``.
        """

    def calibrated(self, which: Sequence[int] | None = None) -> ComparisonCalibration:
        """Velatura's own calibration of all projectors, or of ``which``, in that order.

        Its photographs of these projectors are counted, once. They may bring the count above the limit.

        Errors: ``projector-unknown``.
        """


MakeFrames = Callable[[ComparisonTarget], Sequence[ByteImage]]
ComparisonMethod = Callable[[ComparisonStage], MakeFrames]
