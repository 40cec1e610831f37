"""One appearance, solved and photographed, by which experiments judge a calibration."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from controller.core.arrays import FloatImage
from controller.optics.solve.appearance import Base, StageLight
from controller.optics.solve.bounded.equations import SolveSettings, appearance_weights
from controller.optics.solve.bounded.solver import solve_bounded
from controller.optics.solve.scaling.dither import to_light
from controller.optics.solve.scaling.interactive import Interactive
from controller.optics.solve.scaling.stage_maps import scaling_maps
from controller.optics.solve.targets.files import shipped_photograph
from controller.optics.solve.targets.values import Target, through_camera
from controller.optics.solve.targets.wrap import wrap_photograph
from lab.study.subject.measuring import Quality, quality
from lab.study.subject.subject import ReachableTarget, Subject


@dataclass(frozen=True, slots=True)
class Trial:
    """An appearance as it was asked for, its linear ``frames``, and how its photograph compares."""

    wanted: ReachableTarget
    frames: Sequence[FloatImage]
    photograph: FloatImage
    quality: Quality


def photograph_target(subject: Subject) -> Target:
    """The shipped photograph wrapped on the reconstructed object, as the camera can see it."""
    return through_camera(wrap_photograph(shipped_photograph(), subject.geometry, subject.mask))


def live_frames(subject: Subject, base: Base, radiance: FloatImage) -> Sequence[FloatImage]:
    """What ``velatura live`` shows of ``radiance`` (rows, columns, 3): base times scale by narrower means, 8 bits."""
    radiometries = [part.radiometry for part in subject.calibration.projectors]
    maps = scaling_maps(StageLight(subject.transport, subject.calibration.black, subject.indirect), base, radiometries)
    frames = Interactive(maps, subject.transport.camera_shape).frames(radiance)
    return [to_light(frame, radiometry) for frame, radiometry in zip(frames, radiometries, strict=True)]


def run_trial(subject: Subject, name: str) -> Trial:
    """A photograph wrapped on the reconstructed object, at an exposure that 95 % of it can reach."""
    wanted = subject.wanted(photograph_target(subject))
    weights = appearance_weights(wanted.radiance, wanted.mask, wanted.white)
    black = subject.calibration.black
    solution = solve_bounded(subject.transport, wanted.direct, black, SolveSettings(weights=weights))
    return photograph_frames(subject, name, wanted, solution.frames)


def photograph_frames(subject: Subject, name: str, wanted: ReachableTarget, frames: Sequence[FloatImage]) -> Trial:
    """Photograph ``frames`` in the state in which the stage is now, and compare with what is wanted."""
    picture = subject.light.photograph(name, frames, white=wanted.white)
    return Trial(wanted, frames, picture, quality(subject, picture, wanted))
