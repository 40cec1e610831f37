"""A calibrated stage is bumped, and Velatura says what has happened and repairs what it can."""

from __future__ import annotations

import contextlib
import json
import math
import shutil
import statistics
import struct
import subprocess
import sys
import threading
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest

from controller.core.errors import CalibrationError, UsageError
from controller.core.storage import runtime_path
from controller.run.journal import Journal
from controller.run.progress import Silent
from controller.stage.artefacts.grade import graded, read_grade_figures
from controller.stage.services.calibrate import AppearanceOrder, calibrate, make_appearances
from controller.stage.services.recalibrate import check_drift, recalibrate
from controller.stage.sessions.calibrations import finished_calibration
from controller.stage.sessions.session import OwnSession
from hal.codecs.player import LONGEST_HEAD_BYTES, parse_set
from hal.errors import ProtocolError
from lab.emulated.bumps import Bump, write_bumps
from plugins.emulated.core.truth import read_truth, write_truth
from tests.end_to_end.kiosk import copied, with_ports_of_its_own
from tests.end_to_end.program import REPOSITORY, Bench, Command

pytestmark = pytest.mark.long
LEFT = Bump("projector", "left", shift_px=(1.2, -0.7))


@dataclass(slots=True)
class Bumpy:
    """A calibrated stage whose bench follows ``bump``."""

    stage: Path
    bench: subprocess.Popen[str]
    first: Path

    def bump(self, *bumps: Bump) -> None:
        """On return they count."""
        write_bumps(self.stage, *bumps)
        self.until("bumps")

    def until(self, key: str) -> None:
        assert self.bench.stdout is not None
        assert any(key in json.loads(line) for line in self.bench.stdout), "the bench ended"

    def drift(self) -> dict[str, Any]:
        return dict(
            check_drift(session=OwnSession(self.stage), details=True, reporter=Silent(), cancel=threading.Event())
        )

    def recalibrate(self) -> Path:
        return Path(recalibrate(session=OwnSession(self.stage), reporter=Silent(), cancel=threading.Event())["run"])


@pytest.fixture(scope="module")
def bumpy(prepared_once: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bumpy]:
    out = shutil.copytree(prepared_once, tmp_path_factory.mktemp("bumpy") / "out")
    stage = with_ports_of_its_own(Path(out) / "stage")
    bench = subprocess.Popen(
        [sys.executable, "-m", "controller", "emulate", str(stage), "--json", "--until-input-ends"],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=REPOSITORY, start_new_session=True,
    )  # fmt: skip
    made = Bumpy(stage, bench, stage)
    try:
        made.until("ready")
        made.first = Path(calibrate(session=OwnSession(stage), reporter=Silent(), cancel=threading.Event())["run"])
        yield made
    finally:
        bench.communicate(timeout=20)


def photographed(run: Path) -> dict[str, float]:
    """Per cent between photograph and prediction of each projector, the photograph's noise included."""
    figures = read_grade_figures(run)
    return {name: 100 * math.hypot(row["relative_rms"], row["noise_rms"]) for name, row in figures.items()}


def test_each_bump_is_told_from_the_others_and_measured(bumpy: Bumpy) -> None:
    bumpy.bump(LEFT, Bump("projector", "above", dim=0.1, dim_channels=(0.0, 0.0, 0.1)))
    found = bumpy.drift()
    left, right, above = (found["projectors"][name] for name in ("left", "right", "above"))
    assert (found["culprit"], found["advice"], found["photographs"]) == (None, "quick", 5)
    assert left["shift_px"] == pytest.approx((1.2, -0.7), abs=0.06)
    assert above["gain"] == pytest.approx((0.9, 0.9, 0.81), abs=0.006)
    assert (left["moved"], left["dimmed"]) == (True, False)
    assert (above["moved"], above["dimmed"]) == (False, True)
    assert (right["moved"], right["dimmed"]) == (False, False)


def test_a_turned_projector_is_corrected_without_new_codes_as_well_as_it_was(bumpy: Bumpy) -> None:
    bumpy.bump(LEFT)
    run = bumpy.recalibrate()
    now, then = photographed(run), photographed(bumpy.first)
    for name, percent in now.items():
        assert percent < 1.2 * then[name], (now, then)
    with Journal(run) as journal:
        assert journal.shot_count() <= 5 + 3 + 4 + 3
    assert finished_calibration(bumpy.stage) == run
    assert (run / "verification.png").stat().st_size > 0


def test_one_projector_is_measured_anew_and_the_others_are_kept(bumpy: Bumpy) -> None:
    bumpy.bump(LEFT)
    last = finished_calibration(bumpy.stage)
    asked = recalibrate(session=OwnSession(bumpy.stage), projector="left", reporter=Silent(), cancel=threading.Event())
    run = Path(asked["run"])
    now, then = graded(run), graded(bumpy.first)
    assert now is not None
    assert then is not None
    assert all(percent < 1.2 * then[name] for name, percent in now.items()), (now, then)
    taken = {path.parent.name for path in (run / "captures").rglob("*.dng") if path.stat().st_nlink == 1}
    graded_by = {f"verification-photographs-{name}" for name in ("left", "right", "above")}
    assert taken == {"light-left", "codes-left", "black"} | graded_by, "of the others only the pattern of the grade"
    for name, kept in (("left", False), ("right", True), ("above", True)):
        assert (run / f"pixels-{name}.npz").samefile(last / f"pixels-{name}.npz") is kept
    assert finished_calibration(bumpy.stage) == run


@pytest.mark.parametrize(
    ("bump", "culprit"),
    [(Bump("camera", shift_px=(2.0, 1.0)), "camera"), (Bump("object", move_mm=(2.0, 0.0, 1.0)), "object")],
)
def test_camera_and_object_are_told_apart_and_ask_for_a_full_calibration(
    bumpy: Bumpy, bump: Bump, culprit: str
) -> None:
    # On top of what the last test left: it has been calibrated since.
    bumpy.bump(LEFT, bump)
    found = bumpy.drift()
    assert (found["culprit"], found["advice"]) == (culprit, "full")
    if culprit == "camera":
        assert found["camera"]["shift_px"] == pytest.approx((2.0, 1.0), abs=0.1)


@contextlib.contextmanager
def presented(files: Sequence[Path]) -> Iterator[list[dict[int, float]]]:
    """When each memory output presented each of its sets, read from its head as they come."""
    seen: list[dict[int, float]] = [{} for _ in files]
    ended = threading.Event()

    def look() -> None:
        while not ended.wait(0.01):
            for path, found in zip(files, seen, strict=True):
                with contextlib.suppress(OSError, ProtocolError, struct.error):
                    sequence, at_s = parse_set(path.read_bytes()[:LONGEST_HEAD_BYTES])
                    found.update({} if sequence % 2 else {sequence: at_s})

    looking = threading.Thread(target=look)
    looking.start()
    try:
        yield seen
    finally:
        ended.set()
        looking.join()


def test_the_camera_tells_how_far_apart_two_players_change(bumpy: Bumpy, tmp_path: Path) -> None:
    """Three projectors that overlap, on two screens with a player each; two of them are late on top of that."""
    before = sorted((bumpy.stage / "runs").iterdir())
    with pytest.raises(UsageError) as caught:
        check_drift(
            session=OwnSession(bumpy.stage), details=True, reporter=Silent(), cancel=threading.Event(), skew=True
        )
    assert caught.value.code == "skew-one-player"
    assert sorted((bumpy.stage / "runs").iterdir()) == before
    stage = copied(bumpy.stage, tmp_path / "stage")
    (stage / "bench" / "bumps.toml").unlink(missing_ok=True)
    (stage / "run").mkdir()
    settings = stage / "stage.toml"
    settings.write_text(settings.read_text().replace('name = "P2"\n', 'name = "P2"\nscreen = ":1"\n'))
    files = [runtime_path(stage) / f"screen-{number}" / "out.frame" for number in (0, 1)]
    truth, late_s = read_truth(stage), (0.0, 0.021, 0.008)
    projectors = tuple(
        replace(one, frames=str(files[one.output == "P2"]), late_s=late)
        for one, late in zip(truth.projectors, late_s, strict=True)
    )
    write_truth(stage, replace(truth, projectors=projectors, time_scale=1.0))
    with Bench(stage), presented(files) as seen:
        outcome = Command("drift", stage, "--skew").outcome()
    assert outcome.code == 0, outcome
    found = outcome.result["skew"]["outputs"]
    # The players' own times differ, too. What they presented together is next to each other; two sets end the run.
    here, there = (sorted(times.values()) for times in seen)
    players_s = statistics.mean(min((other - one for other in there), key=abs) for one in here[-10:-2])
    for name, true_s in (("P1", 0.0), ("P2", 0.021 + players_s), ("P3", 0.008)):
        row = found[name]
        assert abs(row["late_s"] - true_s) <= row["uncertain_s"] + 5e-4, (name, true_s, found)
    assert found["P3"]["uncertain_s"] < 1e-3, "of one player, without what makes players late"


def test_nothing_is_published_below_the_set_grade_unless_a_person_accepts_it(bumpy: Bumpy) -> None:
    settings = bumpy.stage / "stage.toml"
    before = settings.read_text()
    settings.write_text(before + "\n[calibration]\nworst_grade = 0.1\n")
    try:
        with pytest.raises(CalibrationError) as caught:
            make_appearances(
                AppearanceOrder(names=["checkerboard"]),
                session=OwnSession(bumpy.stage),
                reporter=Silent(),
                cancel=threading.Event(),
            )
        assert caught.value.code == "calibration-below-grade"
        assert "--accept-grade" in caught.value.remedy
        assert not (bumpy.stage / "bundles").exists()
    finally:
        settings.write_text(before)
