"""`velatura study`: experiments on emulated stages. Each stage is set up and calibrated once and kept."""

from __future__ import annotations

import json
import shutil
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from controller.config import write_stage
from controller.core.errors import UsageError, WorkError
from controller.core.storage import sync_folder, write_atomically
from controller.run.progress import Reporter
from controller.run.runner import Context, Step
from controller.run.step_id import StepId
from controller.stage.artefacts.calibrated import Calibrated
from controller.stage.artefacts.kinds import StepKind, of_projectors
from controller.stage.rig.rig import Rig
from controller.stage.services.calibrate import calibrating
from controller.stage.sessions.bench import BenchProcess, bench_of
from controller.stage.sessions.check import Checked, check_stage
from controller.stage.sessions.session import OwnSession, StageWork
from controller.stage.steps import costs
from hal.errors import DeviceError
from lab.study.catalogue import EXPERIMENTS, SCENES, chosen
from lab.study.output.keeping import save_result
from lab.study.output.pages import INDEX, publish
from lab.study.subject.disturbance import RigStageControl, subject_of
from lab.study.subject.dots import dot_steps
from lab.study.subject.photographing import RigPhotographer
from lab.study.subject.scenes import Scene
from lab.study.subject.subject import SessionParts
from lab.study.values import Experiment

SIZES = ("small", "medium", "paper")
MARK = "study.json"
RESULTS = "study"
"""Folder in a run with the experiments' results."""
POWER_DOWN_S = 10.0


def experiments() -> dict[str, str]:
    """The title of each experiment, by its name."""
    return {one.name: one.title + (" (only if named)" if one.optional else "") for one in EXPERIMENTS}


def study(
    *,
    names: Sequence[str],
    size: str,
    out: Path,
    pages: Path | None,
    seeds: Sequence[int],
    reporter: Reporter,
    cancel: threading.Event,
) -> Mapping[str, Any]:
    """Run the experiments for each seed, continuing what is in ``out``; write their pages; return the index's path.

    A page judges a criterion over all seeds that it holds: those of now, and those of earlier studies of this size.

    Raises UsageError("experiment-unknown", "size-unknown", "study-folder-taken"), and what the devices, the calibration
    and the experiments raise; the lamps are safe by then.
    """
    wanted = chosen(names)
    check_size(size)
    out = out.resolve()
    pages = (out / "pages" if pages is None else pages).resolve()
    index = pages / INDEX
    for seed in dict.fromkeys(seeds):
        index = _one_seed(wanted, out / f"seed-{seed}", pages, (size, seed), reporter, cancel)
    return {"index": str(index)}


def check_size(size: str) -> None:
    """Raises UsageError("size-unknown")."""
    if size not in SIZES:
        raise UsageError(
            "size-unknown", what=f"The size {size!r} is unknown.", remedy=f"Choose one of {', '.join(SIZES)}."
        )


def _one_seed(
    wanted: Sequence[Experiment], out: Path, pages: Path, what: tuple[str, int], reporter: Reporter,
    cancel: threading.Event,
) -> Path:  # fmt: skip
    """All experiments on the stages of one size and seed; the index of their pages."""
    size, seed = what
    free = [experiment for experiment in wanted if experiment.scene is None]
    index = publish([_without_stage(experiment, out, size, seed, reporter) for experiment in free], pages,
                    EXPERIMENTS)  # fmt: skip
    for scene in dict.fromkeys(experiment.scene for experiment in wanted if experiment.scene is not None):
        here = [experiment for experiment in wanted if experiment.scene == scene]
        reporter.say(f"On {SCENES[scene].title}, seed {seed}: {', '.join(experiment.name for experiment in here)}.")
        # After each stage, so that a failing one does not cost the pages of the previous ones.
        index = publish(_on_scene(SCENES[scene], here, out, size, seed, reporter, cancel), pages, EXPERIMENTS)
    return index


def _without_stage(one: Experiment, out: Path, size: str, seed: int, reporter: Reporter) -> Path:
    """For an experiment without a stage: its function is called with None."""
    reporter.say(f"{one.title}.")
    began_s = time.perf_counter()
    result = one.run(None)  # type: ignore[arg-type]
    facts = {"size": size, "seed": seed, "code": one.code_sha256(), "seconds": round(time.perf_counter() - began_s)}
    folder = out / RESULTS
    folder.mkdir(parents=True, exist_ok=True)
    return save_result(folder, one, result, facts)[0]


def _on_scene(
    scene: Scene,
    experiments: Sequence[Experiment],
    out: Path,
    size: str,
    seed: int,
    reporter: Reporter,
    cancel: threading.Event,
) -> list[Path]:
    steps = partial(_steps, experiments=experiments, scene=scene, size=size, seed=seed)
    stage = prepare_scene(out / "scenes" / scene.name, scene, size=size, seed=seed)
    run = run_on_bench(stage, steps, name="study", reporter=reporter, cancel=cancel)
    return [run / RESULTS / f"{experiment.name}.json" for experiment in experiments]


def run_on_bench(
    stage: Path, steps: Callable[[Rig, Path, Checked, BenchProcess], Sequence[Step]], *, name: str, reporter: Reporter,
    cancel: threading.Event,
) -> Path:  # fmt: skip
    """Run ``steps`` on the stage folder's emulated devices, continuing an unfinished run of this name; its folder."""
    checked = check_stage(stage)
    bench_of(stage).disturb(stage, ())  # a stopped experiment may have left files
    bench = BenchProcess(stage, cancel=cancel, tell=reporter.say)
    session = OwnSession(stage, around=bench, again=True)
    return session.run(
        checked, StageWork(name, lambda rig, run: steps(rig, run, checked, bench)), reporter=reporter, cancel=cancel
    )


@dataclass(frozen=True, slots=True)
class Opened:
    """A stage on which experiments run after its calibration.

    ``calibrating``: the steps of the calibration, and of the dots where an experiment needs them; ``after``: those that
    every experiment needs, and ``dots``: those that it needs if it uses dots; ``scale`` of an experiment's cost
    """

    calibrated: Calibrated
    longest_s: float
    calibrating: Sequence[Step]
    after: Sequence[StepId]
    dots: Sequence[StepId]
    scale: float


def opened(rig: Rig, run: Path, checked: Checked, *, dots: bool) -> Opened:
    """``dots``: whether any experiment needs them."""
    longest_s = checked.stage.tables.capture.longest_exposure_s
    calibrated = Calibrated(run, checked.names)
    steps = list(calibrating(rig, run, checked=checked, calibrated=calibrated))
    if dots:
        steps += dot_steps(rig, longest_exposure_s=longest_s)
    measured = of_projectors(checked.names, StepKind.RADIOMETRY, StepKind.PIXELS, StepKind.INDIRECT)
    return Opened(
        calibrated,
        longest_s,
        steps,
        (StepId(StepKind.GEOMETRY), *measured),
        tuple(of_projectors(checked.names, StepKind.STUDY_SHARES)),
        costs.scale(projector.size_px for projector in rig.projectors),
    )


def _steps(
    rig: Rig, run: Path, checked: Checked, bench: BenchProcess, *, experiments: Sequence[Experiment], scene: Scene,
    size: str, seed: int,
) -> Sequence[Step]:  # fmt: skip
    """Calibrate, photograph dots where needed, and run each experiment; skip what is done already."""
    stage = opened(rig, run, checked, dots=any(experiment.dots for experiment in experiments))
    conditions = {"scene": scene.title, "size": size, "room": scene.room, "seed": seed}
    return [
        *stage.calibrating,
        *(
            Step(
                StepId("study", item=one.name),
                partial(_experiment, rig, checked, stage.calibrated, one, conditions, stage.longest_s, bench.disturb),
                inputs={"size": size, "seed": str(seed), "code": one.code_sha256()},
                after=(*stage.after, *(stage.dots if one.dots else ())),
                title=one.title,
                weight=one.cost_s * stage.scale,
            )
            for one in experiments
        ),
    ]


def _experiment(
    rig: Rig,
    checked: Checked,
    calibrated: Calibrated,
    one: Experiment,
    conditions: Mapping[str, Any],
    longest_s: float,
    disturb: Callable[[Sequence[Mapping[str, Any]]], None],
    context: Context,
) -> Sequence[Path]:
    before, began_s = context.journal.shot_count(), time.perf_counter()
    make = subject_of(str(conditions["size"]), int(conditions["seed"]), context)
    hand = RigStageControl(rig, context, calibrated, one.name, checked.prior(), longest_s, disturb, make)
    light = RigPhotographer(rig, context, calibrated, one.name, longest_s)
    subject = make(calibrated, light, context.folder)
    subject.parts = SessionParts(hand, context)
    try:
        result = one.run(subject)
    finally:
        disturb(())
    facts = {
        **conditions,
        "code": one.code_sha256(),
        # Photographs of an earlier run count, too; those of an experiment itself are not in ``used``.
        "photographs": max(len(light.used), context.journal.shot_count() - before),
        "seconds": round(time.perf_counter() - began_s),
    }
    folder = context.folder / RESULTS
    folder.mkdir(exist_ok=True)
    return save_result(folder, one, result, facts)


def prepare_scene(out: Path, scene: Scene, *, size: str, seed: int) -> Path:
    """The stage folder ``out/stage`` of a scene, created now or by an earlier study.

    Raises UsageError("study-folder-taken") for another size or seed, and WorkError if the bench refuses.
    """
    stage, wanted = out / "stage", {"scene": scene.name, "size": size, "room": scene.room, "seed": seed}
    if stage.exists():
        try:
            known = json.loads((stage / MARK).read_bytes())
        except (OSError, ValueError):
            known = None
        if known != wanted:
            raise UsageError(
                "study-folder-taken",
                what=f"{stage} does not contain the stage of this study.",
                remedy="Choose another folder with --out, or use the size and seed of that folder.",
            )
        return stage
    building = out / ".stage.part"
    shutil.rmtree(building, ignore_errors=True)
    building.mkdir(parents=True)
    thing = None
    if scene.write_object is not None:
        thing = out / "object.ply"
        scene.write_object(thing, seed)
    try:
        tables = bench_of(building, scene.settings).prepare(building, size=size, object_file=thing, seed=seed)
    except DeviceError as error:
        raise WorkError(error.code, what=error.what, remedy=error.remedy) from error
    named = {"stage": {"name": f"study {scene.name}"}, **tables, "safety": {"power_down_s": POWER_DOWN_S}}
    write_stage(building / "stage.toml", named)
    write_atomically(building / MARK, json.dumps(wanted).encode())
    building.rename(stage)
    sync_folder(out)
    return stage
