from __future__ import annotations

from itertools import combinations
from pathlib import Path

import pytest
from hypothesis import given, settings
from pydantic import ValidationError

from controller.config.models import ProjectorTable
from controller.stage.artefacts.kinds import OF_PROJECTORS, StepKind
from controller.stage.artefacts.names import safe_name, stem
from controller.stage.artefacts.photographs import PhotographSet, capture_name, captures_folder
from tests.controller.stage.artefacts.names import projectors

LONGEST_BESIDE = len("..12345678.part") + len("study-dots.000-.json")
"""What a half-written file has beside a projector's name, in bytes."""


@given(projectors)
def test_the_names_of_these_tests_are_legal(names: list[str]) -> None:
    for name in names:
        ProjectorTable(name=name, output="P1", driver="serial")
    with pytest.raises(ValidationError):
        ProjectorTable(name="a/b", output="P1", driver="serial")


@pytest.mark.parametrize("name", ["left", "top-left", "Mitte Süd", "v1.2", "epson-001", "“A” (new)", "日" * 64])
def test_ordinary_names_stand_in_files_as_they_are(name: str) -> None:
    assert safe_name(name) == name


@given(projectors)
def test_every_file_of_every_projector_has_a_name_of_its_own_that_a_disk_takes(names: list[str]) -> None:
    files = [f"{stem(kind)}.json" for kind in StepKind]
    for name in names:
        files += [f"{stem(kind, name)}.json" for kind in (*OF_PROJECTORS, "white")]
        files += [f"{stem(kind, name, part=part)}.json" for kind in OF_PROJECTORS for part in (0, 12)]
    assert len(set(files)) == len(files)
    for file in files:
        assert file.isprintable()
        assert not set(file) & set("/\\\0")
    assert all(len(safe_name(name).encode()) + LONGEST_BESIDE <= 255 for name in names)


def test_no_kind_of_a_projectors_step_begins_as_another_kind() -> None:
    for one, other in combinations([*StepKind, "white", "study"], 2):
        for short, long in ((one, other), (other, one)):
            assert not (short in OF_PROJECTORS and long.startswith(f"{short}-"))


@settings(max_examples=30)
@given(projectors)
def test_no_two_photographs_have_the_same_file(names: list[str]) -> None:
    kinds = [StepKind.LIGHT, StepKind.CODES, StepKind.DOTS, "white", StepKind.DRIFT_PHOTOGRAPHS]
    shots = [PhotographSet(kind, name).shot(shown) for kind in kinds for name in names for shown in ("white-0", "0")]
    shots += [PhotographSet(kind).shot(shown) for kind in kinds for shown in ("white-0", "0")]
    places = {captures_folder(Path("run"), shot) / capture_name(shot) for shot in shots}
    assert len(places) == len(set(shots)) == len(shots)


def test_a_name_that_is_too_long_is_cut_and_still_its_own() -> None:
    long = ["\U0001f526" * 63 + end for end in "ab"]
    assert len({safe_name(name) for name in long}) == 2
    assert all(len(safe_name(name).encode()) <= 200 for name in long)
