"""Disturbs the stage between two photographs, checks it for drift, and recalibrates it."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from controller.optics.calibrate.geometry.values import CameraPrior
from controller.optics.calibrate.verify.drift import Drift
from controller.run.journal import Journal
from controller.run.runner import Context, Runner, Step
from controller.stage.artefacts.calibrated import Calibrated
from controller.stage.artefacts.drift import read_drift
from controller.stage.artefacts.geometry import read_geometry
from controller.stage.artefacts.grade import graded
from controller.stage.rig.rig import Rig
from controller.stage.steps import costs
from controller.stage.steps.calibrate.dots import dot_steps
from controller.stage.steps.calibrate.drift import drift_steps
from controller.stage.steps.calibrate.full import calibration_steps
from controller.stage.steps.calibrate.grade import verify_step
from controller.stage.steps.calibrate.quick import quick_steps
from controller.stage.steps.modes import DotOptions
from lab.study.subject.photographing import RigPhotographer
from lab.study.subject.subject import BenchChange, Recalibration, Subject

FOLDER = "again"


@dataclass(frozen=True, slots=True)
class RigStageControl:
    """``StageControl`` on opened devices; each calibration is a run of its own inside the experiment's folder."""

    rig: Rig
    context: Context
    calibrated: Calibrated
    experiment: str
    prior: CameraPrior
    longest_exposure_s: float
    change: Callable[[Sequence[BenchChange]], None]
    subject: Callable[[Calibrated, RigPhotographer, Path], Subject]

    def disturb(self, *changes: BenchChange) -> None:
        self.change(changes)

    def drift(self, name: str) -> Drift:
        folder = self._folder(f"{name}-drift")
        self._run(folder, drift_steps(self.rig, self.calibrated, longest_exposure_s=self.longest_exposure_s))
        return read_drift(folder)

    def quickly(self, name: str) -> Recalibration:
        folder = self._folder(f"{name}-quick")
        full = self._full(DotOptions())
        steps = quick_steps(self.rig, folder, self.calibrated, full, longest_exposure_s=self.longest_exposure_s)
        return self._again(folder, steps)

    def again(self, name: str, options: DotOptions | None = None, *, beyond: str | None = None) -> Recalibration:
        folder = self._folder(f"{name}-full", beyond and f"{beyond}-full")
        full = self._full(options or DotOptions())
        scale = costs.scale(projector.size_px for projector in self.rig.projectors)
        calibrated = Calibrated(folder, self.calibrated.projectors)
        return self._again(folder, [*full, verify_step(calibrated, [step.id for step in full], scale)])

    def _full(self, options: DotOptions) -> list[Step]:
        return [
            *calibration_steps(self.rig, self.prior, longest_exposure_s=self.longest_exposure_s),
            *dot_steps(self.rig, options, longest_exposure_s=self.longest_exposure_s),
        ]

    def _folder(self, name: str, start: str | None = None) -> Path:
        """``start``: of which it is a copy when it is new."""
        folder, first = (self.context.folder / FOLDER / f"{self.experiment}-{part}" for part in (name, start or name))
        if not folder.exists() and first.exists():
            copying = folder.with_name(f".{folder.name}.part")
            shutil.rmtree(copying, ignore_errors=True)
            shutil.copytree(first, copying)
            copying.rename(folder)
        folder.mkdir(parents=True, exist_ok=True)
        return folder

    def _again(self, folder: Path, steps: Sequence[Step]) -> Recalibration:
        photographs = self._run(folder, steps)
        calibrated = Calibrated(folder, self.calibrated.projectors)
        light = RigPhotographer(
            self.rig, self.context, calibrated, f"{self.experiment}-{folder.name}", self.longest_exposure_s
        )
        return Recalibration(self.subject(calibrated, light, folder), photographs, graded(folder) or {})

    def _run(self, folder: Path, steps: Sequence[Step]) -> int:
        with Journal(folder) as journal:
            Runner(steps, journal).run(folder.name, deadline=self.context.deadline)
            return journal.shot_count()


def subject_of(size: str, seed: int, context: Context) -> Callable[[Calibrated, RigPhotographer, Path], Subject]:
    """How a calibrated folder becomes a subject of the same experiment."""

    def made(calibrated: Calibrated, light: RigPhotographer, folder: Path) -> Subject:
        return Subject(
            calibration=calibrated.calibration,
            geometry=read_geometry(folder, calibrated.projectors),
            transport=calibrated.transport,
            light=light,
            indirect=calibrated.indirect,
            size=size,
            seed=seed,
            advance=context.advance,
        )

    return made
