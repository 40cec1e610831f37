"""Old photographs: what goes, and what must stay."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from controller.kiosk.store.disk_space import KEPT_S, PHOTOGRAPHS_GOING, expired, purge
from controller.run.journal import Journal
from controller.stage.artefacts.names import CAPTURES

NOW_S = 1_800_000_000.0


def run_of(stage: Path, name: str, *, age_s: float = 2 * KEPT_S, outcome: str = "done") -> Path:
    run = stage / "runs" / name
    (run / CAPTURES).mkdir(parents=True)
    (run / CAPTURES / "black.dng").write_bytes(bytes(1000))
    (run / "verification.json").write_text("{}")
    with Journal(run) as journal:
        if outcome == "done":
            with journal.run("a"):
                pass
        elif outcome == "failed":
            with pytest.raises(RuntimeError), journal.run("a"):
                raise RuntimeError
    os.utime(run / Journal.FILE, (NOW_S - age_s, NOW_S - age_s))
    return run


def names(stage: Path) -> list[str]:
    return sorted(run.name for run in expired(stage, now_s=NOW_S))


def test_the_newest_two_of_each_kind_keep_their_photographs(tmp_path: Path) -> None:
    for day in range(1, 6):
        run_of(tmp_path, f"2026010{day}-020000-drift")
    for day in range(1, 4):
        run_of(tmp_path, f"2026010{day}-030000-calibrate")
    assert names(tmp_path) == [
        "20260101-020000-drift", "20260101-030000-calibrate", "20260102-020000-drift", "20260103-020000-drift",
    ]  # fmt: skip


def test_what_failed_stands_for_no_good_one_and_goes_with_the_rest(tmp_path: Path) -> None:
    good = [run_of(tmp_path, f"2026010{day}-020000-calibrate") for day in (1, 2, 3)]
    for day in (4, 5, 6):
        run_of(tmp_path, f"2026010{day}-020000-calibrate", outcome="failed")
    assert names(tmp_path) == [good[0].name]
    run_of(tmp_path, "20260107-020000-calibrate")
    run_of(tmp_path, "20260108-020000-calibrate")
    assert len(names(tmp_path)) == 6


def test_young_unfinished_and_unreadable_runs_are_left_alone(tmp_path: Path) -> None:
    run_of(tmp_path, "20260101-020000-drift", age_s=KEPT_S - 60)
    run_of(tmp_path, "20260102-020000-drift", outcome="killed")
    broken = run_of(tmp_path, "20260103-020000-drift")
    for day in (7, 8):
        run_of(tmp_path, f"2026010{day}-020000-drift")
    (broken / Journal.FILE).write_bytes(b"no journal" * 1000)
    os.utime(broken / Journal.FILE, (0, 0))
    (tmp_path / "runs" / "notes-of-ours-drift").mkdir()
    assert names(tmp_path) == []


def test_only_photographs_go_and_it_is_told_how_much_that_was(tmp_path: Path) -> None:
    old = run_of(tmp_path, "20260101-020000-drift")
    for day in (2, 3):
        run_of(tmp_path, f"2026010{day}-020000-drift")
    assert purge(expired(tmp_path, now_s=NOW_S)) == 1000
    assert sorted(path.name for path in old.iterdir()) == [Journal.FILE, "verification.json"]
    assert expired(tmp_path, now_s=NOW_S) == []


def test_what_a_power_cut_left_half_removed_is_removed_the_next_time(tmp_path: Path) -> None:
    old = run_of(tmp_path, "20260101-020000-drift")
    for day in (2, 3):
        run_of(tmp_path, f"2026010{day}-020000-drift")
    (old / CAPTURES).rename(old / PHOTOGRAPHS_GOING)
    assert purge(expired(tmp_path, now_s=NOW_S)) == 1000
    assert not (old / PHOTOGRAPHS_GOING).exists()


def test_a_stage_without_runs_has_nothing_to_remove(tmp_path: Path) -> None:
    assert expired(tmp_path, now_s=NOW_S) == []
