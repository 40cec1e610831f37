"""The stage as a method sees it: every photograph is checked, counted and limited."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, Protocol

import numpy as np

from controller.core.arrays import ByteImage, Float64, FloatImage, Mask
from controller.core.errors import UsageError, WorkError
from controller.optics.capture.profile import CameraNoise
from controller.optics.transport import build_transport
from lab.compare.api import ComparisonCalibration
from lab.study.subject.subject import Dots, Subject

MOST_PHOTOGRAPHS: Final = 3000
"""Of one method on one scene."""
BRIGHT_SHARE: Final = 99.5
"""Percentile of the object's pixels with all projectors at white: brighter ones are highlights."""


class Shower(Protocol):
    """Shows 8-bit frames and photographs them."""

    def photograph(self, name: str, frames: Sequence[ByteImage], *, white: float) -> tuple[FloatImage, int]:
        """(rows, columns, 3) float32 radiance, finite, and how many exposures it took; ``name``: unique here."""


@dataclass(frozen=True, slots=True)
class CameraFacts:
    """``exposures_s``: shortest and longest, seconds; ``noise`` as measured."""

    exposures_s: tuple[float, float]
    noise: CameraNoise | None = None


@dataclass(frozen=True, slots=True)
class Effort:
    """Photographs of Velatura's own calibration, for methods that use it.

    ``shared``: of no projector alone; ``projectors``, ``dots``: of each projector
    """

    shared: int
    projectors: Sequence[int]
    dots: Sequence[int]


@dataclass
class MeteredStage:
    """``api.ComparisonStage`` of one method on one calibrated stage.

    ``name``: of the method, for its photographs' names; ``check``: called before each photograph, where a stop takes
    hold; ``dots``: for the methods of this package alone
    """

    subject: Subject
    shower: Shower
    camera: CameraFacts
    effort: Effort
    name: str
    check: Callable[[], None] = lambda: None
    most: int = MOST_PHOTOGRAPHS
    photographs: int = 0
    _taken: int = 0
    _counted: set[object] = field(default_factory=set)

    @property
    def projectors_px(self) -> tuple[tuple[int, int], ...]:
        shapes = [part.metapixels.valid.shape for part in self.subject.calibration.projectors]
        return tuple((shape[1], shape[0]) for shape in shapes)

    @property
    def camera_px(self) -> tuple[int, int]:
        rows, columns = self.subject.mask.shape
        return columns, rows

    @property
    def object_mask(self) -> Mask:
        return self.subject.mask.copy()

    @property
    def camera_to_xyz(self) -> Float64:
        return self.subject.calibration.camera_to_xyz.copy()

    @property
    def white(self) -> float:
        return brightest(self.subject)

    @property
    def exposures_s(self) -> tuple[float, float]:
        return self.camera.exposures_s

    @property
    def noise(self) -> CameraNoise | None:
        return self.camera.noise

    @property
    def photographs_left(self) -> int:
        return max(0, self.most - self.photographs)

    def photograph(self, frames: Sequence[ByteImage], *, white: float | None = None) -> FloatImage:
        self.check()
        shown = checked_frames(frames, self.projectors_px)
        white = self.white if white is None else white
        if not (np.isfinite(white) and white > 0):
            raise UsageError(
                "benchmark-white-wrong",
                what=f"A photograph can't be exposed for the radiance {white}.",
                remedy="Give a number above 0, or leave it out.",
            )
        if not self.photographs_left:
            raise WorkError(
                "benchmark-photographs-spent",
                what=f"The method has taken its {self.most} photographs of this stage.",
                remedy="Measure the stage with fewer patterns.",
            )
        picture, taken = self.shower.photograph(f"{self.name}-{self._taken}", shown, white=white)
        self._taken += 1
        self.photographs += taken
        return picture

    def calibrated(self, which: Sequence[int] | None = None) -> ComparisonCalibration:
        subject, count = self.subject, len(self.subject.calibration.projectors)
        order = list(range(count)) if which is None else [int(n) for n in which]
        if unknown := [n for n in order if not 0 <= n < count]:
            raise UsageError(
                "projector-unknown",
                what=f"Projector number {unknown[0] + 1} does not exist.",
                remedy=f"Choose from 1 to {count}.",
            )
        self._count("shared", self.effort.shared)
        for n in order:
            self._count(("projector", n), self.effort.projectors[n])
        calibration, transport = subject.calibration, subject.transport
        if order != list(range(count)):
            calibration = subject.with_projectors(order)
            transport = build_transport(calibration)
        return ComparisonCalibration(calibration, transport, subject.indirect, subject.geometry)

    def dots(self, n: int, *, plain: bool = False) -> Dots:
        """Projector ``n`` as dots show it; their photographs are counted, once."""
        self._count(("dots", n), self.effort.dots[n])
        return self.subject.light.dots(n, plain=plain)

    def _count(self, what: object, photographs: int) -> None:
        if what not in self._counted:
            self._counted.add(what)
            self.photographs += photographs


def brightest(subject: Subject) -> float:
    """Radiance of a bright spot of the object with all projectors at white."""
    parts = [part.white if part.indirect is None else part.white + part.indirect
             for part in subject.calibration.projectors]  # fmt: skip
    whole = subject.calibration.black + np.sum(parts, axis=0)
    return float(np.percentile(whole[subject.mask].max(axis=-1), BRIGHT_SHARE))


def checked_frames(frames: Any, sizes: Sequence[tuple[int, int]]) -> list[ByteImage]:
    """Copies of one 8-bit frame for each projector of ``sizes`` (width, height).

    Raises UsageError("benchmark-frames-wrong").
    """
    if not isinstance(frames, Sequence | np.ndarray) or isinstance(frames, str | bytes) or len(frames) != len(sizes):
        raise _wrong(f"they are not one frame for each of the {len(sizes)} projectors")
    for n, (frame, (width, height)) in enumerate(zip(frames, sizes, strict=True)):
        if not isinstance(frame, np.ndarray) or frame.dtype != np.uint8:
            kind = frame.dtype if isinstance(frame, np.ndarray) else type(frame).__name__
            raise _wrong(f"frame {n + 1} is {kind} instead of an array of 8-bit values (uint8)")
        if frame.shape != (height, width, 3):
            raise _wrong(f"frame {n + 1} is {frame.shape} instead of {(height, width, 3)}")
    return [np.array(frame, np.uint8, order="C") for frame in frames]


def _wrong(why: str) -> UsageError:
    return UsageError(
        "benchmark-frames-wrong",
        what=f"The method's frames can't be shown: {why}.",
        remedy="Return one (rows, columns, 3) uint8 array for each projector.",
    )


def calibration_effort(
    counts: Mapping[tuple[str, str], int], projectors: Sequence[str], *, own: Sequence[str], dots: str
) -> Effort:
    """From a run's photographs by kind and projector; ``own``: kinds that are not of the calibration, ``dots`` too."""
    kept = {key: count for key, count in counts.items() if key[0] not in (*own, dots)}
    by = {name: sum(count for key, count in kept.items() if key[1] == name) for name in projectors}
    return Effort(
        shared=sum(kept.values()) - sum(by.values()),
        projectors=[by[name] for name in projectors],
        dots=[counts.get((dots, name), 0) for name in projectors],
    )
