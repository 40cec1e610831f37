"""A projector's white, code and mosaics: as many photographs as are needed, and why there are more."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import cast

import cv2
import numpy as np
import pytest

from controller.core.errors import CalibrationError, UsageError
from controller.optics.calibrate.geometry.shape import AskedShape
from controller.optics.calibrate.geometry.values import CameraPrior
from controller.optics.capture.acquire import Acquirer
from controller.optics.capture.patterns import Code, plan_patterns
from controller.run.journal import Journal
from controller.run.progress import Silent
from controller.run.runner import Context
from controller.run.step_id import StepId
from controller.stage.artefacts.camera import Exposures
from controller.stage.artefacts.kinds import StepKind, white_of
from controller.stage.artefacts.pattern_plans import (
    PhotographOptions,
    Photographs,
    PlanUsed,
    photographs_named,
    photographs_sentence,
)
from controller.stage.artefacts.photographs import BLACK, light_of
from controller.stage.artefacts.projectors import Indirect, Light, Pixels
from controller.stage.rig.lamp_guard import LampGuard
from controller.stage.rig.rig import Rig, RigProjector
from controller.stage.steps.calibrate.full import calibration_steps
from controller.stage.steps.capture.light import photograph_light
from controller.stage.steps.capture.photographs import Planned, take_all
from hal.deadline import Deadline, in_seconds
from hal.errors import DeviceError
from hal.values import CapturedFile, FileKind, OutputInfo
from tests.controller.optics.calibrate.simulator import Scene, Stage, positions
from tests.controller.stage.rig.lamp_model import Lamp, Shelf, World, soon
from tests.controller.stage.rig.rig_model import STEADY_S, ModelCamera, ModelDisplay

SCENE = Scene(camera_px=(320, 248), projector_px=(140, 108))
EXPOSURES = Exposures(1.0, (0.5, 1.0))
NAME = "left"


@dataclass
class OneOutput(ModelDisplay):
    """Of the scene's projector."""

    def outputs(self, *, deadline: Deadline) -> tuple[OutputInfo, ...]:
        return (OutputInfo("P1", *SCENE.projector_px),)


@dataclass
class SimulatedCamera(ModelCamera):
    """Photographs the scene as the display lights it, as TIFF of 16 bits."""

    display: OneOutput = field(default_factory=OneOutput)
    stages: dict[float, Stage] = field(default_factory=dict)
    scene: Scene = SCENE
    fails_at: str = ""

    def capture(self, destination: Path, *, deadline: Deadline) -> list[CapturedFile]:
        if destination.name == self.fails_at:
            raise DeviceError("camera-lost", what="The camera does not answer.", remedy="Check its cable.")
        exposure_s = self.configured[-1].exposure_s
        if exposure_s not in self.stages:
            self.stages[exposure_s] = Stage(replace(self.scene, exposure=self.scene.exposure * exposure_s))
        image = self.stages[exposure_s].photograph(self.display.shown[-1]["P1"]) - 0.003
        path = destination.with_suffix(".tiff")
        path.parent.mkdir(parents=True, exist_ok=True)
        data = cv2.imencode(".tiff", np.rint(65535 * np.clip(image, 0, 1)).astype(np.uint16)[..., ::-1])[1].tobytes()
        path.write_bytes(data)
        self.taken.append(destination.name)
        return [CapturedFile(path, FileKind.RAW, len(data), hashlib.sha256(data).hexdigest())]


@dataclass
class Photographed:
    """One lit projector, its scene, a run with black and exposures, and a run of a calibration from before."""

    rig: Rig
    camera: SimulatedCamera
    context: Context
    last: Path

    def light(self, photographs: Photographs) -> PlanUsed:
        options = PhotographOptions(photographs, self.last)
        paths = photograph_light(self.rig, self.rig.projectors[0], options, self.context)
        assert all(path.exists() for path in paths)
        return PlanUsed.read(self.context.folder, NAME)

    def names(self) -> set[str]:
        return set(light_of(NAME).by_name(self.context.folder))


def stage_of(folder: Path, scene: Scene, journal: Journal) -> Photographed:
    world, display = World(), OneOutput()
    camera = SimulatedCamera(display=display, scene=scene)
    guard = LampGuard(NAME, Lamp(world), Shelf(), clock=world)
    guard.switch_on(deadline=soon())
    world.time_s += STEADY_S
    acquirer = Acquirer(display, camera, iso=100, aperture_f=None, settle_s=0.0)
    rig = Rig(folder, (RigProjector(NAME, "P1", SCENE.projector_px, guard),), camera, display, acquirer)
    context = Context(journal.folder, journal, in_seconds(600), Silent(), {}, lambda fraction, note: None)
    Exposures.write(context.folder, {NAME: EXPOSURES})
    take_all(rig, context, [Planned(str(n), dict, 2.0 * (n + 1)) for n in range(2)], into=BLACK)
    return Photographed(rig, camera, context, folder / "runs" / "before")


@pytest.fixture
def journal(tmp_path: Path) -> Iterator[Journal]:
    run = tmp_path / "runs" / "now"
    run.mkdir(parents=True)
    with Journal(run) as opened:
        yield opened


def calibrated_before(folder: Path, scene: Scene, *, moved_px: float = 0.0) -> None:
    """A run that holds the truth of a scene, or of the same before its projector moved."""
    run = folder / "runs" / "before"
    run.mkdir(parents=True, exist_ok=True)
    at = positions(scene) + np.array([moved_px, 0.0])
    at[np.any((at < -0.5) | (at > np.array(scene.projector_px) - 0.5), axis=2)] = np.nan
    at = at.astype(np.float32)
    columns, rows = scene.projector_px
    seen = np.isfinite(at).all(axis=2)
    empty = np.zeros((rows, columns), np.float32)
    Pixels(
        at, seen.astype(np.float32), seen, np.dstack([empty] * 2), np.dstack([empty] * 3), empty > 0, at, None, None
    ).write(run, NAME)
    picture = np.zeros((*at.shape[:2], 3), np.float32)
    Light(scene.response(), np.array(scene.mixing), picture, picture, np.eye(3)).write(run, NAME)


def test_an_unknown_set_of_photographs_is_refused() -> None:
    assert [photographs_named(name) for name in ("full", "few", "fewest")] == ["full", "few", "fewest"]
    with pytest.raises(UsageError, match="full, few, fewest") as caught:
        photographs_named("none")
    assert caught.value.code == "photographs-unknown"


def test_a_run_from_before_there_was_a_choice_has_all_photographs(tmp_path: Path) -> None:
    assert PlanUsed.read(tmp_path, NAME).plan((1400, 1050)) == plan_patterns((1400, 1050))


def test_a_deleted_calibration_whose_map_is_needed_is_named(tmp_path: Path) -> None:
    used = PlanUsed(few=True, code=Code.KNOWN, known_from="before")
    with pytest.raises(CalibrationError, match="before") as caught:
        used.known_px(tmp_path / "now", NAME)
    assert caught.value.code == "map-missing"


def test_all_photographs_are_taken_where_nothing_else_is_asked_for(tmp_path: Path, journal: Journal) -> None:
    stage = stage_of(tmp_path, SCENE, journal)
    assert stage.light("full") == PlanUsed()
    assert {f"gray-x-{bit}" for bit in range(4)} | {"white-0", "white-1", "mosaic-2"} <= stage.names()


def test_the_code_in_colours_is_enough_where_the_paint_is_bright(tmp_path: Path, journal: Journal) -> None:
    stage = stage_of(tmp_path, SCENE, journal)
    assert stage.light("few") == PlanUsed(few=True, code=Code.COLOURS)
    assert stage.names() == {"white-0", "white-1", "gray-rgb-0", "gray-rgb-1", "gray-rgb-2", "mosaic-0", "mosaic-1"}


def test_mosaics_are_photographed_last_while_the_code_in_colours_is_read(tmp_path: Path, journal: Journal) -> None:
    stage = stage_of(tmp_path, SCENE, journal)
    stage.light("few")
    assert stage.camera.taken[-5:] == ["gray-rgb-0", "gray-rgb-1", "gray-rgb-2", "mosaic-0", "mosaic-1"]


def test_a_camera_that_fails_while_the_code_is_read_ends_the_step(tmp_path: Path, journal: Journal) -> None:
    stage = stage_of(tmp_path, SCENE, journal)
    stage.camera.fails_at = "mosaic-1"
    with pytest.raises(DeviceError):
        stage.light("few")
    stage.camera.fails_at = ""
    assert stage.light("few") == PlanUsed(few=True, code=Code.COLOURS)
    assert stage.camera.taken.count("mosaic-0") == 1


def test_the_code_is_shown_in_grey_too_where_the_paint_is_dark_in_a_colour(tmp_path: Path, journal: Journal) -> None:
    stage = stage_of(tmp_path, replace(SCENE, no_blue=0.5), journal)
    used = stage.light("few")
    assert (used.few, used.code) == (True, Code.GRAY)
    assert "too dark paint" in used.because
    assert {"gray-x-0", "gray-y-3", "gray-rgb-0"} <= stage.names()


def test_no_code_is_shown_where_nothing_moved(tmp_path: Path, journal: Journal) -> None:
    calibrated_before(tmp_path, SCENE)
    stage = stage_of(tmp_path, SCENE, journal)
    assert stage.light("fewest") == PlanUsed(few=True, code=Code.KNOWN, known_from="before")
    assert stage.names() == {"white-0", "white-1", "mosaic-0", "mosaic-1"}


@pytest.mark.parametrize("moved_px", [6.0, -24.0])
def test_the_code_is_shown_where_something_moved(tmp_path: Path, journal: Journal, moved_px: float) -> None:
    calibrated_before(tmp_path, SCENE, moved_px=moved_px)
    stage = stage_of(tmp_path, SCENE, journal)
    used = stage.light("fewest")
    assert (used.few, used.code, used.known_from) == (True, Code.COLOURS, "")
    assert "moved since the last calibration" in used.because
    assert len(stage.names()) == 7


def test_the_code_is_shown_where_there_is_no_calibration_of_it(tmp_path: Path, journal: Journal) -> None:
    stage = stage_of(tmp_path, SCENE, journal)
    used = stage.light("fewest")
    assert used.code is Code.COLOURS
    assert used.because == "The last calibration has no map of it."


def test_a_continued_run_decides_the_same_and_takes_nothing_twice(tmp_path: Path, journal: Journal) -> None:
    calibrated_before(tmp_path, SCENE, moved_px=6.0)
    stage = stage_of(tmp_path, SCENE, journal)
    first = stage.light("fewest")
    number = len(stage.camera.taken)
    # killed after the photograph before the last: its file is there, its row in the journal not
    light_of(NAME).by_name(stage.context.folder)["mosaic-1"].path.unlink()
    assert stage.light("fewest") == first
    assert stage.camera.taken[number:] == ["mosaic-1"]


@pytest.mark.slow
@pytest.mark.parametrize(("photographs", "number"), [("few", 17), ("fewest", 14)])
def test_a_projector_is_measured_from_few_photographs(
    tmp_path: Path, journal: Journal, photographs: Photographs, number: int
) -> None:
    """From the first photograph to its pixels and its indirect light, by the steps of a calibration."""
    calibrated_before(tmp_path, SCENE)
    stage = stage_of(tmp_path, SCENE, journal)
    options = PhotographOptions(photographs, stage.last)
    steps = calibration_steps(stage.rig, cast("CameraPrior", None), longest_exposure_s=4.0, options=options)
    wanted = (StepKind.LIGHT, StepKind.RADIOMETRY, StepKind.CODES, StepKind.PIXELS, StepKind.INDIRECT)
    for step in steps:
        if step.id.kind in wanted:
            step.run(stage.context)
    run = stage.context.folder
    pixels, light, indirect = Pixels.read(run, NAME), Light.read(run, NAME), Indirect.read(run, NAME)
    error = (pixels.projector_px - positions(SCENE))[pixels.seen]
    assert np.sqrt(np.mean(error**2)) < 0.02
    assert np.abs(light.response - SCENE.response()).max() < 0.01
    assert abs(float(np.median(indirect.share[pixels.seen]))) < 0.015
    assert photographs_sentence(run, [NAME]) == f"left {number} ({photographs})"


def test_white_is_photographed_once_and_the_camera_measured_from_it(tmp_path: Path, journal: Journal) -> None:
    stage = stage_of(tmp_path, SCENE, journal)
    steps = {step.id: step for step in calibration_steps(stage.rig, cast("CameraPrior", None), longest_exposure_s=4.0)}
    white, light, camera = steps[white_of(NAME)], steps[StepId(StepKind.LIGHT, NAME)], steps[StepId(StepKind.CAMERA)]
    assert set(white.run(stage.context)) == {photograph.path for photograph in light_of(NAME).read(journal.folder)}
    assert stage.camera.taken[-2:] == ["white-0", "white-1"]
    assert camera.calculates
    camera.run(stage.context)
    light.run(stage.context)
    assert stage.camera.taken.count("white-0") == 1
    assert {"white-0", "white-1", "gray-x-0"} <= stage.names()
    order = list(steps)
    assert order.index(white.id) < order.index(camera.id) < order.index(light.id)


@pytest.mark.parametrize(("shape", "waits"), [("surface", True), ("plane", True), ("auto", False)])
def test_no_third_code_is_photographed_before_two_have_shown_the_shape_that_is_asked_for(
    tmp_path: Path, journal: Journal, shape: AskedShape, waits: bool
) -> None:
    rig = stage_of(tmp_path, SCENE, journal).rig
    three = replace(rig, projectors=tuple(replace(rig.projectors[0], name=name) for name in ("a", "b", "c")))
    steps = calibration_steps(three, cast("CameraPrior", None), longest_exposure_s=4.0, shape=shape)
    ids = [step.id for step in steps]
    first, third = StepId(StepKind.SHAPE), StepId(StepKind.CODES, "c")
    assert ids.index(StepId(StepKind.PIXELS, "b")) < ids.index(first) < ids.index(third)
    assert steps[ids.index(first)].calculates
    assert (first in steps[ids.index(third)].after) is waits
    with pytest.raises(CalibrationError) as refused:
        calibration_steps(rig, cast("CameraPrior", None), longest_exposure_s=4.0, shape="surface")
    assert refused.value.code == "one-projector"


def test_a_code_waits_for_no_response_but_its_own(tmp_path: Path, journal: Journal) -> None:
    rig = stage_of(tmp_path, SCENE, journal).rig
    other = replace(rig.projectors[0], name="right")
    both = replace(rig, projectors=(*rig.projectors, other))
    steps = {step.id: step for step in calibration_steps(both, cast("CameraPrior", None), longest_exposure_s=4.0)}
    for name in (NAME, "right"):
        own = StepId(StepKind.RADIOMETRY, name)
        after = steps[StepId(StepKind.CODES, name)].after
        assert [step for step in after if step.kind == StepKind.RADIOMETRY] == [own]
        assert steps[own].calculates


class BehindTheObject(SimulatedCamera):
    """Sees nothing of what the projector shows."""

    def capture(self, destination: Path, *, deadline: Deadline) -> list[CapturedFile]:
        shown = self.display.shown
        shown.append({name: np.zeros_like(frame) for name, frame in shown[-1].items()})
        try:
            return super().capture(destination, deadline=deadline)
        finally:
            shown.pop()


@pytest.mark.parametrize("alone", [True, False])
def test_a_view_that_sees_nothing_of_a_projector_goes_on_unless_it_is_the_only_one(
    tmp_path: Path, journal: Journal, alone: bool
) -> None:
    stage = stage_of(tmp_path, SCENE, journal)
    blind = BehindTheObject(display=stage.camera.display)
    acquirer = Acquirer(blind.display, blind, iso=100, aperture_f=None, settle_s=0.0)
    rig = replace(stage.rig, camera=blind, acquirer=acquirer)
    if not alone:
        rig = replace(rig, drawn_by=lambda name, deadline: SCENE.response())
    steps = calibration_steps(rig, cast("CameraPrior", None), longest_exposure_s=4.0)
    wanted = (StepKind.LIGHT, StepKind.RADIOMETRY, StepKind.CODES, StepKind.PIXELS, StepKind.INDIRECT)
    refused = None
    try:
        for step in steps:
            if step.id.kind in wanted:
                step.run(stage.context)
    except CalibrationError as error:
        refused = error.code
    assert (refused is not None) is alone
    if alone:
        return
    run = stage.context.folder
    assert not Pixels.read(run, NAME).valid.any()
    assert not Light.read(run, NAME).white.any()
    assert not Indirect.read(run, NAME).share.any()
