"""Where projectors stand, from poses that the test sets up itself; and one search of the buses for all who ask."""

from __future__ import annotations

import json
import math
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from controller.kiosk.api.finding import Examinations
from controller.kiosk.api.snapshot import places
from hal.notices import Notice
from tests.controller.kiosk.vase import graded_run, vase

OBJECT_M = np.array([0.02, -0.03, 1.3])
RUN = "20260101-100000-calibrate"


def pose(aside_deg: float, up_deg: float, far_m: float, shift_px: float) -> dict[str, object]:
    """A projector around the object that looks at it with the middle of its picture, its lens shifted."""
    turned = math.atan2(-OBJECT_M[0], OBJECT_M[2]) + math.radians(aside_deg)
    up = math.radians(up_deg)
    out = np.array([math.sin(turned) * math.cos(up), -math.sin(up), -math.cos(turned) * math.cos(up)])
    centre = OBJECT_M + far_m * out
    side = np.cross([0.0, 1.0, 0.0], -out)
    side /= np.linalg.norm(side)
    look = np.stack([side, np.cross(-out, side), -out])
    matrix = np.array([[1500.0, 0, 700], [0, 1500, 525 + shift_px], [0, 0, 1]])
    middle = np.linalg.solve(matrix, [700, 525, 1.0])
    # Turned so that the ray of the picture's middle, not the lens's axis, meets the object.
    tilt = math.atan2(middle[1], middle[2])
    rotation = np.array([[1, 0, 0], [0, math.cos(tilt), math.sin(tilt)], [0, -math.sin(tilt), math.cos(tilt)]]) @ look
    return {"matrix": matrix.tolist(), "distortion": [], "rotation": rotation.tolist(),
            "translation_m": (-rotation @ centre).tolist(), "size_px": [1400, 1050]}  # fmt: skip


def calibrated(stage: Path, projectors: dict[str, dict[str, object]]) -> Path:
    camera = {"matrix": [[4000, 0, 388], [0, 4000, 260], [0, 0, 1]], "size_px": [776, 520]}
    run = stage / "runs" / RUN
    if not run.is_dir():
        graded_run(vase(stage), RUN, {"left": 0.01})
    (run / "geometry.json").write_text(json.dumps({"camera": camera, "projectors": projectors}))
    return stage


@pytest.fixture(scope="module")
def stage(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("places") / "stage"


@given(
    st.lists(st.tuples(st.floats(-150, 150), st.floats(-30, 60), st.floats(0.6, 3), st.floats(0, 500)), min_size=1,
             max_size=5),
)  # fmt: skip
@settings(max_examples=40, deadline=None)
def test_each_stands_where_it_was_put(stage: Path, put: list[tuple[float, float, float, float]]) -> None:
    # One of them stands well aside: axes that are nearly parallel meet anywhere.
    put = [(40.0, 10.0, 1.0, 0.0), *put]
    found = places(calibrated(stage, {f"P{n}": pose(*one) for n, one in enumerate(put)}))
    assert [one.projector for one in found] == [f"P{n}" for n in range(len(put))]
    for one, (aside, up, *_) in zip(found, put, strict=True):
        assert abs((one.aside_deg - aside + 180) % 360 - 180) < 12
        assert abs(one.up_deg - up) < 12


@pytest.mark.parametrize(
    ("aside", "up", "word"),
    [(-30, 0, "left"), (40, 5, "right"), (0, 35, "above"), (3, -2, "in front"), (-35, 30, "left above"),
     (150, 0, "behind right")],
)  # fmt: skip
def test_a_place_has_a_word(tmp_path: Path, aside: float, up: float, word: str) -> None:
    found = places(
        calibrated(tmp_path / "stage", {"P1": pose(aside, up, 1.2, 300), "P2": pose(-aside + 30, up, 1.0, 0)})
    )
    assert found[0].word == word


def test_projectors_beside_the_camera_have_no_place_instead_of_a_wrong_one(tmp_path: Path) -> None:
    assert places(calibrated(tmp_path / "stage", {"P1": pose(0, 0, 1, 0), "P2": pose(1, 0, 2, 0)})) == ()


@pytest.mark.parametrize("text", ["", "{}", '{"projectors": {"P1": {}}}', '{"projectors": 7}', "[", "null"])
def test_what_can_not_be_read_is_no_place(tmp_path: Path, text: str) -> None:
    stage = calibrated(tmp_path / "stage", {"P1": pose(10, 10, 1, 0)})
    (stage / "runs" / RUN / "geometry.json").write_text(text)
    assert places(stage) == ()
    assert places(tmp_path) == ()


def test_who_asks_while_the_doctor_searches_gets_the_same_answer_and_takes_no_port() -> None:
    inside, most, searches = 0, 0, 0
    found = Notice.warning("", "Full.", "Clean.", about="disk")

    def search() -> list[Notice]:
        nonlocal inside, most, searches
        inside, searches = inside + 1, searches + 1
        most = max(most, inside)
        time.sleep(0.2)
        inside -= 1
        return [found]

    doctor, answers = Examinations(search), []
    threads = [threading.Thread(target=lambda: answers.append(doctor.findings())) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(10)
    assert (list(map(list, answers)), most) == ([[found]] * 4, 1)
    assert searches <= 2
    doctor.findings()
    assert searches <= 3, "a later question is a new search"
    assert searches >= 2
