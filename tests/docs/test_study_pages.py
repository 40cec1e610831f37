"""What the pages of the study promise for every table, on the results that are kept."""

from __future__ import annotations

import pytest

from controller.optics.solve.result.metrics import TITLES
from docs.figures import ROOT, STUDY
from lab.study.catalogue import EXPERIMENTS
from lab.study.output.keeping import SEEDS, read_study
from lab.study.output.pages import DATA, up_to_date
from lab.study.values import Experiment

PRESENT = [
    one
    for one in EXPERIMENTS
    if (path := ROOT / STUDY / DATA / f"{one.name}.json").exists() and up_to_date(one, read_study(path))
]
"""Experiments whose results are of their present version."""


@pytest.mark.parametrize("one", PRESENT, ids=lambda one: one.name)
def test_a_table_of_errors_also_shows_the_whole_object_and_what_is_left_out(one: Experiment) -> None:
    kept = read_study(ROOT / STUDY / DATA / f"{one.name}.json")
    for table in kept.tables:
        if any("CIEDE2000" in column for column in table.columns):
            words = " ".join([*table.columns, *(str(cell) for row in table.rows for cell in row)])
            assert all(title in words for title in TITLES.values()), table.name
            assert "left out" in words or "leaves out" in words, table.name


@pytest.mark.parametrize("one", PRESENT, ids=lambda one: one.name)
def test_a_criterion_that_is_said_to_hold_does_so_for_enough_seeds(one: Experiment) -> None:
    kept = read_study(ROOT / STUDY / DATA / f"{one.name}.json")
    assert kept.criteria
    for criterion in kept.criteria:
        if criterion.holds:
            assert len(criterion.reached) >= SEEDS, criterion.asked
