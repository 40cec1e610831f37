"""The report of one calibration, from a run folder that is written here."""

from __future__ import annotations

import json
import re
import time
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from controller.bundle.describe import png
from controller.core.arrays import save_arrays
from controller.core.errors import CalibrationError, TroubleCode, UsageError
from controller.optics.calibrate.geometry.shape import FoundShape
from controller.run.journal import Journal
from controller.run.step_id import StepId
from controller.stage.artefacts.calibration import read_calibration
from controller.stage.artefacts.geometry import write_geometry
from controller.stage.artefacts.grade import ErrorMaps, write_grade, write_troubles
from controller.stage.artefacts.projectors import Light, PixelFigures, write_radiometry_figures
from controller.stage.report import plots
from controller.stage.report.calibration import (
    OUTLINE,
    StageDescription,
    resolution_px,
    size_px,
    write_calibration_report,
)
from hal.notices import Notice

NAMES = ("left", "<b>right</b>")
ASKED = StageDescription("A <script>stage</script>", NAMES, 8.0)
CAMERA = (40, 60)
PROJECTOR = (12, 16)
BLUE = "Blue is <i>off</i>. Run `velatura drift`."
APART = ((0.3, 0.4), (0.0, 0.0), (0.0, -0.25))


def write_run(runs: Path, name: str, errors: tuple[float, float]) -> Path:
    """A run of two projectors: the second lights the right half of the camera's picture only, and half as finely."""
    run = runs / name
    with Journal(run) as journal:
        journal.complete(StepId("verify"), {}, (), began_at_s=time.time())
    verification: dict[str, Any] = {}
    maps = {}
    for number, projector in enumerate(NAMES):
        white = np.full((*CAMERA, 3), 0.5, np.float32)
        if number == 1:
            white[:, : CAMERA[1] // 2] = 0
        black = np.full((*CAMERA, 3), 0.001, np.float32)
        response = np.linspace(0, 1, 256)[None].repeat(3, axis=0) ** 2.2
        Light(response, np.eye(3), white, black, np.eye(3)).write(run, projector)
        write_radiometry_figures(run, projector, {})
        rows, columns = np.indices(PROJECTOR)
        centre = np.stack([columns * CAMERA[1] / PROJECTOR[1], rows * CAMERA[0] / PROJECTOR[0]], axis=-1)
        covariance = np.broadcast_to(np.array([1.0, 0.0, 1.0]) * (1 + 3 * number), (*PROJECTOR, 3))
        save_arrays(
            run / f"pixels-{projector}.npz",
            {
                "centre_px": centre.astype(np.float32), "covariance_px2": covariance.astype(np.float32),
                "valid": np.ones(PROJECTOR, bool), "projector_px": np.zeros((*CAMERA, 2), np.float32),
                "modulation": np.ones(CAMERA, np.float32), "seen": np.ones(CAMERA, bool),
            },
        )  # fmt: skip
        PixelFigures(192, 192, 2400, APART if number == 0 else None).write(run, projector)
        why = [{"reason": "moved", "error_share": 0.5, "area_share": 0.1, "sentence": "It <i>moved</i>."}]
        verification[projector] = {"relative_rms": errors[number] / 100, "grade": "A", "reasons": why}
        maps[projector] = ErrorMaps(np.full(CAMERA, errors[number] / 100, np.float32), np.zeros(CAMERA, np.uint8))
    write_grade(run, verification, maps, png(np.zeros((2 * CAMERA[0], CAMERA[1], 3), np.uint8)))
    points = np.dstack([np.zeros(CAMERA), np.zeros(CAMERA), np.ones(CAMERA)]).astype(np.float32)
    save_arrays(run / "geometry.npz", {"points_m": points, "normals": points})
    (run / "geometry.json").write_text(json.dumps({"reprojection_rms_px": 0.025}))
    return run


class Seen(HTMLParser):
    """Every tag with its attributes, and the text."""

    def __init__(self) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.text = ""

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))

    def handle_data(self, data: str) -> None:
        self.text += f" {data}"


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    runs = tmp_path_factory.mktemp("stage") / "runs"
    write_run(runs, "20260101-100000-calibrate", (2.0, 3.0))
    write_run(runs, "20260102-100000-quick", (2.5, 3.5))
    made = write_run(runs, "20260103-100000-calibrate", (9.0, 4.0))
    write_run(runs, "20260104-100000-calibrate", (1.0, 1.0))
    write_troubles(made, StepId("pixels", "left"), [Notice.warning(TroubleCode.PANEL_ALIGNMENT, BLUE, about="left")])
    write_calibration_report(made, ASKED)
    return made


def test_the_picture_before_shows_what_counts_as_the_object(run: Path) -> None:
    picture = cv2.imread(str(run / "before.png"))
    assert picture is not None
    line = np.abs(picture[..., ::-1].astype(int) - OUTLINE).max(axis=2) < 40
    assert 0 < line.mean() < 0.2


def test_the_page_is_one_file_that_loads_nothing_and_believes_nobody(run: Path) -> None:
    seen = Seen()
    seen.feed((run / "report.html").read_text())
    assert "script" not in [tag for tag, _ in seen.tags]
    assert not [tag for tag, _ in seen.tags if tag in ("b", "i")][4:], "only the page's own, one a goal"
    sources = [attributes["src"] for tag, attributes in seen.tags if tag == "img"]
    assert len(sources) >= 1 + 4 + 2 + 2 + 4
    assert all(source is not None and source.startswith("data:image/") for source in sources)
    assert all(attributes.get("alt") for tag, attributes in seen.tags if tag == "img")


def test_it_is_compared_with_those_before_it_and_not_with_those_after(run: Path) -> None:
    seen = Seen()
    seen.feed((run / "report.html").read_text())
    text = re.sub(r"\s+", " ", seen.text)
    assert "3 Jan 2026, 10:00 (this one) 2 Jan 2026, 10:00 1 Jan 2026, 10:00" in text
    assert "error of left 9.00 % 2.50 % 2.00 %" in text
    assert "4 Jan 2026" not in text
    assert not re.search("[0-9]{8}-[0-9]{6}", text), "names of runs are for programs"
    assert "at most 8 %, not reached" in text
    assert "What the calibration found Blue is <i>off</i>. Run velatura drift" in text
    assert "Colours beside green, corrected, in pixels: left red 0.50, blue 0.25." in text


def test_the_figures_are_for_machines_and_the_pictures_for_the_panel(run: Path) -> None:
    figures = json.loads((run / "report.json").read_text())
    assert figures["verification"]["left"]["relative_rms"] == 0.09
    assert figures["metapixels"] == {"left": 192, "<b>right</b>": 192}
    assert figures["colours_px"] == {"left": [list(place) for place in APART], "<b>right</b>": None}
    assert figures["geometry"]["reprojection_rms_px"] == 0.025
    assert figures["troubles"] == [{"sentence": BLUE, "projector": "left", "code": "panel-alignment"}]
    for name in ("before.png", "resolution.png"):
        picture = cv2.imread(str(run / name))
        assert picture is not None
        assert picture.std() > 5, "not one plain colour"


def test_the_finest_projector_gives_the_resolution(run: Path) -> None:
    found = resolution_px(read_calibration(run, NAMES))
    assert np.nanmedian(found) == pytest.approx(1.0, abs=0.02)
    assert float(size_px(np.array([4.0, 0.0, 9.0], np.float32))) == pytest.approx(6**0.5)


def test_a_report_says_why_there_is_no_shape_and_shows_no_depth(tmp_path: Path) -> None:
    made = write_run(tmp_path / "runs", "20260103-100000-calibrate", (2.0, 3.0))
    why = CalibrationError("scene-flat", what="The scene is flat.", remedy="Add depth.")
    write_geometry(made, NAMES, FoundShape("unknown", CAMERA[::-1], why=why))
    seen = Seen()
    seen.feed(write_calibration_report(made, ASKED).read_text())
    text = re.sub(r"\s+", " ", seen.text)
    assert "Shape unknown" in text
    assert "The scene is flat. Add depth." in text
    assert "metres from the camera" not in text
    figures = json.loads((made / "report.json").read_text())
    assert figures["shape"]["code"] == "scene-flat"
    assert figures["geometry"]["reprojection_rms_px"] is None


def test_a_run_without_a_grade_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError) as caught:
        write_calibration_report(tmp_path, ASKED)
    assert caught.value.code == "run-not-graded"


def test_a_map_leaves_dark_what_is_not_known() -> None:
    values = np.full((30, 40), np.nan, np.float32)
    nothing = plots.field(values + 0.0, "metres", least=0, most=1)
    values[:, 20:] = 1.0
    half = plots.field(values, "metres", least=0, most=1)
    changed = np.abs(half.astype(int) - nothing).sum(axis=2) > 60
    columns = np.flatnonzero(changed.any(axis=0))
    assert changed.mean() > 0.1
    assert columns[0] > half.shape[1] * 0.3, "the left half is as it was"
