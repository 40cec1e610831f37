"""What steps found is said once, kept by step, and forgotten when the step finds nothing any more."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, cast

from controller.core.errors import TroubleCode
from controller.run.step_id import StepId
from controller.stage.artefacts.grade import read_troubles, write_troubles
from controller.stage.artefacts.kinds import StepKind
from controller.stage.steps.troubles import tell
from hal.notices import Level, Notice

if TYPE_CHECKING:
    from controller.run.runner import Context


class Said:
    def __init__(self) -> None:
        self.all: list[tuple[str, Level]] = []

    def say(self, text: str, level: Level = Level.INFO) -> None:
        self.all.append((text, level))


def context(folder: Path) -> tuple[Context, Said]:
    said = Said()
    return cast("Context", SimpleNamespace(folder=folder, reporter=said)), said


def test_troubles_of_all_steps_are_read_back(tmp_path: Path) -> None:
    camera, left = StepId(StepKind.CAMERA), StepId(StepKind.PIXELS, "left")
    now, said = context(tmp_path)
    hot, panels, fringes = TroubleCode.HOT_PIXELS, TroubleCode.PANEL_ALIGNMENT, TroubleCode.COLOUR_FRINGES
    found = {TroubleCode.PAINT_COLOURS: None, panels: "Bent.", fringes: "Blue."}
    paths = {tell(now, camera, {hot: "Hot."}), tell(now, left, found)}
    assert all(path.parent == tmp_path for path in paths)
    assert len(paths) == 2
    assert said.all == [("Hot.", Level.WARNING), ("Bent.", Level.WARNING), ("Blue.", Level.WARNING)]
    wanted = [
        Notice.warning(hot, "Hot."),
        Notice.warning(panels, "Bent.", about="left"),
        Notice.warning(fringes, "Blue.", about="left"),
    ]
    assert read_troubles(tmp_path) == wanted


def test_a_step_that_finds_nothing_forgets_what_it_found_before(tmp_path: Path) -> None:
    now, said = context(tmp_path)
    path = tell(now, StepId(StepKind.CAMERA), {TroubleCode.HOT_PIXELS: "Hot."})
    assert tell(now, StepId(StepKind.CAMERA), {TroubleCode.HOT_PIXELS: None}) == path
    assert json.loads(path.read_text()) == []
    assert read_troubles(tmp_path) == []
    assert len(said.all) == 1


def test_runs_of_earlier_versions_have_none(tmp_path: Path) -> None:
    assert read_troubles(tmp_path) == []


def test_what_an_earlier_version_found_has_no_code(tmp_path: Path) -> None:
    (tmp_path / "troubles-camera.json").write_text('[{"sentence": "Hot.", "projector": null}]')
    assert read_troubles(tmp_path) == [Notice.warning("", "Hot.")]


def test_projectors_whose_names_differ_keep_their_own(tmp_path: Path) -> None:
    for name in ("a", "A", "a b", "a%20b", "ä"):
        write_troubles(tmp_path, StepId(StepKind.PIXELS, name), [Notice.warning("", f"of {name}", about=name)])
    assert {trouble.about for trouble in read_troubles(tmp_path)} == {"a", "A", "a b", "a%20b", "ä"}
