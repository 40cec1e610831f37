"""`velatura demo`: its stage, written once and used again when a demo continues, and the steps of a complete job."""

from __future__ import annotations

import contextlib
import json
import re
import shutil
import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from controller.bundle.signing import generate_key
from controller.config import write_stage
from controller.core.arrays import FloatImage
from controller.core.colour import linear_to_srgb
from controller.core.errors import UsageError, WorkError
from controller.core.storage import sha256_of, sync_folder, write_atomically
from controller.optics.solve.appearance import exposed_for_one, traditional_compensation
from controller.optics.solve.bounded.engine import Engine
from controller.optics.solve.engines import choose_engine
from controller.optics.solve.reach.feasibility import target_radiance
from controller.optics.solve.targets.files import shipped_photograph
from controller.run.progress import Reporter
from controller.run.runner import Context, Step
from controller.run.state_machine import Event
from controller.run.step_id import StepId
from controller.stage.artefacts.calibrated import AllViews, Calibrated
from controller.stage.artefacts.kinds import StepKind, of_projectors
from controller.stage.artefacts.published import Dimmed, write_photograph
from controller.stage.artefacts.solved import RequestedTarget, read_solved
from controller.stage.report.demo import write_demo_report
from controller.stage.rig.rig import Rig
from controller.stage.services.calibrate import calibrating, publishing
from controller.stage.services.register import MeshOrder, register_in
from controller.stage.sessions.bench import BenchProcess, bench_of
from controller.stage.sessions.calibrations import KEY_FILE, worst_grade
from controller.stage.sessions.check import Checked, check_stage
from controller.stage.sessions.run import marker
from controller.stage.sessions.session import OwnSession, StageWork
from controller.stage.steps import costs
from controller.stage.steps.appearance.photographing import (
    ShownPicture,
    photograph_hdr,
    photograph_step,
    photographs_s,
    playback_step,
)
from controller.stage.steps.appearance.refining import RefineOptions, refine_steps
from controller.stage.steps.appearance.requests import requests_of
from controller.stage.steps.appearance.solving import device_frames, options_of, solve_steps
from controller.stage.steps.calibrate.full import join_geometry
from controller.stage.steps.calibrate.gate import gate_step
from hal.errors import DeviceError

MARK = "demo.json"
BUILDING = ".stage.part"
PHOTOGRAPH = "photograph.png"
DEFAULT_ROOM = "room"
"""With light that comes back from object, table and wall, as stages have it."""
POWER_DOWN_S = 10.0
"""Emulated lamps go off at once; a dead bench must not delay the end of the demo."""

APPEARANCES: tuple[dict[str, Any], ...] = (
    {"name": "photograph", "kind": "photograph", "file": PHOTOGRAPH},
    {"name": "new-pattern", "kind": "pattern"},
    {"name": "checkerboard", "kind": "checkerboard"},
    {"name": "gloss", "kind": "gloss"},
)
IN_OTHER_LIGHT: tuple[dict[str, Any], ...] = (
    {"name": "evening", "kind": "recolour", "tint": [1.0, 0.62, 0.36]},
    {"name": "moonlight", "kind": "recolour", "tint": [0.42, 0.60, 1.0]},
)
"""Of an object whose shape may not be measured: by one projector, or because it has none to speak of."""
RESTORED = (
    {"name": "restored", "kind": "restoration", "file": "original.png", "outside": "as-is"},
    *IN_OTHER_LIGHT[:1],
)
PAINTED = ({"name": "painted", "kind": "texture", "file": "colours.png"}, *APPEARANCES[2:])
"""Of a statue: its old colours on the sheet of its scan, which is laid on it before."""
SCAN, LAY_S = "statue.glb", 10.0
OF_OBJECT: Mapping[str | None, tuple[dict[str, Any], ...]] = {
    None: APPEARANCES, "painting": RESTORED, "relief": RESTORED, "statue": PAINTED,
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class DemoStage:
    """What a demo works on. ``thing``: one of the bench's built-in objects, or the path of a mesh; None: vase and bust;

    ``projectors`` None: as many as the object usually has
    """

    size: str
    seed: int
    thing: str | None = None
    room: str = DEFAULT_ROOM
    projectors: int | None = None
    cameras: int = 1

    @property
    def built_in(self) -> str | None:
        """The name of a built-in object. A name has no ending and no folder, which the path of a mesh always has."""
        return self.thing if self.thing and re.fullmatch(r"[a-z]+(-[a-z]+)*", self.thing) else None

    @property
    def appearances(self) -> tuple[dict[str, Any], ...]:
        its = OF_OBJECT.get(self.built_in, IN_OTHER_LIGHT)
        return IN_OTHER_LIGHT if self.projectors == 1 and self.built_in != "painting" else its

    @property
    def object_file(self) -> Path | None:
        return Path(self.thing) if self.thing and not self.built_in else None


def prepare(out: Path, asked: DemoStage) -> Path:
    """The stage folder ``out/stage`` for these options, created now or by an earlier demo.

    Raises UsageError("demo-folder-taken") if ``out`` holds a stage with other options, and what the bench refuses (a
    mesh without faces, an unknown size or room) before anything is written.
    """
    stage = out / "stage"
    thing = asked.built_in or _object_digest(asked.object_file)
    options = {"size": asked.size, "seed": asked.seed, "object": thing, "room": asked.room}
    if asked.projectors is not None:
        options["projectors"] = asked.projectors
    if asked.cameras > 1:
        options["cameras"] = asked.cameras
    if (mark := stage / MARK).exists():
        if _read_mark(mark) != options:
            raise UsageError(
                "demo-folder-taken",
                what=f"{out} contains a demo with another size, object, seed, room or number of devices.",
                remedy="Choose another folder with --out, or delete this one.",
            )
        return stage
    if stage.is_dir() and any(stage.iterdir()):
        raise UsageError(
            "demo-folder-taken",
            what=f"{stage} is not empty and is not from a demo.",
            remedy="Choose another folder with --out.",
        )
    _build(out, stage, options, asked)
    return stage


def _build(out: Path, stage: Path, options: Mapping[str, Any], asked: DemoStage) -> None:
    """Write the stage under another name and rename it, so that a stopped demo leaves all of it or nothing."""
    building, there = out / BUILDING, out.exists()
    shutil.rmtree(building, ignore_errors=True)
    try:
        tables = _write(building, asked)
        write_stage(building / "stage.toml", tables)
        write_atomically(building / MARK, json.dumps(options).encode())
        building.rename(stage)
        sync_folder(out)
    except BaseException:
        shutil.rmtree(building, ignore_errors=True)
        if not there:
            with contextlib.suppress(OSError):
                out.rmdir()
        raise


def _write(stage: Path, asked: DemoStage) -> Mapping[str, Any]:
    settings = {"room": asked.room, "object": asked.built_in, "projectors": asked.projectors}
    settings |= {"cameras": asked.cameras} if asked.cameras > 1 else {}
    try:
        bench = bench_of(stage, {key: value for key, value in settings.items() if value is not None})
        devices = bench.prepare(stage, size=asked.size, object_file=asked.object_file, seed=asked.seed)
    except DeviceError as error:
        kind = UsageError if error.code.startswith(("size-", "object-", "setting-")) else WorkError
        raise kind(error.code, what=error.what, remedy=error.remedy) from error
    _write_photograph(stage / PHOTOGRAPH)
    public = generate_key(stage / KEY_FILE)
    return {
        "stage": {"name": " ".join(("demo", asked.size, *filter(None, (asked.built_in,))))},
        **devices,
        "safety": {"power_down_s": POWER_DOWN_S},
        "bundle": {"trusted_keys": [public.hex()]},
        "appearances": list(asked.appearances),
    }


def _read_mark(mark: Path) -> object:
    try:
        return json.loads(mark.read_bytes())
    except (OSError, ValueError):
        return None


def _write_photograph(path: Path) -> None:
    encoded = np.rint(255 * linear_to_srgb(shipped_photograph())).astype(np.uint8)
    ok, data = cv2.imencode(".png", encoded[..., ::-1])
    assert ok
    write_atomically(path, data.tobytes())


def _object_digest(object_file: Path | None) -> str:
    if object_file is None:
        return ""
    if not object_file.is_file():
        raise UsageError(
            "object-missing",
            what=f"The file {object_file} does not exist.",
            remedy="Give the path of a mesh, .obj or .ply, or the name of a built-in object such as painting.",
        )
    try:
        return sha256_of(object_file)
    except OSError as error:
        raise UsageError(
            "object-unreadable",
            what=f"{object_file} can't be read: {error.strerror}.",
            remedy="Check the file's permissions.",
        ) from error


PLAYBACK_S = 2.0


def demo(stage: Path, *, reporter: Reporter, cancel: threading.Event) -> Mapping[str, Any]:
    """Run the complete job on a stage of ``demo.stage.prepare``, or continue an unfinished one.

    Returns the paths of the stage and of the report beside it. Raises what the configuration, the devices and the
    steps raise; the lamps are safe by then.
    """
    checked, out = check_stage(stage), stage.parent
    bench = BenchProcess(stage, cancel=cancel, tell=reporter.say)
    session = OwnSession(stage, around=bench)
    solve = checked.stage.tables.solve
    engine = choose_engine(solve.device, reporter.say)
    steps = partial(demo_steps, checked=checked, engine=engine)
    run = session.run(checked, StageWork("demo", steps, views=True), reporter=reporter, cancel=cancel)
    reporter.say("Writing the report.")
    html, machine = write_demo_report(out, run, checked)
    return {"report": str(html), "figures": str(machine), "stage": str(stage)}


def demo_steps(rig: Rig, run: Path, *, checked: Checked, engine: Engine) -> Sequence[Step]:
    """Calibrate, solve for all views, refine, publish, photograph, compare with one projector, swap.

    Other views only calibrate; from then on, the first view's steps use all of them.
    """
    stage = checked.stage
    if not rig.is_first:
        return calibrating(rig, run, checked=checked)
    first = Calibrated(run, checked.names, engine)
    calibrated = AllViews(run, checked.names, engine) if rig.others else first
    scan = stage.path(SCAN)
    requests = [
        replace(one, prepare=partial(_lay_scan, scan), prepare_s=LAY_S) if one.inputs["kind"] == "texture" else one
        for one in requests_of(stage, calibrated)
    ]
    names = [request.name for request in requests]
    table = stage.tables.solve
    options = options_of(table)
    after = [
        StepId(StepKind.GEOMETRY),
        *of_projectors(checked.names, StepKind.RADIOMETRY, StepKind.PIXELS, StepKind.INDIRECT),
    ]
    longest_s = stage.tables.capture.longest_exposure_s
    refining = RefineOptions(table.refine, table.smoothness, longest_s)
    solvings = {name: StepId(StepKind.APPEARANCE, item=name) for name in names}
    joining = Step(StepId("views-joined"), partial(_join, checked), title="Joining the views", always=True)
    return [
        *calibrating(rig, run, checked=checked, calibrated=first),
        *((joining,) if rig.others else ()),
        # The objects are emulated: a demo in a hard room is shown with the grade that it has.
        gate_step(worst_grade(checked), accepted=True),
        marker("solving", "Solving", enter=Event.SOLVE),
        *solve_steps(calibrated, requests, options, after, costs.scale(p.size_px for p in rig.projectors)),
        *refine_steps(rig, calibrated, {request.name: request.title for request in requests}, refining, after=solvings),
        marker("solved", "Solved", leave=Event.SOLVED),
        marker("publishing", "Publishing", enter=Event.PUBLISH),
        publishing(checked, first, names),
        marker("published", "Published", leave=Event.PUBLISHED),
        marker("playing", "Playing", enter=Event.PLAY),
        photograph_step(rig, names, longest_exposure_s=longest_s),
        *_one_projector_steps(rig, first, names, longest_s, options.share),
        playback_step(rig, names, seconds=PLAYBACK_S),
        marker("played", "Played", leave=Event.PAUSE),
    ]


def _join(checked: Checked, context: Context) -> Sequence[Path]:
    shape = checked.stage.tables.object.shape
    join_geometry(context.folder, checked.poses, checked.prior, shape, context.reporter)
    return ()


def _lay_scan(scan: Path, context: Context) -> Sequence[Path]:
    """Lay the mesh that the object's owner has of it on the object. Raises as ``register_in``."""
    return [register_in(context.folder, MeshOrder(scan), context.reporter)["map"]]


def _one_projector_steps(
    rig: Rig, calibrated: Calibrated, names: Sequence[str], longest_s: float, share: float
) -> list[Step]:
    """For comparison: the targets shown by one projector with division at each pixel, at two exposures.

    At ours, and at the one that this projector can reach, so that the comparison is not about brightness alone.
    """
    after = tuple(StepId(StepKind.APPEARANCE, item=name) for name in names)
    weight = photographs_s(rig, names)
    alone = _BestProjector(rig, calibrated, longest_s)
    return [
        Step(
            StepId(StepKind.TRADITIONAL),
            partial(_traditional, alone, tuple(names)),
            after=after,
            title="Photographing one projector for comparison",
            weight=weight,
        ),
        Step(
            StepId(StepKind.DIMMED),
            partial(_dimmed, alone, tuple(names), share),
            inputs={"share": repr(share)},
            after=after,
            title="Photographing one projector at its own exposure",
            weight=weight,
        ),
    ]


@dataclass(frozen=True, slots=True)
class _BestProjector:
    """The projector that lights most of the object, alone; ``longest_s``: the longest exposure."""

    rig: Rig
    calibrated: Calibrated
    longest_s: float

    @property
    def index(self) -> int:
        lit = self.calibrated.transport.lit
        return int(lit.reshape(len(lit), -1).sum(axis=1).argmax())

    def photograph(
        self, context: Context, kind: StepKind, name: str, target: RequestedTarget, exposure: float
    ) -> FloatImage:
        """A photograph of ``target``, made by this projector alone; ``exposure``: the radiance of its white."""
        calibration, best = self.calibrated.calibration, self.index
        frames = device_frames(calibration, traditional_compensation(calibration, target.target, best))
        shown = self.rig.display.show(self.rig.on_outputs(frames), deadline=context.deadline.within(20))
        of = {"appearance": name, "projector": str(best)}
        what = ShownPicture(kind, name, of, shown.at_s, exposure, target.target[target.reachable])
        return photograph_hdr(self.rig, context, what, self.longest_s)


def _traditional(alone: _BestProjector, names: Sequence[str], context: Context) -> Sequence[Path]:
    paths = []
    for number, name in enumerate(names):
        context.advance(number / len(names), name)
        solved = read_solved(context.folder, name, alone.calibrated.projectors)
        picture = alone.photograph(context, StepKind.TRADITIONAL, name, solved.requested, solved.exposure)
        paths.append(write_photograph(context.folder, StepKind.TRADITIONAL, name, picture))
    return paths


def _dimmed(alone: _BestProjector, names: Sequence[str], share: float, context: Context) -> Sequence[Path]:
    calibrated, paths = alone.calibrated, []
    calibration = calibrated.calibration
    for number, name in enumerate(names):
        context.advance(number / len(names), name)
        solved = read_solved(context.folder, name, calibrated.projectors)
        picture = np.asarray(solved.requested.target / np.float32(solved.exposure), np.float32)
        dim = exposed_for_one(calibration, picture, alone.index, share=share, indirect=calibrated.indirect)
        radiance, valid = target_radiance(dim.wanted, calibration.black, 1.0), solved.requested.valid
        target = RequestedTarget(radiance, dim.possible.reachable & valid, valid)
        photograph = alone.photograph(context, StepKind.DIMMED, name, target, dim.exposure)
        paths.append(Dimmed(photograph, radiance, target.reachable, dim.exposure).write(context.folder, name))
    return paths
