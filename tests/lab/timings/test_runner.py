"""Rows, goals and the runner's table and file."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

import lab.timings
from lab.timings import Row, __main__, areas, at_least, at_most


def test_a_goal_is_judged_from_its_own_side() -> None:
    assert at_most("a", 2.0, 2.0, unit="s", how="").holds is True
    assert at_most("a", 2.1, 2.0, unit="s", how="").holds is False
    assert at_least("a", 1.9, 2.0, unit="x", how="").holds is False
    assert at_least("a", 1.9, None, unit="x", how="").holds is None


def test_every_module_is_an_area_of_its_own_name_but_those_that_others_share() -> None:
    modules = [file for file in Path(lab.timings.__file__).parent.rglob("*.py") if not file.stem.startswith("_")]
    found = areas()
    assert sorted(found) == sorted(file.stem for file in modules if file.parent.name != "tools")
    assert found["solve"] == "lab.timings.solving.solve"


def test_rows_are_printed_and_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    rows = [Row("speed", "MB/s", 10.0, 12.5, True, "one run"), Row("size", "B", None, 3.0, None, "")]
    monkeypatch.setattr("lab.timings.devices.projectors.measure", lambda size: rows)
    assert __main__.main(["projectors", "--json", str(tmp_path / "deep" / "rows.json")]) == 0
    assert "| speed | 12.5 MB/s | 10 MB/s | yes | one run |" in capsys.readouterr().out
    written = json.loads((tmp_path / "deep" / "rows.json").read_text())
    assert written[0] == {
        "figure": "speed", "unit": "MB/s", "goal": 10.0, "value": 12.5, "holds": True, "how": "one run"
    }  # fmt: skip
    assert written[1]["holds"] is None


def test_an_unknown_area_is_wrong_use() -> None:
    with pytest.raises(SystemExit) as ended:
        __main__.main(["nothing"])
    assert ended.value.code == 2


def test_the_first_call_is_not_timed() -> None:
    calls: list[int] = []
    timing = lab.timings.timed(lambda: calls.append(1), repeats=3)
    assert len(calls) == 4
    assert 0 <= timing.minimum <= timing.median <= timing.maximum
