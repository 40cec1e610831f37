"""`velatura study` without devices: what it refuses, what it does without a stage, and the stage that it sets up."""

from __future__ import annotations

import threading
import tomllib
from pathlib import Path

import pytest

from controller.core.errors import UsageError
from controller.run.progress import Silent
from lab.study import catalogue
from lab.study import service as study_services
from lab.study.catalogue import SCENES
from lab.study.service import prepare_scene, study
from lab.study.values import Criterion, Experiment, Result, ResultTable


def run(out: Path, *names: str, size: str = "small") -> Path:
    told = study(names=names, size=size, out=out, pages=None, seeds=(3,), reporter=Silent(), cancel=threading.Event())
    return Path(told["index"])


def test_an_experiment_without_a_stage_is_done_and_gets_its_page(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def counted(subject: object) -> Result:
        assert subject is None
        return Result((Criterion("three", "3", True),), (ResultTable("t", "Counted", ("n",), ((3,),)),))

    toy = Experiment("toy", "A toy", "Beyond", "it counts.", None, counted)
    for module in (catalogue, study_services):
        monkeypatch.setattr(module, "EXPERIMENTS", (toy,))
    index = run(tmp_path)
    assert "[A toy](toy.md) | Beyond | 0 of 1 hold, 1 open | small |  | 3 |" in index.read_text()
    assert "size small; 0 s of work; seed 3" in (index.parent / "toy.md").read_text()


def test_unknown_names_and_sizes_are_refused_before_anything_is_written(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="no experiment called fig99"):
        run(tmp_path / "out", "fig99")
    with pytest.raises(UsageError, match="The size 'huge' is unknown"):
        run(tmp_path / "out", "residual", size="huge")
    assert not (tmp_path / "out").exists()


def test_a_scene_is_set_up_once_and_another_seed_is_refused(tmp_path: Path) -> None:
    scene = SCENES["curved"]
    stage = prepare_scene(tmp_path / "curved", scene, size="small", seed=3)
    tables = tomllib.loads((stage / "stage.toml").read_text())
    assert len(tables["projectors"]) == 3
    before = (stage / "bench.toml").read_bytes()
    assert prepare_scene(tmp_path / "curved", scene, size="small", seed=3) == stage
    assert (stage / "bench.toml").read_bytes() == before
    with pytest.raises(UsageError) as caught:
        prepare_scene(tmp_path / "curved", scene, size="small", seed=4)
    assert caught.value.code == "study-folder-taken"


def test_a_scene_of_six_projectors_has_six(tmp_path: Path) -> None:
    stage = prepare_scene(tmp_path / "six", SCENES["curved-six"], size="small", seed=3)
    tables = tomllib.loads((stage / "stage.toml").read_text())
    assert len(tables["projectors"]) == len(tables["display"]["outputs"]) == 6
