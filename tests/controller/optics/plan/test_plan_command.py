"""``velatura plan`` from the example to a page."""

from __future__ import annotations

import json
import re
import shutil
import threading
from pathlib import Path

import pytest

from controller.core.errors import UsageError
from controller.stage.services.plan import plan, write_example
from tests.controller.run.listening import Listening


def test_the_example_with_a_mesh_becomes_a_page_and_figures(tmp_path: Path, ball: Path) -> None:
    file = tmp_path / "plan.toml"
    write_example(file)
    with pytest.raises(UsageError, match="already"):
        write_example(file)
    text = file.read_text().replace("object.obj", "ball.ply").replace("step_degrees = 10.0", "step_degrees = 20.0")
    text = re.sub(r"positions_m = .*", "positions_m = [[0.0, -0.2, -1.5]]", text)
    file.write_text(text + "points = 500\n")
    shutil.copy(ball, tmp_path / "ball.ply")
    told = Listening()
    result = plan(file=file, out=tmp_path / "out", reporter=told, cancel=threading.Event())
    fractions = [now.fraction for now in told.told]
    assert fractions == sorted(fractions)
    assert fractions[-1] == 1.0
    figures = json.loads(Path(result["figures"]).read_text())
    assert result["quality"] == pytest.approx(figures["quality"], abs=1e-3)
    assert len(figures["projectors"]) == 3
    assert 0.9 < figures["share_reached"] <= 1
    assert figures["share_overlapped"] <= figures["share_reached"]
    assert 0 < figures["wave_mm_all"] <= figures["wave_mm_one"]
    page = Path(result["plan"]).read_text()
    assert "Finest wave" in page
    assert "nothing is superimposed" not in page
    assert not re.search(r"https?:|<script|<link", page)
    assert page.count("data:image/") == 1 + 5
    assert all(one["place"] in page for one in (*figures["projectors"], *figures["cameras"]))
    assert len(figures["cameras"]) == 2
    assert f"{100 * figures['share_seen']:.0f} % of what is lit" in page


@pytest.mark.filterwarnings("error")
def test_a_sheet_that_one_place_of_the_audience_sees_edge_on_is_planned_and_that_place_says_so(tmp_path: Path) -> None:
    (tmp_path / "object.obj").write_text("v 0 0 0\nv 0 0 0.1\nv 0 0.3 0.1\nv 0 0.3 0\nf 1 2 3 4\n")
    file = tmp_path / "plan.toml"
    write_example(file)
    text = re.sub(r"positions_m = .*", "positions_m = [[0.0, 0.0, -1.5], [0.5, -0.2, -1.4]]", file.read_text())
    text = re.sub(r"(?s)\[\[cameras\]\].*(?=# Places that)", "", text)
    one_shelf = re.sub(r"(?s)\[shell\].*(?=\[goal\])", "", text.replace("count = 3", "count = 1"))
    one_shelf = re.sub(r"position_m = .*", "position_m = [0.6, -1.0, -1.2]", one_shelf)  # beside the sheet's plane
    file.write_text(one_shelf + "points = 100\n")
    result = plan(file=file, out=tmp_path, reporter=Listening(), cancel=threading.Event())
    page = Path(result["plan"]).read_text()
    assert page.count("no surface of it is visible") == 1
    assert "With one projector nothing is superimposed" in page
    assert page.count("data:image/") == 1 + 5
