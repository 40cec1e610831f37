"""`velatura study`: experiments on emulated stages, each stage set up and calibrated once and kept for re-use."""

from __future__ import annotations

import json
import shutil
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from controller.artefacts.calibrated import Calibrated
from controller.artefacts.kinds import StepKind, of_projectors
from controller.config import write_stage
from controller.core.errors import UsageError, WorkError
from controller.core.storage import sync_folder, write_atomically
from controller.rig.rig import Rig
from controller.run.progress import Reporter
from controller.run.runner import Context, Step
from controller.run.step_id import StepId
from controller.services.calibrate import calibrating
from controller.stage.bench import BenchProcess, bench_of
from controller.stage.check import Checked, check_stage
from controller.stage.session import OwnSession
from controller.steps import costs
from controller.study.catalogue import EXPERIMENTS, SCENES, chosen
from controller.study.lab.disturbance import RigStageControl, subject_of
from controller.study.lab.photographing import RigPhotographer, dot_steps
from controller.study.lab.scenes import Scene
from controller.study.lab.subject import SessionParts
from controller.study.output.keeping import save_result
from controller.study.output.pages import publish
from controller.study.values import Experiment
from hal.errors import DeviceError

SIZES = ("small", "medium", "paper")
MARK = "study.json"
RESULTS = "study"
"""Folder of a run that holds the experiments' results."""
POWER_DOWN_S = 10.0


def study(
    *,
    names: Sequence[str],
    size: str,
    out: Path,
    pages: Path | None,
    seed: int,
    reporter: Reporter,
    cancel: threading.Event,
) -> Mapping[str, Any]:
    """Do the experiments, going on with what ``out`` holds; write their pages; return where the index lies.

    Raises UsageError("experiment-unknown", "size-unknown", "study-folder-taken"), and what the devices, the calibration
    and the experiments raise; the lamps are safe by then.
    """
    wanted = chosen(names)
    if size not in SIZES:
        raise UsageError(
            "size-unknown", what=f"There is no size {size!r}.", remedy=f"Choose one of {', '.join(SIZES)}."
        )
    out = out.resolve()
    pages = (out / "pages" if pages is None else pages).resolve()
    index = publish([_without_stage(one, out, size, seed, reporter) for one in wanted if one.scene is None], pages,
                    EXPERIMENTS)  # fmt: skip
    for scene in dict.fromkeys(one.scene for one in wanted if one.scene is not None):
        here = [one for one in wanted if one.scene == scene]
        reporter.say(f"On {SCENES[scene].title}: {', '.join(one.name for one in here)}.")
        # After each stage, so that one that fails does not cost the pages of those before.
        index = publish(_on_scene(SCENES[scene], here, out, size, seed, reporter, cancel), pages, EXPERIMENTS)
    return {"index": str(index)}


def _without_stage(one: Experiment, out: Path, size: str, seed: int, reporter: Reporter) -> Path:
    """An experiment that needs no stage gets none: its function is called with None."""
    reporter.say(f"{one.title}.")
    began_s = time.perf_counter()
    result = one.run(None)  # type: ignore[arg-type]
    facts = {"size": size, "seed": seed, "seconds": round(time.perf_counter() - began_s)}
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
    stage = prepare_scene(out / "scenes" / scene.name, scene, size=size, seed=seed)
    checked = check_stage(stage)
    bench_of(stage).disturb(stage, ())  # what a stopped experiment may have left
    bench = BenchProcess(stage, cancel=cancel, tell=reporter.say)
    steps = partial(
        _steps, experiments=experiments, checked=checked, scene=scene, size=size, seed=seed, disturb=bench.disturb
    )
    session = OwnSession(stage, around=bench, again=True)
    run = session.run(checked, steps, name="study", reporter=reporter, cancel=cancel)
    return [run / RESULTS / f"{one.name}.json" for one in experiments]


def _steps(
    rig: Rig, run: Path, *, experiments: Sequence[Experiment], checked: Checked, scene: Scene, size: str, seed: int,
    disturb: Callable[[Sequence[Mapping[str, Any]]], None],
) -> Sequence[Step]:  # fmt: skip
    """Calibrate, photograph dots where they are wanted, and do each experiment; what is done already is passed over."""
    longest_s = checked.stage.tables.capture.longest_exposure_s
    calibrated = Calibrated(run, checked.names)
    steps = list(calibrating(rig, run, checked=checked, calibrated=calibrated))
    after = [
        StepId(StepKind.GEOMETRY),
        *of_projectors(checked.names, StepKind.RADIOMETRY, StepKind.PIXELS, StepKind.INDIRECT),
    ]
    if any(one.dots for one in experiments):
        steps += dot_steps(rig, longest_exposure_s=longest_s)
    scale = costs.scale(projector.size_px for projector in rig.projectors)
    told = {"scene": scene.title, "size": size, "seed": seed}
    for one in experiments:
        dots = of_projectors(checked.names, StepKind.STUDY_DOTS) if one.dots else ()
        steps.append(
            Step(
                StepId("study", item=one.name),
                partial(_experiment, rig, checked, calibrated, one, told, longest_s, disturb),
                inputs={"size": size, "seed": str(seed), "code": one.code_sha256()},
                after=(*after, *dots),
                title=one.title,
                weight=one.cost_s * scale,
            )
        )
    return steps


def _experiment(
    rig: Rig,
    checked: Checked,
    calibrated: Calibrated,
    one: Experiment,
    told: Mapping[str, Any],
    longest_s: float,
    disturb: Callable[[Sequence[Mapping[str, Any]]], None],
    context: Context,
) -> Sequence[Path]:
    before, began_s = context.journal.shot_count(), time.perf_counter()
    make = subject_of(str(told["size"]), int(told["seed"]), context)
    hand = RigStageControl(rig, context, calibrated, one.name, checked.prior, longest_s, disturb, make)
    light = RigPhotographer(rig, context, calibrated, one.name, longest_s)
    subject = make(calibrated, light, context.folder)
    subject.parts = SessionParts(hand, context)
    try:
        result = one.run(subject)
    finally:
        disturb(())
    facts = {
        **told,
        # What an earlier run photographed counts, too; what an experiment photographs by itself is not in ``used``.
        "photographs": max(len(light.used), context.journal.shot_count() - before),
        "seconds": round(time.perf_counter() - began_s),
    }
    folder = context.folder / RESULTS
    folder.mkdir(exist_ok=True)
    return save_result(folder, one, result, facts)


def prepare_scene(out: Path, scene: Scene, *, size: str, seed: int) -> Path:
    """The stage folder ``out/stage`` of a scene: set up now, or found as an earlier study left it.

    Raises UsageError("study-folder-taken") where it is of another size or seed, and WorkError where the bench refuses.
    """
    stage, wishes = out / "stage", {"scene": scene.name, "size": size, "seed": seed}
    if stage.exists():
        try:
            known = json.loads((stage / MARK).read_bytes())
        except (OSError, ValueError):
            known = None
        if known != wishes:
            raise UsageError(
                "study-folder-taken",
                what=f"{stage} holds something else than the stage of this study.",
                remedy="Choose another folder with --out, or the size and seed that it was made with.",
            )
        return stage
    building = out / ".stage.part"
    shutil.rmtree(building, ignore_errors=True)
    building.mkdir(parents=True)
    thing = None
    if scene.write_object is not None:
        thing = out / "object.ply"
        scene.write_object(thing)
    try:
        tables = bench_of(building, scene.settings).prepare(building, size=size, object_file=thing, seed=seed)
    except DeviceError as error:
        raise WorkError(error.code, what=error.what, remedy=error.remedy) from error
    named = {"stage": {"name": f"study {scene.name}"}, **tables, "safety": {"power_down_s": POWER_DOWN_S}}
    write_stage(building / "stage.toml", named)
    write_atomically(building / MARK, json.dumps(wishes).encode())
    building.rename(stage)
    sync_folder(out)
    return stage
