"""Stages with a fault that no part of the model describes: what a calibration says of it."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import threading
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from controller.core.arrays import ByteImage
from controller.core.errors import CalibrationError, TroubleCode
from controller.optics.calibrate.verify.aim import assess_aim, checkerboard
from controller.run.progress import Progress, Silent
from controller.stage.artefacts.grade import read_grade_figures, read_troubles
from controller.stage.services.calibrate import calibrate
from controller.stage.sessions.session import OwnSession
from lab.emulated.bumps import Bump, write_bumps
from lab.timings.tools.truth import Truth
from plugins.emulated.core.truth import BUMPS_FILE
from tests.campaigns.mini_stage import prepare_mini
from tests.end_to_end.kiosk import with_ports_of_its_own
from tests.end_to_end.program import REPOSITORY

pytestmark = pytest.mark.long
METAL = Bump("object", metal=0.2)
DENT = Bump("projector", "left", dent=0.15)
KNOCK = Bump("projector", "left", shift_px=(1.0, 0.7))
Y_PATTERN = "blur-y-0"
"""The fine stripes along y come after those along x."""


@dataclass(slots=True)
class Faulty:
    """A stage of two projectors whose bench follows ``bump``."""

    stage: Path
    bench: subprocess.Popen[str]

    def bump(self, *bumps: Bump) -> None:
        """On return these count, and no earlier one does."""
        if bumps or (self.stage / BUMPS_FILE).exists():
            write_bumps(self.stage, *bumps)
            self.until("bumps")

    def until(self, key: str) -> None:
        assert self.bench.stdout is not None
        assert any(key in json.loads(line) for line in self.bench.stdout), "the bench ended"

    def calibrated(self, reporter: Silent | None = None) -> Path:
        shutil.rmtree(self.stage / "runs", ignore_errors=True)  # one that ended in an error would be continued
        session, cancel = OwnSession(self.stage), threading.Event()
        found = calibrate(session=session, reporter=reporter or Silent(), cancel=cancel, accept_grade=True)
        return Path(found["run"])


class At(Silent):
    """Bumps the stage before a photograph is taken."""

    def __init__(self, faulty: Faulty, photograph: str, bump: Bump) -> None:
        self._faulty, self._photograph, self._bump = faulty, photograph, bump

    def progress(self, now: Progress) -> None:
        if now.note == self._photograph:
            self._faulty.bump(self._bump)
            self._photograph = ""


@pytest.fixture(scope="module")
def faulty(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Faulty]:
    stage = with_ports_of_its_own(prepare_mini(tmp_path_factory.mktemp("faulty")))
    bench = subprocess.Popen(
        [sys.executable, "-m", "controller", "emulate", str(stage), "--json", "--until-input-ends"],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=REPOSITORY, start_new_session=True,
    )  # fmt: skip
    made = Faulty(stage, bench)
    try:
        made.until("ready")
        yield made
    finally:
        bench.communicate(timeout=20)


def first_reason(run: Path, projector: str) -> tuple[str, float, str]:
    """The reason that carries most of a projector's error: name, share of the error, sentence."""
    reasons = read_grade_figures(run)[projector]["reasons"]
    one = max(reasons, key=lambda row: float(row["error_share"]))
    return one["reason"], one["error_share"], one["sentence"]


def test_metal_is_named_where_it_carries_most_of_the_error(faulty: Faulty) -> None:
    faulty.bump(METAL)
    run = faulty.calibrated()
    for projector in ("left", "right"):
        _, share, sentence = first_reason(run, projector)
        assert share > 0.5
        assert "make polished metal matt" in sentence
        assert " top " in sentence


def test_a_dent_in_the_response_asks_for_another_picture_mode(faulty: Faulty) -> None:
    faulty.bump(DENT)
    said = {(trouble.code, trouble.about): trouble.what for trouble in read_troubles(faulty.calibrated())}
    assert "choose another picture mode" in said[TroubleCode.UNSTEADY_LAMP, "left"]
    assert (TroubleCode.UNSTEADY_LAMP, "right") not in said


def test_a_projector_knocked_between_its_stripes_along_x_and_y_is_refused(faulty: Faulty) -> None:
    faulty.bump()
    with pytest.raises(CalibrationError) as refused:
        faulty.calibrated(At(faulty, Y_PATTERN, KNOCK))
    assert refused.value.code == "captures-inconsistent"
    assert "Check that nothing moves" in str(refused.value)


def test_a_camera_out_of_focus_looks_less_sharp_than_projectors_can_be(tmp_path: Path) -> None:
    stage = prepare_mini(tmp_path)
    sharp = camera_focus(stage)
    write_bumps(stage, Bump("camera", blur_px=3.0))
    assert sharp > 0.95
    assert camera_focus(stage) < 0.75


def camera_focus(stage: Path) -> float:
    """As ``velatura kiosk aim`` tells it, without noise."""
    truth = Truth(stage, bumps=True)
    sizes = [one.lens.size_px for one in truth.bench.projectors]
    dark = [np.zeros((*size[::-1], 3), np.uint8) for size in sizes]

    def board(n: int, *, inverse: bool) -> Sequence[ByteImage]:
        return [*dark[:n], checkerboard(sizes[n], inverse=inverse), *dark[n + 1 :]]

    boards = [
        (truth.picture(board(n, inverse=False)), truth.picture(board(n, inverse=True))) for n in range(len(sizes))
    ]
    return assess_aim(truth.picture(dark), boards).camera_focus
