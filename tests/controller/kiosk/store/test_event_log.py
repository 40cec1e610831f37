"""The kiosk's memory over starts, also on a disk that takes nothing when the kiosk begins."""

from __future__ import annotations

import shutil
import sqlite3
from pathlib import Path

from controller.kiosk.store.event_log import MOST_FAILURES, EventLog
from controller.kiosk.store.log_file import MOST_DONE, MOST_EVENTS
from hal.notices import Level, Notice
from tests.controller.kiosk.store.full_disk import without_space


def test_what_failed_is_kept_until_it_was_seen_over_starts_and_nonsense(tmp_path: Path) -> None:
    path = tmp_path / EventLog.FILE
    log = EventLog(path, durable=False)
    for number in range(MOST_FAILURES + 2):
        log.add_failure(Notice(f"failed-{number}", "It failed.", "Look.", Level.ERROR))
    assert len(log.failures) == MOST_FAILURES
    log.close()
    again = EventLog(path, durable=False)
    assert [row.code for row in again.failures][0::19] == ["failed-2", "failed-21"]
    again.seen(again.failures[-2].number)
    assert [row.code for row in again.failures] == ["failed-21"]
    again.keep("failures", "[{}]")
    again.close()
    assert EventLog(path, durable=False).failures == ()


def test_a_start_on_a_full_disk_forgets_nothing_and_what_it_is_told_is_written_when_there_is_space(
    tmp_path: Path,
) -> None:
    path, is_full = tmp_path / EventLog.FILE, [True]
    log = EventLog(path, durable=False)
    log.add(Notice("first", "One."))
    log.keep("chosen", "glass")
    log.close()

    says = "disk I/O error", sqlite3.SQLITE_IOERR_SHMSIZE  # what SQLite says on a file system without space
    log = EventLog(path, durable=False, connect=without_space(is_full, path, says))
    log.add(Notice("second", "Two."))
    log.mark_done("drift-check 2026-01-01", "drift-none")
    assert log.problem == "disk I/O error"
    assert ([row.code for row in log.after(0)], log.value("chosen")) == (["first", "second"], "glass")
    is_full.clear()
    log.mark_done("drift-check 2026-01-02", "drift-none")
    assert log.problem is None
    log.close()
    log = EventLog(path, durable=False)
    assert ([row.code for row in log.after(0)], log.value("chosen")) == (["first", "second"], "glass")
    assert log.done() == {"drift-check 2026-01-01", "drift-check 2026-01-02"}
    log.close()
    assert not list(path.parent.glob("*.damaged-*"))


def test_a_start_on_a_full_disk_after_a_kill_knows_the_newest_events_too(tmp_path: Path) -> None:
    killed, left = EventLog(tmp_path / "before" / "events.sqlite"), tmp_path / "left" / "events.sqlite"
    killed.add(Notice("last", "It was the last."))
    killed.keep("override", "[true, false]")
    left.parent.mkdir()
    for end in ("", "-wal"):
        shutil.copyfile(f"{killed.path}{end}", f"{left}{end}")
    killed.close()

    log = EventLog(left, connect=without_space([True]))
    assert [row.code for row in log.after(0)] == ["last"]
    assert (log.value("override"), log.number) == ("[true, false]", 1)
    log.close()


def test_the_oldest_events_and_finished_tasks_are_deleted_and_no_more_than_that(tmp_path: Path) -> None:
    path = tmp_path / EventLog.FILE
    log = EventLog(path, durable=False)
    for number in range(MOST_DONE + 50):
        log.mark_done(f"drift-check {number}", "drift-none")
        log.mark_done("every-night", f"{number}")
    log.close()
    with sqlite3.connect(path) as file:
        # One number of ten was never used, as after damaged logs.
        file.execute(
            "WITH RECURSIVE one(n) AS (SELECT 1 UNION ALL SELECT n + 1 FROM one WHERE n < ?) "
            "INSERT INTO events SELECT n * 10, 0.0, 'info', 'before-' || n, 'One.' FROM one",
            (MOST_EVENTS,),
        )
    file.close()
    log = EventLog(path, durable=False)
    for number in range(200):
        log.add(Notice(f"after-{number}", "It went on."))
    for done in (log.done(), _reopened(log).done()):
        assert (len(done), "every-night" in done, "drift-check 49" in done) == (MOST_DONE, True, False)
    with sqlite3.connect(path) as file:
        found = [code for (code,) in file.execute("SELECT code FROM events ORDER BY number")]
    file.close()
    assert (found[0], found[-1], len(found)) == ("before-201", "after-199", MOST_EVENTS)


def _reopened(log: EventLog) -> EventLog:
    log.close()
    again = EventLog(log.path, durable=False)
    again.close()
    return again
