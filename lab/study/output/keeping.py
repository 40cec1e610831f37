"""Results on disk: one JSON file and a few pictures an experiment, from which the pages are written."""

from __future__ import annotations

import contextlib
import json
import math
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

from controller.core.errors import UsageError
from controller.core.storage import write_atomically
from lab.study.output.drawing import encoded_webp
from lab.study.values import Criterion, Experiment, Figure, Result, ResultTable

SEEDS: Final = 3
"""A criterion holds only if it holds for so many seeds."""


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
    write_atomically(path, (json.dumps(plain(content), indent=1, ensure_ascii=False, allow_nan=False) + "\n").encode())
    return [path, *paths]


def _encoded(experiment: str, figure: Figure) -> tuple[str, bytes]:
    if isinstance(figure.picture, bytes):
        return f"{experiment}-{figure.name}.png", figure.picture
    return f"{experiment}-{figure.name}.webp", encoded_webp(figure.picture)


def plain(value: Any) -> Any:
    """What JSON can hold: numbers of NumPy become Python's, and what is not finite becomes null."""
    if isinstance(value, Mapping):
        return {str(key): plain(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [plain(inner) for inner in value]
    if hasattr(value, "item"):
        value = value.item()
    return None if isinstance(value, float) and not math.isfinite(value) else value


class StoredResult:
    """One seed's result as kept: ``criteria``, ``tables``, ``figures`` as (file, caption), ``text``, ``facts``."""

    def __init__(self, content: Mapping[str, Any]) -> None:
        self.content = content
        self.name = str(content["name"])
        self.facts: Mapping[str, Any] = content["facts"]
        self.criteria = tuple(Criterion(**row) for row in content["criteria"])
        self.tables = tuple(
            ResultTable(row["name"], row["title"], tuple(row["columns"]), tuple(map(tuple, row["rows"])))
            for row in content["tables"]
        )
        self.figures = tuple((str(row["file"]), str(row["caption"])) for row in content["figures"])
        self.text = str(content["text"])

    @property
    def seed(self) -> int:
        return int(self.facts.get("seed", 1))


@dataclass(frozen=True, slots=True)
class JudgedCriterion:
    """A criterion over all seeds: what each ``reached``, by seed, and whether all hold; None where that is not known.

    ``reason``: why it is missed, of the first seed that misses it
    """

    asked: str
    reached: Mapping[int, str]
    holds: bool | None
    reason: str = ""


@dataclass(frozen=True, slots=True)
class StoredStudy:
    """An experiment's results, one for each seed, lowest first; all of one size and one version of its code."""

    results: tuple[StoredResult, ...]

    @property
    def name(self) -> str:
        return self.results[0].name

    @property
    def seeds(self) -> tuple[int, ...]:
        return tuple(result.seed for result in self.results)

    @property
    def criteria(self) -> tuple[JudgedCriterion, ...]:
        """In the order of the first seed that has each."""
        asked = dict.fromkeys(one.asked for result in self.results for one in result.criteria)
        return tuple(self._judged(each) for each in asked)

    def _judged(self, asked: str) -> JudgedCriterion:
        of = {result.seed: one for result in self.results for one in result.criteria if one.asked == asked}
        missed = [one for one in of.values() if one.holds is False]
        holds: bool | None = not missed
        if not missed and (len(of) < max(SEEDS, len(self.results)) or any(one.holds is None for one in of.values())):
            holds = None
        reached = {seed: one.reached for seed, one in of.items()}
        return JudgedCriterion(asked, reached, holds, missed[0].reason if missed else "")

    def table(self, name: str) -> ResultTable:
        """A table of all seeds, with the seed as its first column. Raises KeyError."""
        of = {result.seed: one for result in self.results for one in result.tables if one.name == name}
        if not of:
            raise KeyError(name)
        first = next(iter(of.values()))
        rows = tuple((seed, *row) for seed, one in of.items() for row in one.rows)
        return ResultTable(name, first.title, ("seed", *first.columns), rows)

    @property
    def tables(self) -> tuple[ResultTable, ...]:
        names = dict.fromkeys(one.name for result in self.results for one in result.tables)
        return tuple(self.table(name) for name in names)

    def encoded(self) -> bytes:
        """The content of its file."""
        content = {"name": self.name, "seeds": [result.content for result in self.results]}
        return (json.dumps(content, indent=1, ensure_ascii=False, allow_nan=False) + "\n").encode()


def read_result(path: Path) -> StoredResult:
    """One seed's file. Raises UsageError("study-result-unreadable")."""
    with _explained(path):
        return StoredResult(json.loads(path.read_text()))


def read_study(path: Path) -> StoredStudy:
    """A file of several seeds, or of one alone. Raises UsageError("study-result-unreadable")."""
    with _explained(path):
        content = json.loads(path.read_text())
        return StoredStudy(tuple(StoredResult(each) for each in content.get("seeds", [content])))


def with_seed(kept: StoredStudy | None, new: StoredResult) -> StoredStudy:
    """``kept`` with another seed's result, or that of the same seed instead.

    Results of another size or room, or of another version of the experiment's code, say nothing beside the new one.
    """
    same = [] if kept is None else [one for one in kept.results if one.seed != new.seed and _alike(one, new)]
    return StoredStudy(tuple(sorted([*same, new], key=lambda one: one.seed)))


def _alike(one: StoredResult, other: StoredResult) -> bool:
    return all(one.facts.get(key) == other.facts.get(key) for key in ("size", "room", "code"))


@contextlib.contextmanager
def _explained(path: Path) -> Iterator[None]:
    try:
        yield
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UsageError(
            "study-result-unreadable",
            what=f"{path} is not a result of a study ({type(error).__name__}).",
            remedy="Remove it and run that experiment again.",
        ) from error
