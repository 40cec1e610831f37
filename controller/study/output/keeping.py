"""Results on disk: one JSON file and a few pictures an experiment, from which the pages are written."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from controller.core.errors import UsageError
from controller.core.storage import write_atomically
from controller.study.output.drawing import encoded_webp
from controller.study.values import Criterion, Experiment, Figure, Result, ResultTable


def save_result(folder: Path, experiment: Experiment, result: Result, facts: Mapping[str, Any]) -> list[Path]:
    """Write ``NAME.json`` and ``NAME-FIGURE.png`` or ``.webp`` into ``folder``; return the paths, the JSON first.

    ``facts``: what the run was: size, seed, seconds and such.
    """
    pictures, paths = [], []
    for figure in result.figures:
        name, data = _encoded(experiment.name, figure)
        write_atomically(folder / name, data)
        pictures.append({"file": name, "caption": figure.caption})
        paths.append(folder / name)
    content = {
        "name": experiment.name,
        "facts": dict(facts),
        "criteria": [asdict(criterion) for criterion in result.criteria],
        "tables": [asdict(table) for table in result.tables],
        "figures": pictures,
        "text": result.text,
    }
    path = folder / f"{experiment.name}.json"
    write_atomically(path, (json.dumps(_plain(content), indent=1, ensure_ascii=False, allow_nan=False) + "\n").encode())
    return [path, *paths]


def _encoded(experiment: str, figure: Figure) -> tuple[str, bytes]:
    if isinstance(figure.picture, bytes):
        return f"{experiment}-{figure.name}.png", figure.picture
    return f"{experiment}-{figure.name}.webp", encoded_webp(figure.picture)


def _plain(value: Any) -> Any:
    """What JSON can hold: numbers of NumPy become Python's, and what is not finite becomes null."""
    if isinstance(value, Mapping):
        return {str(key): _plain(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(inner) for inner in value]
    if hasattr(value, "item"):
        value = value.item()
    return None if isinstance(value, float) and not math.isfinite(value) else value


class StoredResult:
    """A result as it was kept: ``criteria``, ``tables``, ``figures`` as (file, caption), ``text`` and ``facts``."""

    def __init__(self, content: Mapping[str, Any]) -> None:
        self.name = str(content["name"])
        self.facts: Mapping[str, Any] = content["facts"]
        self.criteria = tuple(Criterion(**row) for row in content["criteria"])
        self.tables = tuple(
            ResultTable(row["name"], row["title"], tuple(row["columns"]), tuple(map(tuple, row["rows"])))
            for row in content["tables"]
        )
        self.figures = tuple((str(row["file"]), str(row["caption"])) for row in content["figures"])
        self.text = str(content["text"])


def read_result(path: Path) -> StoredResult:
    """Raises UsageError("study-result-unreadable")."""
    try:
        return StoredResult(json.loads(path.read_text()))
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UsageError(
            "study-result-unreadable",
            what=f"{path} is not a result of a study ({type(error).__name__}).",
            remedy="Remove it and run that experiment again.",
        ) from error
