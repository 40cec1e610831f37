"""Converts journals of format 1, with names of steps and photographs, to format 2, with identities.

A step of a projector was called KIND-PROJECTOR, one of an appearance or experiment KIND-NAME. The kinds of format 1 are
listed here and never change. No kind is the beginning of another one, so every name has one meaning.
"""

from __future__ import annotations

import json
import sqlite3
from typing import Final

from controller.run.step_id import StepId, input_name

_OF_PROJECTORS: Final = (
    "light", "codes", "radiometry", "pixels", "dots", "metapixels", "edge-dots", "edges", "study-dots",
)  # fmt: skip
_OF_ITEMS: Final = ("appearance", "target", "compare", "pictures", "study")
OLD_SHOT: Final = "format-1"
"""The kind of photographs from format 1: they are counted, and taken again if a continued run needs them."""

_CHANGES: Final = (
    "ALTER TABLE steps RENAME TO steps_1",
    "ALTER TABLE artefacts RENAME TO artefacts_1",
    "ALTER TABLE shots RENAME TO shots_1",
    "DROP INDEX artefacts_of_step",
)


def from_format_1(database: sqlite3.Connection, tables: list[str]) -> None:
    """Move the content of a journal of format 1 into ``tables`` (statements), inside the caller's transaction."""
    for statement in (*_CHANGES, *tables):
        database.execute(statement)
    rows = database.execute("SELECT id, name, run, inputs, began_at_s, ended_at_s FROM steps_1").fetchall()
    ids = {name: step_id_of(name) for _, name, *_ in rows}
    database.executemany(
        "INSERT INTO steps (id, kind, projector, item, run, inputs, began_at_s, ended_at_s)"
        " VALUES (?, ?, ?, ?, ?, ?, ?, ?)",
        [
            (number, ids[name].kind, ids[name].projector, ids[name].item, run, _inputs(inputs, ids), began_s, ended_s)
            for number, name, run, inputs, began_s, ended_s in rows
        ],
    )
    database.execute("INSERT INTO artefacts SELECT id, step, path, size, sha256 FROM artefacts_1")
    database.execute(
        "INSERT INTO shots (kind, projector, name, run, settings, path, size, sha256, taken_at_s)"
        " SELECT ?, NULL, name, run, settings, path, size, sha256, taken_at_s FROM shots_1",
        (OLD_SHOT,),
    )
    for table in ("artefacts_1", "steps_1", "shots_1"):
        database.execute(f"DROP TABLE {table}")


def step_id_of(name: str) -> StepId:
    """The identity of the step with this name in format 1."""
    for kind in _OF_PROJECTORS:
        if (rest := name.removeprefix(f"{kind}-")) != name:
            return StepId(kind, projector=rest)
    for kind in _OF_ITEMS:
        if (rest := name.removeprefix(f"{kind}-")) != name:
            return StepId(kind, item=rest)
    return StepId(name)


def _inputs(canonical: str, ids: dict[str, StepId]) -> str:
    """The inputs with format 2 names for the artefacts of earlier steps, which were NAME/NUMBER."""
    found = {}
    for key, value in json.loads(canonical).items():
        step, _, number = key.rpartition("/")
        found[input_name(ids[step], int(number)) if step in ids else key] = value
    return json.dumps(found, sort_keys=True, ensure_ascii=False)


__all__ = ["OLD_SHOT", "from_format_1", "step_id_of"]
