"""Journals of format 1 are continued: what was done is not done again, whatever the projectors are called."""

from __future__ import annotations

import contextlib
import hashlib
import json
import sqlite3
import tempfile
from collections.abc import Sequence
from pathlib import Path

from hypothesis import given, settings

from controller.run.journal import Journal
from controller.run.journal_migration import OLD_SHOT, step_id_of
from controller.run.runner import Context, Runner, Step
from controller.run.step_id import ShotId, StepId
from controller.stage.artefacts.kinds import OF_PROJECTORS, StepKind
from hal.deadline import in_seconds
from tests.controller.stage.artefacts.names import projectors

FORMAT_1 = """
CREATE TABLE runs (
    id INTEGER PRIMARY KEY, name TEXT NOT NULL, pid INTEGER NOT NULL,
    began_at_s REAL NOT NULL, ended_at_s REAL, outcome TEXT
) STRICT;
CREATE TABLE steps (
    id INTEGER PRIMARY KEY AUTOINCREMENT, name TEXT NOT NULL UNIQUE, run INTEGER REFERENCES runs,
    inputs TEXT NOT NULL, began_at_s REAL NOT NULL, ended_at_s REAL NOT NULL
) STRICT;
CREATE TABLE artefacts (
    id INTEGER PRIMARY KEY, step INTEGER NOT NULL REFERENCES steps ON DELETE CASCADE,
    path TEXT NOT NULL, size INTEGER NOT NULL, sha256 TEXT NOT NULL
) STRICT;
CREATE INDEX artefacts_of_step ON artefacts (step);
CREATE TABLE shots (
    name TEXT PRIMARY KEY, run INTEGER REFERENCES runs, settings TEXT NOT NULL,
    path TEXT NOT NULL, size INTEGER NOT NULL, sha256 TEXT NOT NULL, taken_at_s REAL NOT NULL
) STRICT;
CREATE TABLE events (
    id INTEGER PRIMARY KEY, run INTEGER REFERENCES runs, at_s REAL NOT NULL,
    level TEXT NOT NULL, code TEXT NOT NULL, text TEXT NOT NULL
) STRICT;
PRAGMA application_id = 0x56454C41;
PRAGMA user_version = 1;
INSERT INTO runs VALUES (1, 'calibrate', 7, 0, 1, 'cancelled');
INSERT INTO events VALUES (1, 1, 0.5, 'info', 'camera-busy', 'It was busy.');
"""
KINDS = ("light", "codes", "edge-dots", "edges")


def write_format_1(run: Path, steps: Sequence[tuple[str, Sequence[str]]]) -> None:
    """A journal as it was: steps by name, each after those of these names, and each with one file."""
    run.mkdir(parents=True, exist_ok=True)
    digests = {}
    with contextlib.closing(sqlite3.connect(run / Journal.FILE)) as database:
        database.executescript(FORMAT_1)
        for number, (name, after) in enumerate(steps, start=1):
            data = name.encode()
            (run / f"{number}.bin").write_bytes(data)
            digests[name] = hashlib.sha256(data).hexdigest()
            inputs = {"setting": "1", **{f"{earlier}/0": digests[earlier] for earlier in after}}
            text = json.dumps(inputs, sort_keys=True, ensure_ascii=False)
            database.execute("INSERT INTO steps VALUES (?, ?, 1, ?, 10, ?)", (number, name, text, 10 + number))
            database.execute(
                "INSERT INTO artefacts VALUES (?, ?, ?, ?, ?)",
                (number, number, f"{number}.bin", len(data), digests[name]),
            )
        database.execute("INSERT INTO shots VALUES ('left-white-0', 1, '{}', '1.bin', 1, 'x', 0)")
        database.commit()


def never(context: Context) -> Sequence[Path]:
    raise AssertionError("this step was done by the older version")


@settings(max_examples=10, deadline=None)
@given(projectors)
def test_a_run_of_the_older_version_goes_on_with_the_right_steps(names: list[str]) -> None:
    ids = [StepId("exposure"), *(StepId(kind, name) for name in names for kind in KINDS), StepId("edge-terms")]
    ids += [StepId("appearance", item="a-b"), StepId("drift-photographs")]
    told = {one: str(one) for one in ids}
    after = {one: [ids[0]] if one.projector else ids[:-3] if one.kind == "edge-terms" else [] for one in ids}
    with tempfile.TemporaryDirectory() as place:
        run = Path(place) / "run"
        write_format_1(run, [(told[one], [told[other] for other in after[one]]) for one in ids])
        with Journal(run) as journal:
            assert list(journal.steps()) == ids
            assert list(journal.steps().values()) == [float(n) for n in range(1, len(ids) + 1)]
            assert journal.shot_count() == 1
            assert journal.shot(ShotId(OLD_SHOT, "left-white-0"), {}) is None, "its file does not match"
            assert [event.code for event in journal.events()] == ["camera-busy"]
            steps = [Step(one, never, inputs={"setting": "1"}, after=tuple(after[one])) for one in ids]
            results = Runner(steps, journal).run("calibrate", deadline=in_seconds(60))
        assert {one: made[0].path.read_text() for one, made in results.items()} == told
        with Journal(run) as again:
            assert list(again.steps()) == ids
            assert again.outcomes() == [("calibrate", "cancelled"), ("calibrate", "done")]


YOUNGER = {StepKind.INDIRECT, StepKind.STUDY_SHARES}
"""Kinds of steps that no run of the old format has."""


@given(projectors)
def test_the_name_of_a_step_had_one_meaning(names: list[str]) -> None:
    for kind in set(OF_PROJECTORS) - YOUNGER:
        for name in names:
            assert step_id_of(f"{kind}-{name}") == StepId(kind, name)
    assert step_id_of("dark-before") == StepId("dark-before")
    assert step_id_of("study-residual-six") == StepId("study", item="residual-six")


@settings(max_examples=10, deadline=None)
@given(projectors)
def test_a_journal_keeps_steps_and_photographs_of_all_projectors_apart(names: list[str]) -> None:
    with tempfile.TemporaryDirectory() as place, Journal(Path(place)) as journal:
        file = Path(place) / "a"
        file.write_bytes(b"a")
        steps = [StepId(kind, name) for kind in KINDS for name in names] + [StepId(kind) for kind in KINDS]
        steps += [StepId("light", item=name) for name in names]
        shots = [ShotId("light", shown, name) for name in (*names, None) for shown in ("0", "white-0")]
        for number, step in enumerate(steps):
            journal.complete(step, {"number": str(number)}, [file], began_at_s=0)
        for number, shot in enumerate(shots):
            journal.record_shot(shot, {"number": str(number)}, file)
        assert list(journal.steps()) == steps
        assert journal.shot_count() == len(shots)
        for number, step in enumerate(steps):
            assert journal.done(step, {"number": str(number)}) is not None
            assert journal.done(step, {"number": "other"}) is None
        for number, shot in enumerate(shots):
            assert journal.shot(shot, {"number": str(number)}) is not None
            assert journal.shot(shot, {"number": "other"}) is None
