"""Photographs of what is installed: compared with the stored targets, resumed, stopped, and reported."""

from __future__ import annotations

import hashlib
import json
import re
import threading
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from controller.core.arrays import FloatImage, save_arrays
from controller.core.errors import UsageError
from controller.optics.capture.raw import SRGB_TO_XYZ
from controller.run.journal import Journal
from controller.run.progress import Progress, Silent
from controller.run.runner import Runner
from controller.stage.artefacts.calibrated import Calibrated
from controller.stage.artefacts.comparison import PICTURES, compared_in, history_of, pictures_of
from controller.stage.artefacts.solved import RequestedTarget, Solved, read_solved
from controller.stage.report.comparison import picture_steps, write_comparison_report
from controller.stage.steps.appearance.compare import compare_steps
from hal.deadline import Cancelled, Deadline, in_seconds
from hal.errors import DeviceGone
from hal.values import CapturedFile, FileKind, Presented
from plugins.emulated.optics.dng import PictureFacts, dng
from tests.controller.stage.rig.rig_model import ModelCamera, ModelDisplay, ModelRig

CAMERA = (64, 96)
NAMES = ("left", "right")
BLACK, WHITE = 256, 4095
SHOWN = {"gold": 1.0, "marble": 0.7}
"""What share of its target's light each appearance reaches."""
CALIBRATION = "20260101-100000-calibrate"
SIZE_PX = (6, 4)


def target() -> FloatImage:
    """Soft squares of 16 camera pixels, so that a Bayer sensor sees them as they are; white is 1 a second."""
    rows, columns = np.indices(CAMERA) // 16
    squares = np.where((rows + columns) % 2 == 0, 0.45, 0.1)
    return cv2.GaussianBlur(squares, (0, 0), 2.0)[..., None].repeat(3, axis=2).astype(np.float32)


@dataclass
class PlayingDisplay(ModelDisplay):
    """A player of whatever is asked for."""

    playing_now: str = ""
    played: list[str] = field(default_factory=list)

    def load_bundle(self, path: Path, *, deadline: Deadline) -> str:
        return "b" * 64

    def play(self, appearance: str, *, deadline: Deadline) -> Presented:
        self.playing_now = appearance
        self.played.append(appearance)
        return Presented(len(self.played), 0.0)

    def play_sequence(
        self, items: Any, *, deadline: Deadline, repeat: int = 0, rate_hz: float | None = None
    ) -> Presented:
        raise AssertionError("nobody asks for a sequence")

    def stop(self, *, deadline: Deadline) -> Presented:
        return Presented(0, 0.0)

    def live(self, file: Path, *, deadline: Deadline, white: float | None = None) -> None:
        raise AssertionError("nobody asks for it")

    def playing(self, *, deadline: Deadline) -> Any:
        raise AssertionError("nobody asks for it")


@dataclass
class SeeingCamera(ModelCamera):
    """Photographs, as RAW files, what the display plays; ``gone_after`` so many, ``reaches`` as ``SHOWN``."""

    display: PlayingDisplay = field(default_factory=PlayingDisplay)
    gone_after: int | None = None
    reaches: dict[str, float] = field(default_factory=lambda: SHOWN)

    def capture(self, destination: Path, *, deadline: Deadline) -> list[CapturedFile]:
        if self.gone_after is not None and len(self.taken) >= self.gone_after:
            raise DeviceGone("camera-gone", what="The camera is gone.", remedy="Plug it in.")
        self.taken.append(destination.name)
        light = target()[..., 1] * self.reaches[self.display.playing_now] * self.configured[-1].exposure_s
        mosaic = np.clip(np.rint(BLACK + light * (WHITE - BLACK)), 0, WHITE).astype(np.uint16)
        facts = PictureFacts(self.configured[-1].exposure_s, 100, 8.0, 50.0, "2026:01:01 10:00:00", "1")
        data = dng(mosaic, black_level=BLACK, white_level=WHITE, facts=facts)
        destination.parent.mkdir(parents=True, exist_ok=True)
        path = destination.with_suffix(".dng")
        path.write_bytes(data)
        return [CapturedFile(path, FileKind.RAW, len(data), hashlib.sha256(data).hexdigest())]


def calibrated_run(stage: Path, title: str = "In <b>gold</b>") -> Path:
    """A calibration of two projectors, the second of which lights the right half alone, with two solved appearances."""
    run = stage / "runs" / CALIBRATION
    run.mkdir(parents=True)
    for number, name in enumerate(NAMES):
        white = np.full((*CAMERA, 3), 0.6, np.float32)
        white[:, : number * CAMERA[1] // 2] = 0
        light = {"response": np.linspace(0, 1, 256)[None].repeat(3, axis=0), "mixing": np.eye(3),
                 "camera_to_xyz": SRGB_TO_XYZ, "white": white, "black": np.zeros_like(white)}  # fmt: skip
        save_arrays(run / f"radiometry-{name}.npz", light)
        rows = (SIZE_PX[1], SIZE_PX[0])
        save_arrays(run / f"pixels-{name}.npz", {
            "centre_px": np.zeros((*rows, 2), np.float32), "covariance_px2": np.ones((*rows, 3), np.float32),
            "valid": np.ones(rows, bool), "projector_px": np.zeros((*CAMERA, 2), np.float32),
            "modulation": np.ones(CAMERA, np.float32), "seen": np.ones(CAMERA, bool),
        })  # fmt: skip
    for name in SHOWN:
        reachable = np.ones(CAMERA, bool)
        reachable[:4] = False
        frames = {one: np.zeros((SIZE_PX[1], SIZE_PX[0], 3), np.uint8) for one in NAMES}
        figures: dict[str, object] = {"name": name, "title": title, "exposure": 1.0, "reachable_share": 0.94}
        linear = {one: frame.astype(np.float32) for one, frame in frames.items()}
        Solved(frames, linear, target(), reachable, figures).write(run, name)
    return run


@dataclass
class Stage:
    """A folder with a calibration, and the devices that photograph there."""

    folder: Path

    def __post_init__(self) -> None:
        self.calibrated = Calibrated(calibrated_run(self.folder), NAMES)
        self.display = PlayingDisplay()
        self.camera = SeeingCamera(display=self.display)
        self.rig = ModelRig(self.folder, display=self.display, camera=self.camera).rig

    def run(self, name: str, *, names: tuple[str, ...] = tuple(SHOWN), deadline: Deadline | None = None,
            reporter: Any = None) -> Path:  # fmt: skip
        folder = self.folder / "runs" / name
        steps = [
            *compare_steps(self.rig, self.calibrated, names, bundle="b", longest_exposure_s=4.0),
            *picture_steps(self.calibrated, names),
        ]
        with Journal(folder) as journal:
            Runner(steps, journal, reporter=reporter or Silent()).run("compare", deadline=deadline or in_seconds(60))
        return folder


@pytest.fixture
def stage(tmp_path: Path) -> Stage:
    return Stage(tmp_path)


FIRST, SECOND = "20260102-100000-compare", "20260103-100000-compare"


def test_each_appearance_is_judged_by_its_photograph_against_its_target(stage: Stage) -> None:
    run = stage.run(FIRST)
    found = {one.name: one for one in compared_in(run)}
    assert stage.display.played == list(SHOWN)
    gold, marble = found["gold"], found["marble"]
    assert gold.delta_e00_median < 1
    assert gold.sharpness_lambda > 0.75
    assert marble.delta_e00_median > 3
    assert marble.rmse == pytest.approx(0.3 * float(np.sqrt(np.square(target()[4:]).mean())), rel=0.05)
    assert (gold.calibration, gold.reachable_share) == (CALIBRATION, 0.94)
    for picture, file in pictures_of(stage.folder, marble).items():
        assert picture in PICTURES
        assert file.read_bytes()[:2] == b"\xff\xd8"
    assert len(pictures_of(stage.folder, marble)) == len(PICTURES)


def test_what_was_asked_for_counts_and_each_set_of_pixels_is_told(stage: Stage) -> None:
    solved = read_solved(stage.calibrated.folder, "gold", NAMES)
    requested = RequestedTarget(
        np.asarray(1.5 * solved.target, np.float32), solved.reachable.copy(), np.ones(CAMERA, np.bool_)
    )
    requested.reachable[:, : CAMERA[1] // 2] = False
    figures = solved.figures | {"held_back": 1.23}
    replace(solved, asked=requested, figures=figures).write(stage.calibrated.folder, "gold")
    run = stage.run(FIRST, names=("gold",))
    (gold,) = compared_in(run)
    assert gold.delta_e00_median > 3, "the photograph shows the adapted target"
    assert gold.adapted["delta_e00_median"] < 1
    in_reach, lit, visible = (gold.pixels[name] for name in ("in_reach", "lit", "visible"))
    assert in_reach["delta_e00_median"] == pytest.approx(gold.delta_e00_median, rel=1e-3)
    assert in_reach["left_out_share"] > 0.5 > lit["left_out_share"] >= visible["left_out_share"] == 0
    assert gold.ghosting["both"]["correlation"] < 0.05, "the object is plain"
    write_comparison_report(run, "stage")
    page = (run / "report.html").read_text()
    for title in ("in reach", "all lit pixels", "whole visible object", "adapted target"):
        assert f"{title}, median / 95 %" in page
    assert "could be 1.23 times as bright without the darkest 10% of the object" in page
    (row,) = json.loads((run / "report.json").read_text())["appearances"]
    assert (row["pixels"], row["adapted"], row["held_back"]) == (gold.pixels, gold.adapted, 1.23)


def test_a_camera_that_goes_away_costs_only_what_was_not_photographed(stage: Stage) -> None:
    stage.camera.gone_after = 3
    with pytest.raises(DeviceGone):
        stage.run(FIRST)
    assert [one.name for one in compared_in(stage.folder / "runs" / FIRST)] == ["gold"]
    stage.camera.gone_after = None
    run = stage.run(FIRST)
    assert stage.display.played == ["gold", "marble", "marble"]
    assert len(stage.camera.taken) == 4, "no photograph was taken twice"
    assert [one.name for one in compared_in(run)] == ["gold", "marble"]


def test_it_stops_between_two_appearances_when_it_is_cancelled(stage: Stage) -> None:
    cancel = threading.Event()

    class Impatient(Silent):
        def progress(self, now: Progress) -> None:
            if now.step == "Photographing marble":
                cancel.set()

    with pytest.raises(Cancelled):
        stage.run(FIRST, deadline=in_seconds(60, cancel), reporter=Impatient())
    assert [one.name for one in compared_in(stage.folder / "runs" / FIRST)] == ["gold"]


def test_the_report_shows_the_pictures_and_how_it_was_before(stage: Stage) -> None:
    stage.run(FIRST)
    write_comparison_report(stage.folder / "runs" / FIRST, "A <script>stage</script>")
    stage.camera.reaches = SHOWN | {"gold": 0.7}
    run = stage.run(SECOND, names=("gold",))
    page = write_comparison_report(run, "A <script>stage</script>").read_text()
    assert "<script" not in page
    assert "<b>gold" not in page
    sources = re.findall(r'<img src="([^"]*)"', page)
    assert len(sources) == len(PICTURES) + 2, "the pictures, the scale of the error maps, the course"
    assert all(source.startswith("data:image/") for source in sources)
    for caption in ("Before", "Target", "Achieved", "Error", "Resolution"):
        assert f"<figcaption>{caption} " in page
    (now,) = json.loads((run / "report.json").read_text())["appearances"]
    before = history_of(stage.folder, ["gold"])["gold"][0]
    assert f"{now['delta_e00_median'] - before.delta_e00_median:+.2f}" in page
    assert f"{before.delta_e00_median:.2f}, {before.delta_e00_p95:.2f}; {before.sharpness_lambda:.2f}" in page
    first = (stage.folder / "runs" / FIRST / "report.html").read_text()
    assert "nothing to compare" in first


def test_the_history_is_in_order_and_survives_a_damaged_file(stage: Stage) -> None:
    for run in (FIRST, SECOND):
        stage.run(run)
    (stage.folder / "runs" / FIRST / "compared-marble.json").write_text("{")
    found = history_of(stage.folder, ["marble", "gold", "nothing"])
    assert list(found) == ["marble", "gold"]
    assert [one.run for one in found["gold"]] == [FIRST, SECOND]
    assert [one.run for one in found["marble"]] == [SECOND]


def test_a_run_without_photographs_has_no_report(tmp_path: Path) -> None:
    with pytest.raises(UsageError) as refused:
        write_comparison_report(tmp_path, "stage")
    assert refused.value.code == "run-not-compared"
