"""The views of several cameras in one run: side by side, each in its own folder, and a fault of one is its own."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from controller.core.errors import CalibrationError
from controller.optics.capture.acquire import Acquirer
from controller.run.journal import Journal
from controller.run.progress import Progress
from controller.run.runner import Context, Runner, Step
from controller.run.step_id import StepId
from controller.stage.artefacts.photographs import PhotographSet
from controller.stage.artefacts.views import view_folders
from controller.stage.rig.rig import Rig, RigCamera
from controller.stage.rig.shared_display import SharedDisplay
from controller.stage.sessions.views import OtherViews
from controller.stage.steps.capture.photographs import Planned, take_all
from hal.deadline import in_seconds
from hal.errors import CodedError, DeviceGone
from hal.notices import Level
from tests.controller.stage.rig.rig_model import ModelCamera, ModelRig

TAKEN = PhotographSet("patterns")
GONE = DeviceGone("camera-gone", what="The camera is gone.", remedy="Plug it in.")


@dataclass
class Said:
    """Remembers what was said."""

    sentences: list[tuple[str, Level]] = field(default_factory=list)

    def progress(self, now: Progress) -> None:
        """Not looked at."""

    def say(self, text: str, level: Level = Level.INFO) -> None:
        self.sentences.append((text, level))

    @property
    def warnings(self) -> str:
        return " ".join(text for text, level in self.sentences if level is Level.WARNING)


class FailingCamera(ModelCamera):
    """Is pulled out after so many pictures."""

    def __init__(self, after: int) -> None:
        super().__init__()
        self.after = after

    def capture(self, destination: Path, *, deadline):  # type: ignore[no-untyped-def]
        if len(self.taken) >= self.after:
            raise GONE
        return super().capture(destination, deadline=deadline)


class Stage:
    """A stage of models with the cameras ``front`` and ``back``; each photographs with its own exposure."""

    def __init__(self, folder: Path, front: ModelCamera | None = None, back: ModelCamera | None = None) -> None:
        self.cameras = {"front": front or ModelCamera(), "back": back or ModelCamera()}
        self.model = ModelRig(folder)
        self.run_folder = folder / "runs" / "20261129-120000-calibrate"
        self.said = Said()
        shared = SharedDisplay(self.model.display)
        found = []
        for name, camera in self.cameras.items():
            seat = shared.seat()
            acquirer = Acquirer(self.model.display, camera, iso=100, aperture_f=None, settle_s=0.0, turns=seat)
            found.append(RigCamera(name, camera, acquirer, seat))
        first, back_view = found
        self.rig = replace(
            self.model.rig, camera=first.camera, acquirer=first.acquirer, view="front", seat=first.seat,
            others=(back_view,),
        )  # fmt: skip
        self.patterns = [1, 2, 3, 4]

    def steps(self, rig: Rig, folder: Path) -> Sequence[Step]:
        exposure_s = {"front": 0.5, "back": 1.0}[rig.view]

        def photograph(context: Context) -> Sequence[Path]:
            plan = [Planned(str(n), partial(self._frames, n), exposure_s) for n in self.patterns]
            return take_all(rig, context, plan, into=TAKEN)

        return [Step(StepId("patterns"), photograph)]

    def _frames(self, value: int) -> dict[str, np.ndarray]:
        return {"left": np.full((3, 4, 3), value, np.uint8)}

    def run(self, absent: dict[str, CodedError] | None = None, cancel: threading.Event | None = None) -> None:
        rig = self.rig if absent is None else replace(self.rig, others=(), absent=absent)
        deadline = in_seconds(60, cancel)
        with Journal(self.run_folder) as journal:
            others = OtherViews(rig, journal, "calibrate", self.steps, self.said, deadline)
            steps = others.around(self.steps(rig, self.run_folder))
            with others.ending():
                Runner(steps, journal, reporter=self.said).run("calibrate", deadline=deadline)

    @property
    def shown(self) -> list[int]:
        return [int(frames["P1"][0, 0, 0]) for frames in self.model.display.shown]

    def exposures(self, view: str) -> list[float]:
        return [taken.exposure_s for taken in TAKEN.read(view_folders(self.run_folder)[view])]


def test_each_pattern_is_shown_once_and_photographed_by_every_camera_with_its_own_exposure(tmp_path: Path) -> None:
    stage = Stage(tmp_path)
    stage.run()
    assert stage.shown == stage.patterns
    assert view_folders(stage.run_folder) == {"front": stage.run_folder, "back": stage.run_folder / "views" / "back"}
    assert stage.exposures("front") == [0.5] * 4
    assert stage.exposures("back") == [1.0] * 4


def test_a_camera_that_is_pulled_out_loses_only_its_own_view_and_is_named(tmp_path: Path) -> None:
    stage = Stage(tmp_path, back=FailingCamera(2))
    stage.run()
    assert list(view_folders(stage.run_folder)) == ["front"]
    assert stage.exposures("front") == [0.5] * 4
    assert "View back is not whole: The camera is gone. Plug it in." in stage.said.warnings
    assert "--view back" in stage.said.warnings
    with Journal(stage.run_folder) as journal:
        assert "view-not-whole" in [event.code for event in journal.events()]
    # Once it is back, only what is missing is photographed.
    stage.cameras["back"].after = 99  # type: ignore[attr-defined]
    taken = len(stage.cameras["front"].taken)
    stage.run()
    assert list(view_folders(stage.run_folder)) == ["front", "back"]
    assert len(stage.cameras["back"].taken) == 4
    assert len(stage.cameras["front"].taken) == taken


def test_a_camera_that_could_not_be_opened_is_named(tmp_path: Path) -> None:
    stage = Stage(tmp_path)
    stage.run(absent={"back": GONE})
    assert list(view_folders(stage.run_folder)) == ["front"]
    assert "View back is not whole" in stage.said.warnings


def test_if_the_first_camera_is_pulled_out_the_other_views_become_whole_before_its_error_is_raised(
    tmp_path: Path,
) -> None:
    stage = Stage(tmp_path, front=FailingCamera(1))
    with pytest.raises(DeviceGone, match="The camera is gone"):
        stage.run()
    assert stage.exposures("back") == [1.0] * 4
    assert "View front failed" in stage.said.warnings
    stage.cameras["front"].after = 99  # type: ignore[attr-defined]
    stage.run()
    assert stage.exposures("front") == [0.5] * 4
    assert len(stage.cameras["back"].taken) == 4


def test_a_lamp_that_went_off_ends_all_views(tmp_path: Path) -> None:
    stage = Stage(tmp_path)
    show = stage.model.display.show
    shown = 0

    def goes_off(frames, *, deadline):  # type: ignore[no-untyped-def]
        nonlocal shown
        shown += 1
        if shown == 3:
            stage.model.lamps["left"].go_dark()
        return show(frames, deadline=deadline)

    stage.model.display.show = goes_off  # type: ignore[method-assign]
    with pytest.raises(CodedError, match="went off") as error:
        stage.run()
    assert error.value.code == "lamp-went-off"
    assert "back" not in view_folders(stage.run_folder)


def test_a_stop_reaches_every_view(tmp_path: Path) -> None:
    stage, cancel = Stage(tmp_path), threading.Event()
    show = stage.model.display.show

    def stops(frames, *, deadline):  # type: ignore[no-untyped-def]
        cancel.set()
        return show(frames, deadline=deadline)

    stage.model.display.show = stops  # type: ignore[method-assign]
    with pytest.raises(CodedError) as error:
        stage.run(cancel=cancel)
    assert error.value.code == "cancelled"
    assert not [thread for thread in threading.enumerate() if thread.name == "velatura-view"]
    assert "back" not in view_folders(stage.run_folder)


@pytest.mark.parametrize(
    ("error", "told"),
    [
        (CalibrationError("projector-reaches-nothing", what="No pixel.", remedy="Look."), "No pixel."),
        (ZeroDivisionError("by zero"), "ZeroDivisionError: by zero."),
    ],
    ids=["refused", "fault"],
)
def test_a_view_whose_light_can_not_be_calibrated_is_not_whole_and_the_others_are(
    tmp_path: Path, error: Exception, told: str
) -> None:
    stage = Stage(tmp_path)
    steps = stage.steps

    def make(rig: Rig, folder: Path) -> Sequence[Step]:
        def refuse(context: Context) -> Sequence[Path]:
            if rig.view == "back":
                raise error
            return ()

        return [*steps(rig, folder), Step(StepId("pixels"), refuse, calculates=True)]

    stage.steps = make  # type: ignore[method-assign]
    stage.run()
    assert list(view_folders(stage.run_folder)) == ["front"]
    assert f"View back is not whole: {told}" in stage.said.warnings
