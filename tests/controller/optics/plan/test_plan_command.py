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
    assert 0 < figures["wave_mm_all"] < 1.1 * figures["wave_mm_one"], "coarse projectors hardly cost the sharpest one"
    page = Path(result["plan"]).read_text()
    assert "Finest wave" in page
    assert not re.search(r"https?:|<script|<link", page)
    assert page.count("data:image/") == 1 + 5
    assert all(one["place"] in page for one in figures["projectors"])
