"""`velatura compare`: methods on fixed emulated scenes, judged by photographs. Finished work is not repeated."""

from __future__ import annotations

import json
import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from pathlib import Path
from typing import Any, Final

from controller.core.arrays import ByteImage, FloatImage
from controller.core.storage import sha256_of, write_atomically
from controller.optics.capture.profile import load_profile
from controller.run.progress import Reporter
from controller.run.runner import Context, Step
from controller.run.step_id import StepId
from controller.stage.artefacts.calibrated import Calibrated
from controller.stage.artefacts.kinds import StepKind
from controller.stage.rig.rig import Rig
from controller.stage.sessions.bench import BenchProcess
from controller.stage.sessions.check import Checked
from lab.compare import evaluation, leaderboard, metered_stage, scenes
from lab.compare.entries import Entry, entries
from lab.compare.evaluation import evaluate, fixed_targets
from lab.compare.metered_stage import CameraFacts, MeteredStage, calibration_effort
from lab.compare.planar import flat_part
from lab.compare.scenes import SCENES, chosen_scenes
from lab.study.service import check_size, opened, prepare_scene, run_on_bench
from lab.study.subject.disturbance import subject_of
from lab.study.subject.photographing import RigPhotographer
from lab.study.subject.scenes import Scene
from lab.study.subject.subject import ReachableTarget, Subject

KIND: Final = "compare"
"""Of the steps, and the folder in a run with their results."""
SHOTS: Final = "study"
"""The kind of photographs that experiments and methods take (``RigPhotographer``)."""


def compare(
    *,
    methods: Sequence[str],
    scene_names: Sequence[str],
    size: str,
    out: Path,
    seeds: Sequence[int],
    reporter: Reporter,
    cancel: threading.Event,
) -> Mapping[str, Any]:
    """Let methods take part in each scene and seed, continuing what is in ``out``; the paths of the page and JSON file.

    Raises UsageError("method-unknown", "method-unreadable", "method-twice", "scene-unknown", "size-unknown",
    "study-folder-taken", "benchmark-unreadable"), and what the devices and the calibration raise; the lamps are safe by
    then. What a method raises stands in the results.
    """
    entered, chosen = entries(methods), chosen_scenes(scene_names)
    check_size(size)
    out = out.resolve()
    page = out / leaderboard.PAGE
    for seed in dict.fromkeys(seeds):
        for scene in chosen:
            reporter.say(f"On {scene.title}, seed {seed}: {', '.join(entry.name for entry in entered)}.")
            rows = _on_scene(scene, entered, out, (size, seed), reporter, cancel)
            # After each scene, so that a failing one does not cost the results of the previous ones.
            content = leaderboard.update_leaderboard(out, size, rows)
            leaderboard.strips(out, content["results"], partial(_pictures, out))
            page = leaderboard.write_page(out, content, _about(content, entered), _titles())
    return {"page": str(page), "results": str(out / leaderboard.RESULTS)}


def _titles() -> dict[str, str]:
    return {scene.name: scene.title for scene in SCENES.values()}


def _about(content: Mapping[str, Any], entered: Sequence[Entry]) -> dict[str, str]:
    said = {str(row["method"]): str(row["about"]) for row in content["results"]}
    return {**said, **{entry.name: entry.about for entry in entered}}


def _pictures(out: Path, scene: str, seed: int) -> Path:
    """The folder in which a stage's pictures are."""
    stage = _stage_folder(out, scene, seed) / "stage"
    runs = sorted((stage / "runs").glob(f"*/{KIND}"))
    return runs[-1] if runs else stage


def _stage_folder(out: Path, scene: str, seed: int) -> Path:
    return out / f"seed-{seed}" / "scenes" / scene


def _on_scene(
    scene: Scene, entered: Sequence[Entry], out: Path, what: tuple[str, int], reporter: Reporter,
    cancel: threading.Event,
) -> list[Mapping[str, Any]]:  # fmt: skip
    size, seed = what
    steps = partial(_steps, entered=entered, size=size, conditions={"scene": scene.name, "seed": seed})
    stage = prepare_scene(_stage_folder(out, scene.name, seed), scene, size=size, seed=seed)
    run = run_on_bench(stage, steps, name=KIND, reporter=reporter, cancel=cancel)
    return [json.loads((run / KIND / f"{entry.name}.json").read_bytes()) for entry in entered]


def _steps(
    rig: Rig, run: Path, checked: Checked, _: BenchProcess, *, entered: Sequence[Entry], size: str,
    conditions: Mapping[str, Any],
) -> Sequence[Step]:  # fmt: skip
    """Calibrate, photograph dots where a method needs them, let each method take part; skip what is done."""
    stage = opened(rig, run, checked, dots=any(entry.dots for entry in entered))
    arena = _Arena(rig, stage.calibrated, stage.longest_s, size, conditions)
    return [
        *stage.calibrating,
        *(
            Step(
                StepId(KIND, item=entry.name),
                partial(arena.take_part, entry),
                inputs={"method": entry.code_sha256(), "judge": _evaluation_sha256()},
                after=(*stage.after, *(stage.dots if entry.dots else ())),
                title=f"Method {entry.name}",
                weight=entry.cost_s * stage.scale,
            )
            for entry in entered
        ),
    ]


def _evaluation_sha256() -> str:
    """Of the files that define targets, scenes and scores."""
    return " ".join(sha256_of(Path(str(module.__file__))) for module in (metered_stage, evaluation, scenes))


@dataclass
class _Arena:
    """One scene, opened; its targets are made once."""

    rig: Rig
    calibrated: Calibrated
    longest_s: float
    size: str
    conditions: Mapping[str, Any]
    _targets: dict[str, ReachableTarget] = field(default_factory=dict)

    @cached_property
    def camera(self) -> CameraFacts:
        exposures = [value for value in self.rig.acquirer.exposures_s() if value <= self.longest_s]
        profile = load_profile(self.calibrated.folder)
        return CameraFacts((min(exposures), max(exposures)), None if profile is None else profile.noise)

    def take_part(self, entry: Entry, context: Context) -> Sequence[Path]:
        names = self.calibrated.projectors
        effort = calibration_effort(context.journal.shot_counts(), names, own=(SHOTS,), dots=StepKind.STUDY_DOTS)
        light = RigPhotographer(self.rig, context, self.calibrated, entry.name, self.longest_s)
        subject = subject_of(self.size, int(self.conditions["seed"]), context)(self.calibrated, light, context.folder)
        shower = _RigShower(light, names)
        stage = MeteredStage(subject, shower, self.camera, effort, "own", check=context.check)
        targets = self._made(subject)
        context.advance(0.1, f"{entry.name} measures")
        result = evaluate(entry, stage, targets, shower)
        folder = context.folder / KIND
        folder.mkdir(exist_ok=True)
        content = {**self.conditions, "method": entry.name, "about": entry.about, **leaderboard.as_content(result)}
        path = folder / f"{entry.name}.json"
        write_atomically(path, leaderboard.encoded(content))
        return [path, *leaderboard.save_pictures(folder, entry.name, subject, targets, result)]

    def _made(self, subject: Subject) -> Mapping[str, ReachableTarget]:
        if not self._targets:
            flat = self.conditions["scene"] in scenes.PLANES
            self._targets = fixed_targets(subject, flat_part(subject.geometry, subject.mask) if flat else None)
        return self._targets


@dataclass(frozen=True, slots=True)
class _RigShower:
    """``counted.Shower`` on real devices."""

    light: RigPhotographer
    names: Sequence[str]

    def photograph(self, name: str, frames: Sequence[ByteImage], *, white: float) -> tuple[FloatImage, int]:
        before = len(self.light.used)
        picture = self.light.photograph_shown(name, dict(zip(self.names, frames, strict=True)), white=white)
        return picture, len(self.light.used) - before
