"""A method's stage in arrays: photographs by the calibration's own transport, in device steps, with noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from controller.core.arrays import ByteImage, FloatImage
from lab.compare.metered_stage import CameraFacts, Effort, MeteredStage
from lab.study.subject.subject import Subject
from tests.lab.study.array_stage import NOISE

EXPOSURES = 2


@dataclass
class ArrayShower:
    """``counted.Shower``; ``names`` of what was photographed."""

    subject: Subject
    rng: np.random.Generator = field(default_factory=lambda: np.random.default_rng(7))
    names: list[str] = field(default_factory=list)

    def photograph(self, name: str, frames: Sequence[ByteImage], *, white: float) -> tuple[FloatImage, int]:
        assert name not in self.names
        self.names.append(name)
        linear = [np.asarray(frame / np.float32(255), np.float32) for frame in frames]
        light = self.subject.transport.forward(linear) + self.subject.calibration.black
        return np.asarray(light + self.rng.normal(0, NOISE, light.shape), np.float32), EXPOSURES


def counted(subject: Subject, shower: ArrayShower, most: int = 100) -> MeteredStage:
    effort = Effort(shared=5, projectors=[10, 20, 30], dots=[100, 200, 300])
    return MeteredStage(subject, shower, CameraFacts((0.001, 1.0)), effort, "own", most=most)
