"""The table of times: where its figures come from, and what is judged."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import cast

import pytest

from controller.run.step_id import StepId
from lab.study.experiments.times import experiment
from lab.study.experiments.times.experiment import APPEARANCE, BASE, FULL, STAGES, TRANSPORT, Durations, times
from lab.study.experiments.times.quoted import Quote, quoted, seconds_in
from lab.study.subject.subject import SessionParts, Subject
from lab.study.values import column
from tests.lab.study.array_stage import array_subject

PAGE = """\
# Timings and precision

## calibration
| figure | value | goal |
|---|---|---|
| decoding, a projector | 9 s | |

### paper size
| figure | value | goal |
|---|---|---|
| decoding, a projector | 2.5 s | 5 s |
| metapixels and phase map, a projector | 3.25 s | 8 s |
| geometry, N = 3 | 700 s | 60 s |

## solve
| figure | small | paper |
|---|---|---|
| base image `white` | 1 s | not yet measured |

words between

| figure | small | paper |
|---|---|---|
| base image `minimum` | | 20 sweeps, 90 s whole (goal 15 s) |

## live
| figure | small | paper | goal |
|---|---|---|---|
| new appearance, float picture in memory to 8-bit frames, by the clock | 12 ms | 264 ms | 100 ms |
"""
STEPS = {
    StepId("strike"): 100.0, StepId("exposure"): 3.0, StepId("delay"): 4.0, StepId("black"): 1.0,
    StepId("light", "left"): 5.0, StepId("light", "right"): 7.0, StepId("codes", "left"): 10.0,
    StepId("codes", "right"): 12.0, StepId("radiometry", "left"): 1.0, StepId("radiometry", "right"): 3.0,
    StepId("pixels", "left"): 2.0, StepId("pixels", "right"): 4.0, StepId("geometry"): 6.0,
    StepId("study", item="times"): 1000.0,
}  # fmt: skip


def stage(size: str = "small") -> Subject:
    subject = array_subject()
    subject.size = size
    subject.parts = cast(
        SessionParts, SimpleNamespace(context=SimpleNamespace(journal=SimpleNamespace(steps=lambda: STEPS)))
    )
    return subject


def test_seconds_come_from_the_journal_and_from_solves_and_the_papers_size_is_quoted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    page = tmp_path / "README.md"
    page.write_text(PAGE)
    monkeypatch.setattr(experiment, "TIMINGS", page)
    result = times(stage())
    (table,) = result.tables
    names = list(column(table, "stage"))
    assert names == [one.name for one in STAGES]
    here = dict(zip(names, column(table, "seconds, this run, small"), strict=True))
    assert here["exposures and delays found"] == 7.0
    assert here["all photographs"] == 35.0
    assert here["metapixels, a projector"] == 3.0
    assert here["radiometry, a projector"] == 2.0
    solved = [float(here[name] or 0) for name in (TRANSPORT, BASE, APPEARANCE, FULL)]
    assert all(seconds > 0 for seconds in solved)
    assert float(here["all up to the first appearance"] or 0) == pytest.approx(58 + sum(solved[:3]), rel=0.01)
    held = {one.asked.split(":")[0]: one for one in result.criteria}
    assert held["metapixels, a projector"].reached.startswith("5.75 s, quoted")
    assert held["geometry"].holds is False  # the page says 700 s, the paper 600
    assert "700 s" in held["geometry"].reason
    assert BASE not in held, "no plausible fault takes the paper's hour"
    assert "all photographs" not in held, "an emulated camera shows nothing about a real one"
    assert "of the day" in result.text
    assert "size small" in result.text


def test_without_the_page_nothing_is_quoted_and_nothing_judged(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(experiment, "TIMINGS", tmp_path / "absent.md")
    monkeypatch.setattr(experiment, "_measured", lambda subject: dict.fromkeys(
        (TRANSPORT, BASE, APPEARANCE, FULL), Durations(1.0, 0.5)))  # fmt: skip
    result = times(stage())
    assert {one.holds for one in result.criteria} == {None}
    assert "nothing is quoted" in result.text


def test_a_run_at_the_papers_size_is_judged_by_its_own_seconds(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(experiment, "TIMINGS", tmp_path / "absent.md")
    slow = {TRANSPORT: Durations(1.0), BASE: Durations(60.0), APPEARANCE: Durations(1.5), FULL: Durations(9.0)}
    monkeypatch.setattr(experiment, "_measured", lambda subject: slow)
    held = {one.asked.split(":")[0]: one for one in times(stage("paper")).criteria}
    assert held[APPEARANCE].holds is False
    assert held["geometry"].holds


def test_the_last_row_of_a_section_counts_and_a_missing_one_leaves_the_sum_unknown() -> None:
    base = Quote("solve", "base image", "paper")
    assert quoted(PAGE, [base]) == (90.0, "20 sweeps, 90 s whole (goal 15 s)")
    assert quoted(PAGE, [Quote("calibration", "decoding", "value")])[0] == 9.0
    assert quoted(PAGE, [Quote("calibration/paper size", "decoding", "value")])[0] == 2.5
    assert quoted(PAGE, [base, Quote("solve", "nothing", "paper")])[0] is None
    assert quoted(PAGE, []) == (None, "")
    assert quoted("", [base]) == (None, "")


@pytest.mark.parametrize(
    ("words", "seconds"),
    [("264 ms", 0.264), ("3 to 5 s", 5.0), ("2 minutes", 120.0), ("20 sweeps", None), ("17 small", None)],
)
def test_the_first_time_in_some_words_is_read(words: str, seconds: float | None) -> None:
    assert seconds_in(words) == seconds
