from __future__ import annotations

import sqlite3
import threading
from pathlib import Path

import pytest

from controller.core.errors import WorkError
from controller.core.storage import write_atomically
from controller.run.journal import Journal, JournalError
from controller.run.state_machine import Event, Machine
from controller.run.step_id import ShotId, StepId
from hal.notices import Level

DECODE = StepId("decode")
WHITE = ShotId("light", "white-00", "left")


def writing(path: Path, data: bytes, calls: list[str]) -> list[Path]:
    calls.append(path.name)
    write_atomically(path, data)
    return [path]


def test_a_step_is_done_once_as_long_as_inputs_and_artefact_stay(tmp_path: Path) -> None:
    calls: list[str] = []
    for repeated in (True, False):
        with Journal(tmp_path) as journal:
            result = journal.step(DECODE, {"captures": "aa"}, lambda: writing(tmp_path / "a.npz", b"x", calls))
        assert result.repeated is repeated
        assert result.artefacts[0].path == tmp_path / "a.npz"
    assert calls == ["a.npz"]


@pytest.mark.parametrize(
    "spoil",
    [
        lambda path: path.write_bytes(b"y"),
        lambda path: path.write_bytes(b"xx"),
        lambda path: path.unlink(),
    ],
    ids=["other bytes", "other length", "gone"],
)
def test_a_step_runs_again_when_its_artefact_no_longer_matches(tmp_path: Path, spoil: object) -> None:
    calls: list[str] = []
    with Journal(tmp_path) as journal:
        journal.step(DECODE, {}, lambda: writing(tmp_path / "a.npz", b"x", calls))
        assert callable(spoil)
        spoil(tmp_path / "a.npz")
        assert journal.step(DECODE, {}, lambda: writing(tmp_path / "a.npz", b"x", calls)).repeated
    assert len(calls) == 2


def test_a_step_runs_again_when_an_input_changed_came_or_went(tmp_path: Path) -> None:
    calls: list[str] = []
    with Journal(tmp_path) as journal:
        for inputs in ({"a": "1"}, {"a": "2"}, {"a": "2", "b": "1"}, {}):
            assert journal.step(DECODE, inputs, lambda: writing(tmp_path / "a", b"x", calls)).repeated
        assert not journal.step(DECODE, {}, lambda: writing(tmp_path / "a", b"x", calls)).repeated


def test_a_step_that_failed_is_not_done(tmp_path: Path) -> None:
    def failing() -> list[Path]:
        write_atomically(tmp_path / "a", b"half of the work")
        raise WorkError("too-dark", what="Too dark.", remedy="More light.")

    with Journal(tmp_path) as journal:
        with pytest.raises(WorkError):
            journal.step(DECODE, {}, failing)
        assert journal.done(DECODE, {}) is None


def test_a_step_must_leave_the_files_that_it_names(tmp_path: Path) -> None:
    with Journal(tmp_path) as journal:
        with pytest.raises(JournalError) as error:
            journal.step(DECODE, {}, lambda: [tmp_path / "never written"])
        assert error.value.code == "artefact-missing"
        assert journal.done(DECODE, {}) is None


def test_a_stage_folder_may_be_moved(tmp_path: Path) -> None:
    with Journal(tmp_path / "here") as journal:
        journal.step(DECODE, {}, lambda: writing(tmp_path / "here" / "arrays" / "a", b"x", []))
    (tmp_path / "here").rename(tmp_path / "there")
    with Journal(tmp_path / "there") as journal:
        done = journal.done(DECODE, {})
    assert done is not None
    assert done[0].path == tmp_path / "there" / "arrays" / "a"


def test_a_shot_is_known_only_with_its_settings_and_its_bytes(tmp_path: Path) -> None:
    photograph = tmp_path / "captures" / "white-00.dng"
    write_atomically(photograph, b"raw")
    with Journal(tmp_path) as journal:
        assert journal.shot(WHITE, {"exposure_s": "0.1"}) is None
        journal.record_shot(WHITE, {"exposure_s": "0.1"}, photograph)
        kept = journal.shot(WHITE, {"exposure_s": "0.1"})
        assert kept is not None
        assert kept.path == photograph
        assert journal.shot(WHITE, {"exposure_s": "0.2"}) is None
        photograph.write_bytes(b"rar")
        assert journal.shot(WHITE, {"exposure_s": "0.1"}) is None


def test_state_changes_errors_and_outcomes_are_there_after_a_restart(tmp_path: Path) -> None:
    with Journal(tmp_path) as journal:
        Machine(journal.record_change).handle(Event.START, "asked by the technician")
        journal.record("camera-busy", "model \x1b[31mX", Level.WARNING)
        with pytest.raises(WorkError), journal.run("calibrate"):
            raise WorkError("too-dark", what="Too dark.", remedy="More light.")
    with Journal(tmp_path) as journal:
        assert journal.outcomes() == [("calibrate", "too-dark")]
        state, busy = journal.events()
    assert state.text == "off -> powering (start): asked by the technician"
    assert (busy.level, busy.code, busy.text) == ("warning", "camera-busy", "model \x1b[31mX")


def test_threads_may_write_at_once(tmp_path: Path) -> None:
    with Journal(tmp_path) as journal:

        def talk() -> None:
            for number in range(20):
                journal.record("retry", f"attempt {number}")

        threads = [threading.Thread(target=talk) for _ in range(4)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert len(journal.events()) == 80


def code_of_opening(folder: Path) -> str:
    with pytest.raises(JournalError) as error:
        Journal(folder)
    assert error.value.what
    assert error.value.remedy
    return error.value.code


@pytest.mark.parametrize("content", [b"not a database at all" * 100, b"SQLite format 3\x00" + bytes(4080)])
def test_a_file_that_is_no_database_is_damaged(tmp_path: Path, content: bytes) -> None:
    (tmp_path / Journal.FILE).write_bytes(content)
    assert code_of_opening(tmp_path) == "journal-damaged"


def test_overwritten_pages_are_found_when_opening(tmp_path: Path) -> None:
    with Journal(tmp_path) as journal:
        for number in range(200):
            journal.record("code", f"text {number}" * 20)
    file = tmp_path / Journal.FILE
    data = bytearray(file.read_bytes())
    data[4096 * 3 : 4096 * 8] = b"\xa5" * (4096 * 5)
    file.write_bytes(data)
    assert code_of_opening(tmp_path) == "journal-damaged"


def test_another_version_and_another_programs_database_are_told_apart(tmp_path: Path) -> None:
    Journal(tmp_path / "later").close()
    with sqlite3.connect(tmp_path / "later" / Journal.FILE) as later:
        later.execute("PRAGMA user_version = 99")
    later.close()
    (tmp_path / "other").mkdir()
    with sqlite3.connect(tmp_path / "other" / Journal.FILE) as other:
        other.execute("CREATE TABLE songs (name TEXT)")
    other.close()
    assert code_of_opening(tmp_path / "later") == "journal-version"
    assert code_of_opening(tmp_path / "other") == "journal-not-ours"


def test_a_journal_that_another_process_writes_to_is_locked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("controller.run.journal.BUSY_S", 0.05)
    with Journal(tmp_path) as journal:
        other = sqlite3.connect(journal.path)
        other.execute("BEGIN IMMEDIATE")
        with pytest.raises(JournalError) as error:
            journal.record("code", "text")
        other.close()
    assert error.value.code == "journal-locked"


def test_a_folder_that_cannot_be_made_is_explained(tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"")
    assert code_of_opening(tmp_path / "file" / "run") == "journal-unusable"
