"""What the night's study calls a fault."""

from __future__ import annotations

from typing import Any

from lab.study.output.keeping import StoredResult, StoredStudy
from tests.campaigns.study import faults


def kept(holds: bool | None, rows: list[list[int]]) -> StoredStudy:
    content: dict[str, Any] = {
        "name": "alpha",
        "facts": {"seed": 1},
        "criteria": [{"asked": "at most 1", "reached": "2", "holds": holds, "reason": ""}],
        "tables": [{"name": "t", "title": "T", "columns": ["n"], "rows": rows}],
        "figures": [],
        "text": "",
    }
    return StoredStudy((StoredResult(content),))


def test_a_missed_criterion_is_a_result_and_one_that_is_not_judged_or_an_empty_table_is_a_fault() -> None:
    assert faults(kept(False, [[1]])) == []
    assert faults(kept(None, [[1]])) == ["alpha: at most 1: not judged"]
    assert faults(kept(True, [])) == ["alpha: the table t is empty"]
