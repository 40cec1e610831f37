"""A disk that fills: what goes first, and what stays whatever happens."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import pytest

from controller.bundle.signing import Trust
from controller.config.models import DiskTable
from controller.kiosk.store import archive
from controller.kiosk.store.bundle_store import BundleStore
from controller.kiosk.store.disk_space import GOING, make_room
from controller.kiosk.store.event_log import EventLog
from controller.kiosk.supervisors.disk_supervisor import DiskSupervisor
from controller.stage.artefacts.names import CAPTURES
from tests.controller.kiosk.store.test_photo_retention import run_of


def filled(stage: Path) -> None:
    for day in range(1, 8):
        run_of(stage, f"2026010{day}-020000-drift", age_s=0)
    run_of(stage, "20260108-020000-drift", age_s=0, outcome="killed")
    run_of(stage, "20260101-010000-calibrate", age_s=0)
    (stage / archive.REPLACED).mkdir(parents=True)
    (stage / archive.FOLDER).mkdir(parents=True)
    for number in range(3):
        (stage / archive.FOLDER / f"backup-2026010{number}.tar.gz").write_bytes(bytes(9))


def test_photographs_go_first_then_copies_then_old_runs_and_nothing_after_it_is_enough(tmp_path: Path) -> None:
    filled(tmp_path)
    (tmp_path / "runs" / f"20251231-020000-drift{GOING}").mkdir()
    left = iter([False, False, False, True])
    assert make_room(tmp_path, lambda: next(left), keep_runs=2, used=set()) == [
        "the rest of 20251231-020000-drift",
        "the photographs of 20260101-020000-drift",
        "the photographs of 20260102-020000-drift",
    ]
    assert not (tmp_path / "runs" / "20260101-020000-drift" / CAPTURES).exists()
    assert (tmp_path / "runs" / "20260103-020000-drift" / CAPTURES).exists()
    assert (tmp_path / archive.REPLACED).exists()


def test_what_plays_was_made_from_stays_and_so_do_the_newest_of_each_kind(tmp_path: Path) -> None:
    filled(tmp_path)
    make_room(tmp_path, lambda: False, keep_runs=3, used={"20260102-020000-drift"})
    left = sorted(run.name for run in (tmp_path / "runs").iterdir())
    assert left == [
        "20260101-010000-calibrate", "20260102-020000-drift", "20260106-020000-drift", "20260107-020000-drift",
        "20260108-020000-drift",
    ]  # fmt: skip
    with_photographs = [name for name in left if (tmp_path / "runs" / name / CAPTURES).exists()]
    assert with_photographs == [name for name in left if name != "20260102-020000-drift"]
    assert not (tmp_path / archive.REPLACED).exists()
    assert [path.name for path in (tmp_path / archive.FOLDER).iterdir()] == ["backup-20260102.tar.gz"]


def test_below_its_level_it_makes_room_warns_once_and_says_when_there_is_space_again(tmp_path: Path) -> None:
    filled(tmp_path)
    log, tables = EventLog(tmp_path / EventLog.FILE, durable=False), [DiskTable(warn_free_gb=1e5, keep_runs=2)]
    jobs = [True]
    disk = DiskSupervisor(tmp_path, lambda: tables[0], BundleStore(tmp_path, Trust(())), log, lambda: jobs[0])
    disk.step()
    assert len(list((tmp_path / "runs").iterdir())) == 9, "a job that runs may need them"
    jobs[0] = False
    disk.step()
    disk.step()
    assert len(list((tmp_path / "runs").iterdir())) == 3
    assert [row.code for row in log.after(0)] == ["disk-filling", "disk-cleared"]
    assert "GB are free" in str(disk.row.problem)
    tables[0] = DiskTable(warn_free_gb=0.0)
    disk.step()
    assert log.after(0)[-1].code == "disk-well"
    assert disk.row.problem is None
    free, total = re.findall(r"[0-9,]+\.[0-9] GB", disk.row.values[0].text)
    usage = shutil.disk_usage(tmp_path)
    assert total == f"{usage.total / 1e9:,.1f} GB"
    assert float(free.removesuffix(" GB").replace(",", "")) == pytest.approx(usage.free / 1e9, abs=1.0)
    log.close()
