"""Refining on a stage of models whose true light is not the calibrated one: judged, kept, resumed, never worse."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from controller.config.defaults import SMOOTHNESS
from controller.core.arrays import FloatImage
from controller.core.errors import WorkError
from controller.optics.calibrate.values import Calibration
from controller.optics.capture.acquire import Acquirer
from controller.optics.capture.raw import develop
from controller.optics.solve.bounded.solver import solve_bounded
from controller.optics.solve.result.metrics import compare
from controller.optics.transport import build_transport
from controller.run.journal import Journal
from controller.run.progress import Silent
from controller.run.runner import Runner
from controller.stage.artefacts.calibrated import AllViews, Calibrated
from controller.stage.artefacts.solved import (
    Refining,
    RequestedTarget,
    Solved,
    read_refining,
    read_solved,
    remove_refined,
)
from controller.stage.artefacts.views import view_folder, view_folders, write_view
from controller.stage.report.page import refined_row
from controller.stage.rig.rig import RigCamera
from controller.stage.rig.shared_display import SharedDisplay
from controller.stage.steps.appearance import refining
from controller.stage.steps.appearance.refining import RefineOptions, refine_steps
from controller.stage.steps.appearance.solving import device_frames
from hal.deadline import Deadline, in_seconds
from hal.errors import DeviceGone
from hal.notices import Level
from hal.values import CapturedFile, FileKind
from plugins.emulated.optics.dng import PictureFacts, dng
from tests.controller.optics.solve.conftest import plane_calibration
from tests.controller.stage.rig.rig_model import ModelCamera, ModelDisplay, ModelRig

CAMERA, PROJECTOR = (72, 96), (24, 32)
NAMES, OUTPUTS = ("left", "right"), ("P1", "P2")
BLACK, WHITE = 256, 4095
RGGB = np.array([[0, 1], [1, 2]])
EXPOSURE = 1.4
BRIGHTNESS = 4.0
"""So that the model camera's exposures fit."""
NAME = "gold"

Light = Callable[[FloatImage], FloatImage]


def calibration() -> Calibration:
    plain = plane_calibration(projector=PROJECTOR, camera=CAMERA, spill=0.0)
    parts = [
        replace(part, name=name, white=BRIGHTNESS * part.white)
        for name, part in zip(NAMES, plain.projectors, strict=True)
    ]
    return replace(plain, projectors=tuple(parts), black=BRIGHTNESS * plain.black)


def target() -> FloatImage:
    y, x = np.mgrid[0 : CAMERA[0], 0 : CAMERA[1]].astype(np.float32)
    wave = 0.45 + 0.3 * np.sin(x / 9) * np.sin(y / 11)
    return np.asarray(EXPOSURE * wave[..., None] * np.array([1.0, 0.9, 0.8]), np.float32)


def indirect(light: FloatImage) -> FloatImage:
    return np.asarray(light + 0.05 * light.mean(axis=(0, 1)), np.float32)


def dark(light: FloatImage) -> FloatImage:
    return np.asarray(0.2 * light, np.float32)


def hand(light: FloatImage) -> FloatImage:
    spoiled = indirect(light)
    spoiled[30:46, 40:56] = EXPOSURE * np.array([0.4, 0.24, 0.18], np.float32)
    return spoiled


@dataclass
class SeeingCamera(ModelCamera):
    """Photographs, as RAW files, what the display shows; ``light`` for each photograph, the last one for all others."""

    display: ModelDisplay = field(default_factory=ModelDisplay)
    lights: list[Light] = field(default_factory=lambda: [indirect])
    gone_after: int | None = None

    def __post_init__(self) -> None:
        self.known = calibration()
        self.transport = build_transport(self.known)
        self.rng = np.random.default_rng(1)

    def seen(self, light: Light) -> FloatImage:
        shown = [self.display.shown[-1][output] for output in OUTPUTS]
        linear = [
            np.stack([part.radiometry.response[c][frame[..., c]] for c in range(3)], -1).astype(np.float32)
            for part, frame in zip(self.known.projectors, shown, strict=True)
        ]
        return np.asarray(light(self.transport.forward(linear)) + self.known.black, np.float32)

    def samples(self, light: Light, exposure_s: float, noise: float = 0.0) -> npt.NDArray[np.uint16]:
        seen, mosaic = self.seen(light) * exposure_s, np.empty(CAMERA)
        for row, column in np.ndindex(2, 2):
            mosaic[row::2, column::2] = seen[row::2, column::2, RGGB[row, column]]
        values = BLACK + (WHITE - BLACK) * mosaic + noise * self.rng.normal(0, 1, CAMERA)
        return np.clip(np.rint(values), 0, WHITE).astype(np.uint16)

    def capture(self, destination: Path, *, deadline: Deadline) -> list[CapturedFile]:
        if self.gone_after is not None and len(self.taken) >= self.gone_after:
            raise DeviceGone("camera-gone", what="The camera is gone.", remedy="Plug it in.")
        light = self.lights[min(len(self.taken) // 3, len(self.lights) - 1)]
        self.taken.append(destination.name)
        samples = self.samples(light, self.configured[-1].exposure_s, noise=1.5)
        facts = PictureFacts(self.configured[-1].exposure_s, 100, 8.0, 50.0, "2026:01:01 10:00:00", "1")
        data = dng(samples, black_level=BLACK, white_level=WHITE, facts=facts)
        destination.parent.mkdir(parents=True, exist_ok=True)
        path = destination.with_suffix(".dng")
        path.write_bytes(data)
        return [CapturedFile(path, FileKind.RAW, len(data), hashlib.sha256(data).hexdigest())]


class Known(Calibrated):
    def __init__(self, folder: Path) -> None:
        super().__init__(folder, NAMES)
        self._calibration = calibration()


@dataclass
class Told(Silent):
    said: list[str] = field(default_factory=list)

    def say(self, text: str, level: Level = Level.INFO) -> None:
        self.said.append(text)


@dataclass
class Stage:
    folder: Path
    told: Told = field(default_factory=Told)
    calibrated: Calibrated = field(init=False)
    second: SeeingCamera = field(init=False)

    def __post_init__(self) -> None:
        run = self.folder / "runs" / "20260101-100000-calibrate"
        run.mkdir(parents=True)
        self.calibrated = Known(run)
        self.display = ModelDisplay()
        self.camera = SeeingCamera(display=self.display)
        self.rig = ModelRig(self.folder, display=self.display, camera=self.camera).rig
        found = solve_bounded(self.calibrated.transport, target(), self.calibrated.calibration.black)
        reachable = np.zeros(CAMERA, np.bool_)
        reachable[5:-5, 5:-5] = True
        Solved(
            device_frames(self.calibrated.calibration, found.frames),
            dict(zip(NAMES, found.frames, strict=True)),
            target(),
            reachable,
            {"name": NAME, "title": "Gold", "exposure": EXPOSURE},
        ).write(run, NAME)
        self.solved = self.present()

    def present(self) -> Solved:
        return read_solved(self.calibrated.folder, NAME, NAMES)

    def refine(self, photographs: int, run: str = "20260102-100000-refine") -> Any:
        folder = self.folder / "runs" / run
        options = RefineOptions(photographs, SMOOTHNESS, 4.0)
        with Journal(folder) as journal:
            steps = refine_steps(self.rig, self.calibrated, {NAME: "Gold"}, options)
            Runner(steps, journal, reporter=self.told).run("refine", deadline=in_seconds(60))
        return read_refining(self.calibrated.folder, NAME)

    def error(
        self, solved: Solved | None = None, light: Light = indirect, asked: RequestedTarget | None = None
    ) -> float:
        """The median CIEDE2000 of frames, by the same camera without noise; ``asked``: against that, where in reach."""
        solved = self.present() if solved is None else solved
        self.display.shown.append({o: solved.frames[n] for o, n in zip(OUTPUTS, NAMES, strict=True)})
        matrix = self.calibrated.calibration.camera_to_xyz
        levels = np.full((2, 2), float(BLACK)), np.full((2, 2), float(WHITE))
        picture = develop(self.camera.samples(light, 0.5), RGGB, *levels).image / np.float32(0.5)
        aim, mask = (target(), solved.reachable) if asked is None else (asked.target, asked.reachable)
        return compare(picture, aim, matrix, EXPOSURE, mask).delta_e00_median


@pytest.fixture
def stage(tmp_path: Path) -> Stage:
    return Stage(tmp_path)


def same(a: Solved, b: Solved) -> bool:
    return all(np.array_equal(a.frames[name], b.frames[name]) for name in NAMES)


def test_one_photograph_corrects_the_frames_and_another_one_confirms_it(stage: Stage) -> None:
    before = stage.error()
    figures = stage.refine(1)
    assert len(stage.camera.taken) == 2 * 3, "twice the bracket, and its first exposure again"
    assert stage.error() < 0.4 * before
    assert figures["before"] == pytest.approx(before, rel=0.25)
    assert figures["after"] == pytest.approx(stage.error(), abs=0.3)
    assert stage.present().figures["refined"] == figures
    need, line = stage.told.said
    assert need.startswith("Refining gold needs about 0.3 GB of memory")
    assert line.startswith(f"Refined {NAME}: {figures['before']:.2f} to {figures['after']:.2f}")
    assert line.endswith("with 2 photographs.")


def test_it_corrects_towards_the_adapted_target_and_not_towards_what_was_out_of_reach(stage: Stage) -> None:
    reachable = np.zeros(CAMERA, np.bool_)
    reachable[8:-8, 8:30] = True
    requested = RequestedTarget(np.asarray(1.3 * target(), np.float32), reachable, np.ones(CAMERA, np.bool_))
    replace(stage.solved, asked=requested).write(stage.calibrated.folder, NAME)
    before = stage.error()
    of_request = stage.error(asked=requested)
    figures = stage.refine(2)
    assert stage.error() < 0.4 * before, "nearer to the adapted target"
    assert figures["before"] == pytest.approx(before, rel=0.25), "judged by it, too"
    np.testing.assert_array_equal(stage.present().requested.target, requested.target)
    assert figures["asked_before"] == pytest.approx(of_request, rel=0.1), "what was asked for is told, too"
    assert figures["asked_after"] == pytest.approx(stage.error(asked=requested), rel=0.1)
    told = f"{figures['asked_before']:.2f} to {figures['asked_after']:.2f} against what was asked for"
    assert any(told in line for line in stage.told.said)
    assert told in refined_row(figures)[0][1]


def test_it_stops_when_the_rest_is_noise_and_the_last_frames_were_photographed(stage: Stage) -> None:
    figures = stage.refine(5)
    photographs = len(stage.camera.taken) // 3
    assert 2 <= photographs < 5
    assert len(figures["photographs"]) == photographs
    assert figures["ended"] == "the rest is noise"
    medians = [row["delta_e00_mean"] for row in figures["photographs"]]
    assert medians[-1] < 0.5 * medians[0]


def test_a_correction_that_made_it_worse_is_taken_back(stage: Stage) -> None:
    stage.camera.lights = [indirect, lambda light: np.asarray(0.75 * light, np.float32)]
    figures = stage.refine(3)
    assert [row.get("kept") for row in figures["photographs"]] == [None, False]
    assert figures["ended"] == "the last correction was no better"
    assert figures["after"] == figures["before"]
    assert same(stage.present(), stage.solved)


def test_a_correction_that_no_photograph_confirms_is_taken_back(stage: Stage) -> None:
    stage.camera.lights = [indirect, dark]
    figures = stage.refine(1)
    assert figures["photographs"][1:] == [{"refused": "it is too dark"}]
    assert same(stage.present(), stage.solved)
    assert stage.told.said[-1] == f"{NAME} stays as it was: no photograph confirmed a correction (2 photographs)."


def test_light_that_passes_over_all_of_the_object_is_not_burnt_in(stage: Stage) -> None:
    """It is no outlier anywhere; the next photograph, without it, puts that right."""

    def plain(light: FloatImage) -> FloatImage:
        return light

    stage.camera.lights = [lambda light: np.asarray(light + 0.12, np.float32), plain]
    assert stage.refine(3)["photographs"][0]["delta_e00_median"] > 1
    assert stage.error(light=plain) <= stage.error(stage.solved, light=plain) + 0.02


def test_a_stage_that_is_as_calibrated_keeps_what_was_solved_or_as_good(stage: Stage) -> None:
    stage.camera.lights = [lambda light: light]
    before = stage.error(light=lambda light: light)
    stage.refine(3)
    assert stage.error(light=lambda light: light) <= before + 0.02


def test_a_hand_in_the_photograph_does_no_harm_and_the_rest_is_corrected(stage: Stage) -> None:
    before = stage.error()
    stage.camera.lights = [hand, indirect]
    figures = stage.refine(1)
    assert figures["photographs"][0]["left_out_share"] > 0.05
    assert stage.error() < 0.6 * before


def test_a_dark_photograph_is_not_used_and_said(stage: Stage) -> None:
    stage.camera.lights = [dark, indirect]
    figures = stage.refine(1)
    assert same(stage.present(), stage.solved)
    assert figures["photographs"] == [{"refused": "it is too dark"}]
    assert stage.told.said[1:] == [
        f"A photograph of {NAME} was not used: it is too dark.",
        f"{NAME} was not refined: no photograph could be used (1 photograph).",
    ]
    before = stage.error()
    stage.camera.taken.clear()
    assert len(stage.refine(2, "20260103-100000-refine")["photographs"]) == 3
    assert stage.error() < 0.4 * before


def test_what_does_not_fit_into_memory_is_refused_before_a_photograph(
    stage: Stage, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = stage.present()
    monkeypatch.setattr(refining, "free_bytes", lambda: 100_000_000)
    with pytest.raises(WorkError, match="Refining gold needs about") as refused:
        stage.refine(1)
    assert refused.value.code == "memory-too-small"
    assert stage.camera.taken == []
    for name in NAMES:
        np.testing.assert_array_equal(stage.present().frames[name], before.frames[name])


def test_a_camera_that_goes_away_costs_no_photograph_twice(stage: Stage) -> None:
    stage.camera.gone_after = 4
    with pytest.raises(DeviceGone):
        stage.refine(2)
    assert same(stage.present(), stage.solved), "nothing counts before the end"
    stage.camera.gone_after = None
    stage.refine(2)
    taken = len(stage.camera.taken)
    assert taken in (6, 9), "two or three photographs of three exposures"
    assert len(set(stage.camera.taken)) == taken
    shown = [frames[OUTPUTS[0]].tobytes() for frames in stage.display.shown]
    stage.refine(2)
    assert len(stage.camera.taken) == taken, "what is done is not repeated"
    assert len(stage.display.shown) == len(shown)


def test_a_second_refinement_begins_with_the_refined_frames(stage: Stage) -> None:
    first = stage.refine(1)
    second = stage.refine(1, "20260103-100000-refine")
    assert second["before"] == pytest.approx(first["after"], abs=0.3)
    remove_refined(stage.calibrated.folder, NAME)
    assert same(stage.present(), stage.solved)


def test_a_new_solving_is_not_shown_with_the_old_refined_frames(stage: Stage) -> None:
    stage.refine(1)
    replace(stage.solved, figures={**stage.solved.figures, "seconds": 2.0}).write(stage.calibrated.folder, NAME)
    assert same(stage.present(), stage.solved)
    assert read_refining(stage.calibrated.folder, NAME) is None


def test_what_a_round_leaves_is_read_as_it_was_written(tmp_path: Path) -> None:
    frames = {name: np.full((2, 3, 3), n, np.float32) for n, name in enumerate(NAMES)}
    error = np.full((4, 5), np.nan, np.float32)
    begun = Refining(frames, None, None)
    judged = Refining(frames, {name: frame + 1 for name, frame in frames.items()}, error, ({"a": 1.0},), "enough")
    for number, one in enumerate((begun, judged), 1):
        one.write(tmp_path, "a.b", number)
        read = Refining.read(tmp_path, "a.b", number, NAMES)
        assert (read.photographs, read.ended) == (one.photographs, one.ended)
        assert all(np.array_equal(read.frames[name], one.frames[name]) for name in NAMES)
        assert (read.best is None) == (one.best is None)
        if read.best is not None and one.best is not None and read.error is not None:
            assert all(np.array_equal(read.best[name], one.best[name]) for name in NAMES)
            assert np.array_equal(read.error, error, equal_nan=True)


UNITS = np.array([0.8, 1.25, 1.1], np.float32)
"""A second camera's light of each colour, in that of the first."""


class SecondCamera(SeeingCamera):
    """It photographs from another place, with other colours."""

    def seen(self, light: Light) -> FloatImage:
        return np.asarray(UNITS * super().seen(light), np.float32)


class TwoViews(AllViews):
    def __init__(self, run: Path) -> None:
        super().__init__(run, NAMES)
        for number, (name, folder) in enumerate((("front", run), ("side", view_folder(run, "side")))):
            folder.mkdir(parents=True, exist_ok=True)
            write_view(folder, name, number)
        self._views = [Known(folder) for folder in view_folders(run).values()]
        known = calibration()
        parts = tuple(replace(part, white=UNITS * part.white) for part in known.projectors)
        self._views[1]._calibration = replace(known, projectors=parts, black=UNITS * known.black)


@pytest.fixture
def two(tmp_path: Path) -> Stage:
    stage = Stage(tmp_path)
    calibrated = TwoViews(stage.calibrated.folder)
    stage.solved.seen(lambda image: image, calibrated.gains[1]).write(calibrated.folders[1], NAME)
    stage.calibrated = calibrated
    stage.second = SecondCamera(display=stage.display)
    acquirer = Acquirer(stage.display, stage.second, iso=100, aperture_f=None, settle_s=0.0)
    other = RigCamera("side", stage.second, acquirer, SharedDisplay(stage.display).seat())
    stage.rig = replace(stage.rig, others=(other,))
    return stage


def test_several_views_are_photographed_and_corrected_together(two: Stage) -> None:
    own = two.calibrated.folders[1]
    before = two.error()
    figures = two.refine(1)
    assert (len(two.camera.taken), len(two.second.taken)) == (6, 6)
    assert len(two.display.shown) == 3, "each picture is shown once for both, and once for this test"
    assert two.error() < 0.5 * before
    assert figures["photographs"][0]["left_out_share"] < 0.2
    assert read_refining(own, NAME) == figures
    assert same(read_solved(own, NAME, NAMES), two.present())
    np.testing.assert_allclose(read_solved(own, NAME, NAMES).target, UNITS * target(), rtol=0.03)


def test_what_only_another_view_sees_is_corrected_too(two: Stage) -> None:
    """Half of the first camera's picture can't be used: the second one knows what is there."""

    def half(light: FloatImage) -> FloatImage:
        spoiled = indirect(light)
        spoiled[:, 30:62] = EXPOSURE * np.array([0.4, 0.24, 0.18], np.float32)
        return spoiled

    two.camera.lights = [half]
    before = two.error()
    two.refine(1)
    reason = "something moved or stood in the picture"
    assert two.told.said[1] == f"A photograph of {NAME} from view front was not used: {reason}."
    assert two.error() < 0.7 * before


def test_a_view_whose_camera_fails_stays_and_is_named(two: Stage) -> None:
    before = two.error()
    two.second.gone_after = 0
    two.refine(1)
    assert two.told.said[1:3] == [f"A photograph of {NAME} from view side was not used: The camera is gone."] * 2
    assert two.error() < 0.7 * before
    two.rig = replace(two.rig, others=())
    two.refine(1, "20260103-100000-refine")
    assert f"A photograph of {NAME} from view side was not used: no camera stands there now." in two.told.said


def test_a_first_camera_that_fails_ends_the_refining(two: Stage) -> None:
    two.camera.gone_after = 0
    with pytest.raises(DeviceGone):
        two.refine(1)
