"""Who bumps the stage between two photographs, looks what has changed, and calibrates it again."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from controller.calibrate.drift import Drift
from controller.calibrate.reconstruction import CameraPrior
from controller.session import costs
from controller.session.calibrating import calibration_steps, read_geometry
from controller.session.dotting import dot_steps
from controller.session.drifting import drift_steps, read_drift
from controller.session.grading import graded, verify_step
from controller.session.journal import Journal
from controller.session.modes import DotOptions
from controller.session.quick import quick_steps
from controller.session.rig import Rig
from controller.session.runner import Context, Runner, Step
from controller.session.solving import Calibrated
from controller.study.photographing import RigLight
from controller.study.subject import Subject

FOLDER = "again"
Change = Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class Again:
    """A stage that was calibrated again. ``photographs`` it took; ``error_percent``: of each projector's grade."""

    subject: Subject
    photographs: int
    error_percent: Mapping[str, float]

    @property
    def worst_percent(self) -> float:
        return max(self.error_percent.values(), default=float("nan"))


class Stagehand(Protocol):
    """What an experiment may ask for besides photographs. ``name``: unique in its experiment."""

    def disturb(self, *changes: Change) -> None:
        """Change the stage as a bench explains it (``hal.interfaces.Bench.disturb``); none: as it was set up."""

    def drift(self, name: str) -> Drift:
        """Look what has changed since the stage was calibrated."""

    def quickly(self, name: str) -> Again:
        """Bring the calibration up to date, repeating only what has changed."""

    def again(self, name: str, options: DotOptions | None = None) -> Again:
        """Calibrate from nothing."""


@dataclass(frozen=True, slots=True)
class RigHand:
    """``Stagehand`` on opened devices; each calibration is a run of its own inside the experiment's folder."""

    rig: Rig
    context: Context
    calibrated: Calibrated
    experiment: str
    prior: CameraPrior
    longest_exposure_s: float
    change: Callable[[Sequence[Change]], None]
    subject: Callable[[Calibrated, RigLight, Path], Subject]

    def disturb(self, *changes: Change) -> None:
        self.change(changes)

    def drift(self, name: str) -> Drift:
        folder = self._folder(f"{name}-drift")
        self._run(folder, drift_steps(self.rig, self.calibrated, longest_exposure_s=self.longest_exposure_s))
        return read_drift(folder)

    def quickly(self, name: str) -> Again:
        folder = self._folder(f"{name}-quick")
        full = self._full(DotOptions())
        steps = quick_steps(self.rig, folder, self.calibrated, full, longest_exposure_s=self.longest_exposure_s)
        return self._again(folder, steps)

    def again(self, name: str, options: DotOptions | None = None) -> Again:
        folder = self._folder(f"{name}-full")
        full = self._full(options or DotOptions())
        scale = costs.scale(projector.size_px for projector in self.rig.projectors)
        calibrated = Calibrated(folder, self.calibrated.projectors)
        return self._again(folder, [*full, verify_step(calibrated, [step.name for step in full], scale)])

    def _full(self, options: DotOptions) -> list[Step]:
        return [
            *calibration_steps(self.rig, self.prior, longest_exposure_s=self.longest_exposure_s),
            *dot_steps(self.rig, options, longest_exposure_s=self.longest_exposure_s),
        ]

    def _folder(self, name: str) -> Path:
        folder = self.context.folder / FOLDER / f"{self.experiment}-{name}"
        folder.mkdir(parents=True, exist_ok=True)
        return folder

    def _again(self, folder: Path, steps: Sequence[Step]) -> Again:
        photographs = self._run(folder, steps)
        calibrated = Calibrated(folder, self.calibrated.projectors)
        light = RigLight(
            self.rig, self.context, calibrated, f"{self.experiment}-{folder.name}", self.longest_exposure_s
        )
        return Again(self.subject(calibrated, light, folder), photographs, graded(folder) or {})

    def _run(self, folder: Path, steps: Sequence[Step]) -> int:
        with Journal(folder) as journal:
            Runner(steps, journal).run(folder.name, deadline=self.context.deadline)
            return journal.shot_count()


def subject_of(size: str, seed: int, context: Context) -> Callable[[Calibrated, RigLight, Path], Subject]:
    """How a calibrated folder becomes a subject of the same experiment."""

    def made(calibrated: Calibrated, light: RigLight, folder: Path) -> Subject:
        return Subject(
            calibration=calibrated.calibration,
            geometry=read_geometry(folder),
            transport=calibrated.transport,
            light=light,
            size=size,
            seed=seed,
            advance=context.advance,
        )

    return made
