"""Kernels that are not compiled yet are compiled beside a run's first steps."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from pathlib import Path

import pytest

from controller.run.compiling import KERNELS, kernels_compiled
from controller.run.journal import Journal
from controller.run.runner import Context, Runner, Step
from controller.run.step_id import StepId
from hal.deadline import Cancelled, in_seconds
from hal.runtime.kernels import are_compiled
from tests.controller.run.listening import Listening
from tests.end_to_end.kernel_copy import kernels_of_the_tables


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("VELATURA_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


@pytest.mark.slow
def test_a_run_waits_for_them_says_so_and_the_next_one_has_no_such_step(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kernels_of_the_tables(tmp_path / "cache" / "kernels")
    monkeypatch.setenv("VELATURA_CACHE", str(tmp_path / "cache"))
    for stamp in (tmp_path / "cache" / "kernels").glob("all-*"):
        stamp.unlink()
    assert not are_compiled()
    compiled_then: list[bool] = []

    def computes(_: Context) -> Sequence[Path]:
        compiled_then.append(are_compiled())
        return ()

    reporter = Listening()
    with kernels_compiled(reporter) as compiled, Journal(tmp_path / "run") as journal:
        steps = [*compiled, Step(StepId("computes"), computes)]
        Runner(steps, journal, reporter=reporter).run("test", deadline=in_seconds(300))
    assert compiled_then == [True]
    assert any("Compiling kernels" in text for text in reporter.said)
    with kernels_compiled(reporter) as compiled:
        assert compiled == ()


def test_a_run_that_is_stopped_while_they_are_compiled_ends_at_once(cache: Path, tmp_path: Path) -> None:
    cancel = threading.Event()
    reporter = Listening()
    with Journal(tmp_path / "run") as journal, kernels_compiled(reporter) as compiled:
        assert [step.id for step in compiled] == [KERNELS]
        runner = Runner(compiled, journal, reporter=reporter)
        threading.Timer(0.5, cancel.set).start()
        with pytest.raises(Cancelled):
            runner.run("test", deadline=in_seconds(300, cancel))
    assert not are_compiled()


def test_where_they_cannot_be_kept_nothing_is_compiled_ahead(cache: Path) -> None:
    cache.write_text("a file where the folder would be")
    with kernels_compiled(Listening()) as compiled:
        assert compiled == ()
