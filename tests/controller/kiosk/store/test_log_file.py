"""The kiosk's memory in a file that is damaged, or is replaced."""

from __future__ import annotations

import errno
import shutil
import sqlite3
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from controller.kiosk.store.event_log import EventLog
from hal.notices import Notice
from tests.controller.kiosk.store.full_disk import without_space


def damage(path: Path, begin: int, end: int | None = None) -> None:
    """Change every byte of a file from ``begin`` to ``end`` (None: its end)."""
    content = bytearray(path.read_bytes())
    content[begin:end] = bytes(byte ^ 0xA5 for byte in content[begin:end])
    path.write_bytes(content)


def written(path: Path, *codes: str, **kept: str) -> None:
    """A log of one event of each code, in this order, and with these values kept."""
    log = EventLog(path, durable=False)
    for code in codes:
        log.add(Notice(code, "One. " * 50))
    for name, value in kept.items():
        log.keep(name, value)
    log.close()


@pytest.mark.parametrize("whole", [4096, 8 * 4096])
def test_a_damaged_log_on_a_full_disk_is_replaced_when_there_is_space(
    tmp_path: Path, whole: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, is_full = tmp_path / EventLog.FILE, [True]
    written(path, *["before"] * 100)
    # The schema's page is not damaged where it is ``whole``.
    damage(path, whole - 2000)
    damaged = path.read_bytes()

    def replace(old: Path, new: Path) -> Path:
        if is_full:
            raise OSError(errno.ENOSPC, "No space left on device")
        return rename(old, new)

    rename = Path.replace
    monkeypatch.setattr(Path, "replace", replace)
    now_s = [0.0]
    log = EventLog(path, durable=False, connect=without_space(is_full, path), monotonic=lambda: now_s[0])
    log.add(Notice("full", "Two."))
    is_full.clear()
    for _ in range(4):
        now_s[0] += 31.0
        log.add(Notice("after", "Three."))
    assert log.problem is None
    log.close()
    log = EventLog(path, durable=False)
    assert [row.code for row in log.after(0)][-5:] == ["full", *["after"] * 4]
    log.close()
    (kept,) = path.parent.glob("*.damaged-*")
    assert kept.read_bytes()[whole:] == damaged[whole:], "not one that took its place"


def test_a_log_that_is_damaged_in_its_middle_takes_nothing_more_once_a_full_disk_has_space(tmp_path: Path) -> None:
    path, is_full = tmp_path / EventLog.FILE, [True]
    written(path, *["before"] * 400)
    middle = 4096 * (path.stat().st_size // 8192)
    damage(path, middle, middle + 4096)

    now_s = [0.0]
    log = EventLog(path, durable=False, connect=without_space(is_full), monotonic=lambda: now_s[0])
    newest = [row for row in log.after(0) if row.code == "before"]
    assert newest
    log.add(Notice("full", "Two."))
    is_full.clear()
    now_s[0] += 31.0
    log.add(Notice("after", "Three."))
    assert log.problem is None
    log.close()
    assert len(list(path.parent.glob("*.damaged-*"))) == 1
    log = EventLog(path, durable=False)
    assert [row.number for row in log.after(0)][: len(newest)] == [row.number for row in newest]
    assert [row.code for row in log.after(0)][len(newest) :] == ["full", "after"]
    log.close()


def test_a_log_with_a_row_that_is_no_text_keeps_the_others_in_another_file(tmp_path: Path) -> None:
    path = tmp_path / EventLog.FILE
    log = EventLog(path, durable=False)
    for text in ("One.", "Two, the one that is damaged.", "Three."):
        log.add(Notice("before", text))
    log.close()
    at = path.read_bytes().index(b"the one that")
    damage(path, at, at + 12)
    log = EventLog(path, durable=False)
    log.add(Notice("after", "Four."))
    log.close()
    assert len(list(path.parent.glob("*.damaged-*"))) == 1
    log = EventLog(path, durable=False)
    assert [row.text for row in log.after(0)] == ["One.", "Three.", "Four."]
    log.close()


@pytest.mark.parametrize("length", [50, 5000])
def test_a_damaged_log_is_put_aside_and_another_is_begun(tmp_path: Path, length: int) -> None:
    path = tmp_path / EventLog.FILE
    written(path, *["before"] * 100)
    path.write_bytes(path.read_bytes()[:length])
    log = EventLog(path, durable=False)
    log.add(Notice("after", "Two."))
    assert log.problem is None
    log.close()
    log = EventLog(path, durable=False)
    assert [row.code for row in log.after(0)] == ["after"]
    log.close()
    assert len(list(path.parent.glob("*.damaged-*"))) == 1


def test_a_log_that_opens_but_takes_nothing_is_replaced_at_once(tmp_path: Path) -> None:
    path = tmp_path / EventLog.FILE
    written(path, *["before"] * 100, override="open")
    # All pages of events are damaged; the schema and the small tables before them are sound.
    damage(path, 8 * 4096)
    log = EventLog(path, durable=False)
    for _ in range(3):
        log.add(Notice("after", "Two."))
    assert log.problem is None
    log.close()
    log = EventLog(path, durable=False)
    assert [row.code for row in log.after(0)][-3:] == ["after"] * 3
    assert log.value("override") == "open"
    assert log.number > 100
    log.close()
    assert len(list(path.parent.glob("*.damaged-*"))) == 1


def test_a_log_that_is_damaged_in_its_middle_keeps_what_came_after(tmp_path: Path) -> None:
    path = tmp_path / EventLog.FILE
    written(path, *(f"before-{number}" for number in range(300)), override="open")
    content, middle = path.read_bytes(), 4096 * (path.stat().st_size // 8192)
    path.write_bytes(content[:middle] + b"\xa5" * 4096 + content[middle + 4096 :])
    log = EventLog(path, durable=False)
    log.add(Notice("after", "Two."))
    log.close()
    log = EventLog(path, durable=False)
    codes = [row.code for row in log.after(0)]
    assert codes[-101:] == [*(f"before-{number}" for number in range(200, 300)), "after"]
    assert (log.value("override"), log.number, log.problem) == ("open", 301, None)
    log.close()
    assert len(list(path.parent.glob("*.damaged-*"))) == 1


@pytest.mark.timeout(20)
def test_a_log_that_is_a_device_is_not_read_without_an_end(tmp_path: Path) -> None:
    path = tmp_path / "events.sqlite"
    path.symlink_to("/dev/zero")
    log = EventLog(path)
    assert log.problem is not None
    row = log.add(Notice("begins", "It begins."))
    assert [one.text for one in log.after(0)] == [row.text]
    log.close()
    assert path.is_symlink()


def _torn_log(path: Path) -> None:
    """As SQLite reads zeros where a page is gone: columns that must have something have nothing."""
    path.parent.mkdir()
    with sqlite3.connect(path) as file:
        file.executescript(
            "CREATE TABLE events (number INTEGER PRIMARY KEY, unix_s REAL, level TEXT, code TEXT, text TEXT);"
            "CREATE TABLE done (number INTEGER PRIMARY KEY AUTOINCREMENT, key TEXT UNIQUE, how TEXT);"
            "INSERT INTO events (number) VALUES (1);"
            "INSERT INTO events VALUES (2, 5.0, 'info', 'second', 'Two.');"
            "INSERT INTO done (key, how) VALUES (NULL, NULL), ('drift-check 2026-01-01', 'begun');"
        )
    file.close()


def test_a_damaged_log_with_empty_rows_keeps_the_others_and_goes_on_in_another_file(tmp_path: Path) -> None:
    path = tmp_path / EventLog.FILE
    _torn_log(path)
    log = EventLog(path, durable=False)
    assert [row.code for row in log.after(0)] == ["second"]
    log.add(Notice("third", "Three."))
    assert log.problem is None
    log.close()
    log = EventLog(path, durable=False)
    assert [row.code for row in log.after(0)] == ["second", "third"]
    assert log.done() == {"drift-check 2026-01-01"}
    assert list(path.parent.glob("*.damaged-*"))
    log.close()


def test_what_a_damaged_log_had_stays_however_many_events_follow_and_whatever_the_clock_says(tmp_path: Path) -> None:
    path = tmp_path / EventLog.FILE
    _torn_log(path)
    # Numbers continue from the clock's; the oldest events are deleted when a number can be divided by 200.
    log = EventLog(path, durable=False, wall=lambda: 1_795_000_000.0)
    for number in range(450):
        log.add(Notice(f"after-{number}", "It went on."))
    log.close()
    log = EventLog(path, durable=False)
    assert [row.code for row in log.after(0)] == ["second", *(f"after-{number}" for number in range(450))]
    log.close()


def test_numbers_go_on_above_the_newest_event_where_only_the_number_is_gone(tmp_path: Path) -> None:
    path = tmp_path / EventLog.FILE
    log = EventLog(path, durable=False)
    for number in range(3):
        log.add(Notice(f"before-{number}", "One."))
    log.close()
    with sqlite3.connect(path) as file:
        # As SQLite reads zeros in the page of the numbers.
        file.execute("UPDATE sqlite_sequence SET name = NULL, seq = NULL")
    file.close()
    # The clock was lost, too.
    log = EventLog(path, durable=False, wall=lambda: 0.0)
    log.add(Notice("after", "Two."))
    log.close()
    log = EventLog(path, durable=False)
    assert [row.code for row in log.after(0)] == ["before-0", "before-1", "before-2", "after"]
    log.close()


class _Killed(BaseException):
    """What a kill is to the code that it meets: nothing after it runs."""


def test_a_kill_at_any_moment_of_replacing_a_damaged_log_loses_nothing_of_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    known = [f"before-{number}" for number in range(20)]
    log = EventLog(tmp_path / "sound" / "events.sqlite", durable=False)
    for code in known:
        log.add(Notice(code, "One. " * 50))
    log.mark_done("drift-check 2026-01-01", "drift-none")
    log.keep("override", "open")
    log.close()
    with sqlite3.connect(log.path) as file:
        # A row that can't be, so that the file is replaced at the start.
        file.executescript(
            "PRAGMA writable_schema=ON; UPDATE sqlite_master SET sql = replace(sql, 'NOT NULL', '') "
            "WHERE name IN ('events', 'done', 'kept'); PRAGMA writable_schema=RESET;"
            "INSERT INTO events (number) VALUES (100);"
        )
    file.close()
    left = [0]

    def step() -> None:
        left[0] -= 1
        if left[0] == 0:
            raise _Killed

    class Connection(sqlite3.Connection):
        def execute(self, *arguments: Any) -> sqlite3.Cursor:
            step()
            return super().execute(*arguments)

    def connect(database: Any, **options: Any) -> sqlite3.Connection:
        return sqlite3.connect(database, factory=Connection, **options)

    def counted(own: Callable[..., Any]) -> Callable[..., Any]:
        def operation(*arguments: Any, **options: Any) -> Any:
            step()
            return own(*arguments, **options)

        return operation

    for name in ("replace", "unlink"):
        monkeypatch.setattr(Path, name, counted(getattr(Path, name)))
    moments = 0
    for moment in range(1, 200):
        path = tmp_path / str(moment) / "events.sqlite"
        path.parent.mkdir()
        shutil.copyfile(log.path, path)
        left[0] = moment
        try:
            EventLog(path, durable=False, connect=connect).close()
        except _Killed:
            moments += 1
        left[0] = 0
        again = EventLog(path, durable=False)
        again.add(Notice("after", "Two."))
        again.close()
        again = EventLog(path, durable=False)
        assert [row.code for row in again.after(0)] == [*known, "after"], moment
        assert again.done() == {"drift-check 2026-01-01"}
        assert again.value("override") == "open"
        again.close()
        if moments < moment:
            break
    assert moments > 40


def test_a_new_file_that_was_written_in_part_does_not_take_the_place_of_a_sound_log(tmp_path: Path) -> None:
    path = tmp_path / EventLog.FILE
    log = EventLog(path, durable=False)
    log.add(Notice("before", "One."))
    log.close()
    path.with_suffix(".new").write_bytes(b"\xa5" * 5000)
    log = EventLog(path, durable=False)
    assert [row.code for row in log.after(0)] == ["before"]
    log.close()
    assert not path.with_suffix(".new").exists()
    assert not list(path.parent.glob("*.damaged-*"))


def test_an_event_is_on_the_disk_when_it_is_logged(tmp_path: Path) -> None:
    """With less than this, SQLite writes the newest events to the disk only later."""
    levels: list[int] = []

    class Watched(sqlite3.Connection):
        def executescript(self, script: str, /) -> sqlite3.Cursor:
            levels.append(self.execute("PRAGMA synchronous").fetchone()[0])
            return super().executescript(script)

    def connect(path: Any, **more: Any) -> sqlite3.Connection:
        return sqlite3.connect(path, factory=Watched, **more)

    for durable in (True, False):
        EventLog(tmp_path / f"{durable}.sqlite", durable=durable, connect=connect).close()
    full, off = 2, 0
    assert levels == [full, off]
