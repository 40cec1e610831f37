"""Photographs of a run: taken once, unless something that they depend on changed, or a lamp's light was missing."""

from __future__ import annotations

import threading
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from controller.core.arrays import ByteImage
from controller.run.journal import Journal
from controller.run.progress import Silent
from controller.run.runner import Context
from controller.run.step_id import ShotId
from controller.stage.artefacts.photographs import Developed, PhotographSet, TakenPhotograph
from controller.stage.steps.capture import photographs as shots
from controller.stage.steps.capture.photographs import Planned, take_all, take_photograph
from hal.deadline import Cancelled, Deadline, in_seconds
from hal.errors import DeviceGone, DeviceRefused
from hal.values import CapturedFile, ProjectorStatus
from tests.controller.stage.rig.lamp_model import Lamp, soon
from tests.controller.stage.rig.rig_model import SIZE_PX, STEADY_S, ModelRig


@pytest.fixture
def stage(tmp_path: Path) -> ModelRig:
    return ModelRig(tmp_path)


@pytest.fixture
def context(tmp_path: Path) -> Iterator[Context]:
    with Journal(tmp_path / "run") as journal:
        yield Context(journal.folder, journal, in_seconds(60), Silent(), {}, lambda fraction, note: None)


def grey(value: int) -> dict[str, ByteImage]:
    return {"left": np.full((SIZE_PX[1], SIZE_PX[0], 3), value, np.uint8)}


def plan(values: Sequence[int] = (10, 20, 30), exposure_s: float = 0.5) -> list[Planned]:
    return [Planned(f"grey-{n}", partial(grey, value), exposure_s) for n, value in enumerate(values)]


def light_again(stage: ModelRig) -> None:
    stage.lamps["right"].strike(sin=False)
    stage.rig.guards[1].status(deadline=soon())
    stage.world.time_s += STEADY_S


def test_each_photograph_shows_its_frames_and_is_listed_in_order(stage: ModelRig, context: Context) -> None:
    paths = take_all(stage.rig, context, plan(), into=PhotographSet("greys"))
    assert [int(shown["P1"][0, 0, 0]) for shown in stage.display.shown] == [10, 20, 30]
    assert not any(shown["P2"].any() for shown in stage.display.shown)
    assert paths[0] == context.folder / "greys.json"
    index = PhotographSet("greys").by_name(context.folder)
    assert list(index) == ["grey-0", "grey-1", "grey-2"]
    assert [taken.path for taken in index.values()] == paths[1:]
    assert all(path.suffix == ".raw" for path in paths[1:])


def test_nothing_is_taken_twice_and_the_confirmed_exposure_is_remembered(stage: ModelRig, context: Context) -> None:
    stage.camera.rounding = 1.01
    take_all(stage.rig, context, plan(), into=PhotographSet("greys"))
    first = PhotographSet("greys").by_name(context.folder)
    stage.camera.rounding = 1.5
    take_all(stage.rig, context, plan(), into=PhotographSet("greys"))
    assert stage.camera.taken == ["grey-0", "grey-1", "grey-2"]
    assert PhotographSet("greys").by_name(context.folder) == first
    assert {taken.exposure_s for taken in first.values()} == {0.505}


def test_another_frame_or_another_exposure_is_taken_again(stage: ModelRig, context: Context) -> None:
    take_all(stage.rig, context, plan(), into=PhotographSet("greys"))
    take_all(stage.rig, context, plan((10, 21, 30)), into=PhotographSet("greys"))
    assert stage.camera.taken[3:] == ["grey-1"]
    take_all(stage.rig, context, plan((10, 21, 30), exposure_s=1.0), into=PhotographSet("greys"))
    assert stage.camera.taken[4:] == ["grey-0", "grey-1", "grey-2"]


def test_a_damaged_or_missing_photograph_is_taken_again(stage: ModelRig, context: Context) -> None:
    paths = take_all(stage.rig, context, plan(), into=PhotographSet("greys"))
    paths[1].write_bytes(b"damaged")
    paths[3].unlink()
    take_all(stage.rig, context, plan(), into=PhotographSet("greys"))
    assert stage.camera.taken[3:] == ["grey-0", "grey-2"]


def test_photographs_without_a_lamps_light_are_forgotten_but_earlier_ones_are_kept(
    stage: ModelRig, context: Context
) -> None:
    take_all(stage.rig, context, plan()[:1], into=PhotographSet("greys", batch=0))
    stage.lamps["right"].go_dark()
    with pytest.raises(DeviceRefused, match="went off"):
        take_all(stage.rig, context, plan(), into=PhotographSet("greys"))
    assert not (context.folder / "greys.json").exists()
    left = [path for path in context.folder.rglob("*") if "grey-1" in path.name or "grey-2" in path.name]
    assert left == [], "also no note of a photograph that is gone"
    light_again(stage)
    take_all(stage.rig, context, plan(), into=PhotographSet("greys"))
    assert stage.camera.taken == ["grey-0", "grey-1", "grey-2", "grey-1", "grey-2"]


def test_a_lamp_that_dies_in_a_long_row_ends_it_and_costs_only_what_was_taken_since_it_was_looked_at(
    stage: ModelRig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(shots, "CHECK_LAMPS_EVERY_S", 0.0)

    def advance(fraction: float, note: str) -> None:
        if note == "grey-2":
            stage.lamps["right"].go_dark()

    with Journal(tmp_path / "run") as journal:
        context = Context(journal.folder, journal, in_seconds(60), Silent(), {}, advance)
        with pytest.raises(DeviceRefused, match="went off"):
            take_all(stage.rig, context, plan((10, 20, 30, 40, 50)), into=PhotographSet("greys"))
        light_again(stage)
        again = Context(journal.folder, journal, in_seconds(60), Silent(), {}, lambda fraction, note: None)
        take_all(stage.rig, again, plan((10, 20, 30, 40, 50)), into=PhotographSet("greys"))
    assert stage.camera.taken == ["grey-0", "grey-1", "grey-2", "grey-2", "grey-3", "grey-4"]


def test_lamps_are_not_asked_when_nothing_was_taken(stage: ModelRig, context: Context) -> None:
    take_all(stage.rig, context, plan(), into=PhotographSet("greys"))
    stage.lamps["right"].trouble = "gone"
    take_all(stage.rig, context, plan(), into=PhotographSet("greys"))


def test_a_stop_keeps_what_was_taken_so_far(stage: ModelRig, tmp_path: Path) -> None:
    cancel = threading.Event()

    def advance(fraction: float, note: str) -> None:
        if note == "grey-2":
            cancel.set()

    with Journal(tmp_path / "run") as journal:
        context = Context(journal.folder, journal, in_seconds(60, cancel), Silent(), {}, advance)
        with pytest.raises(Cancelled):
            take_all(stage.rig, context, plan(), into=PhotographSet("greys"))
        assert journal.shot_count() == 2
        again = Context(journal.folder, journal, in_seconds(60), Silent(), {}, lambda fraction, note: None)
        take_all(stage.rig, again, plan(), into=PhotographSet("greys"))
    assert stage.camera.taken == ["grey-0", "grey-1", "grey-2"]


def test_a_stop_forgets_what_was_taken_if_a_lamp_is_out_by_then(stage: ModelRig, tmp_path: Path) -> None:
    cancel = threading.Event()

    def advance(fraction: float, note: str) -> None:
        if note == "grey-1":
            stage.lamps["right"].go_dark()
        if note == "grey-2":  # somebody has seen it, and pressed Ctrl-C
            cancel.set()

    with Journal(tmp_path / "run") as journal:
        context = Context(journal.folder, journal, in_seconds(60, cancel), Silent(), {}, advance)
        with pytest.raises(Cancelled):
            take_all(stage.rig, context, plan(), into=PhotographSet("greys"))
        light_again(stage)
        again = Context(journal.folder, journal, in_seconds(60), Silent(), {}, lambda fraction, note: None)
        take_all(stage.rig, again, plan(), into=PhotographSet("greys"))
    assert stage.camera.taken == ["grey-0", "grey-1", "grey-0", "grey-1", "grey-2"]


def test_a_stop_just_before_the_lamps_are_looked_at_keeps_nothing_without_their_light(
    stage: ModelRig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cancel = threading.Event()
    answer, capture = Lamp.status, stage.camera.capture

    def answer_unless_stopped(lamp: Lamp, *, deadline: Deadline) -> ProjectorStatus:
        deadline.sleep(0.0)
        return answer(lamp, deadline=deadline)

    def capture_and_stop(destination: Path, *, deadline: Deadline) -> list[CapturedFile]:
        files = capture(destination, deadline=deadline)
        stage.lamps["right"].go_dark()
        cancel.set()
        return files

    monkeypatch.setattr(Lamp, "status", answer_unless_stopped)
    monkeypatch.setattr(stage.camera, "capture", capture_and_stop)
    with Journal(tmp_path / "run") as journal:
        context = Context(journal.folder, journal, in_seconds(60, cancel), Silent(), {}, lambda fraction, note: None)
        with pytest.raises(Cancelled):
            take_all(stage.rig, context, plan()[:1], into=PhotographSet("greys"))
        assert not list(journal.folder.rglob("*.raw"))


def test_a_camera_that_goes_leaves_the_photographs_before_it(stage: ModelRig, context: Context) -> None:
    take_all(stage.rig, context, plan()[:2], into=PhotographSet("greys", batch=0))
    stage.camera.fails = DeviceGone("camera-gone", what="Gone.", remedy="Come back.")
    with pytest.raises(DeviceGone):
        take_all(stage.rig, context, plan(), into=PhotographSet("greys"))
    assert context.journal.shot_count() == 2


def test_what_plays_is_photographed_once_for_each_thing_it_may_be(stage: ModelRig, context: Context) -> None:
    def photograph(bundle: str) -> TakenPhotograph:
        return take_photograph(stage.rig, context, ShotId("played", "vase"), 1.0, shown_at_s=0.0, of={"bundle": bundle})

    assert photograph("one").fresh
    again = photograph("one")
    assert not again.fresh
    assert photograph("two").fresh
    assert stage.camera.taken == ["vase", "vase"]


def test_ready_images_go_before_photographs_of_the_same_name() -> None:
    white = np.ones((2, 2, 3), np.float32)
    taken = {name: TakenPhotograph(name, Path(f"{name}.dng"), 1.0) for name in ("white", "red")}
    developed = Developed(taken, {"black": 0 * white, "white": white})
    assert list(developed) == ["black", "white", "red"]
    assert len(developed) == 3
    assert developed["white"] is white
