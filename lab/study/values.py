"""An experiment and its result."""

from __future__ import annotations

import ast
import hashlib
import inspect
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from controller.core.arrays import ByteImage
from lab.study.subject.subject import Subject

Cell = str | int | float | bool | None


@dataclass(frozen=True, slots=True)
class Criterion:
    """What is asked, in words and figures, what was reached, and whether that is enough.

    ``reason``: why it is missed, as far as known; ``holds`` None where it is not known
    """

    asked: str
    reached: str
    holds: bool | None
    reason: str = ""


@dataclass(frozen=True, slots=True)
class ResultTable:
    """A small table: ``name`` (of its file), ``title``, one name a column, and rows of as many cells."""

    name: str
    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]

    def __post_init__(self) -> None:
        if any(len(row) != len(self.columns) for row in self.rows):
            raise ValueError(f"table {self.name}: every row needs {len(self.columns)} cells")


@dataclass(frozen=True, slots=True)
class Figure:
    """A picture: ``name`` (of its file), what it shows, and (rows, columns, 3) uint8, or a PNG's bytes."""

    name: str
    caption: str
    picture: ByteImage | bytes


@dataclass(frozen=True, slots=True)
class Result:
    """The result of an experiment.

    ``text``: the part of the page's text that depends on the run; the rest is in ``words``
    """

    criteria: tuple[Criterion, ...]
    tables: tuple[ResultTable, ...]
    figures: tuple[Figure, ...] = ()
    text: str = ""


@dataclass(frozen=True, slots=True)
class Experiment:
    """One experiment: one function, one page.

    Parameters
    ----------
    name : of its page and files, as it is typed
    paper : the section and figure of the paper that it repeats, or what it goes beyond
    shows : what it must show, in a sentence
    scene : the name of the stage it works on, one of ``scenes.SCENES``; None: the function gets no stage (None)
    run : does the work; it calls ``Subject.advance`` often, where a stop takes hold
    cost_s : rough cost at size small on two quiet cores, for the time left; grows with the pixels
    optional : not done unless it is named
    dots : it needs ``Subject.light.dots``, so dots are photographed before it
    """

    name: str
    title: str
    paper: str
    shows: str
    scene: str | None
    run: Callable[[Subject], Result]
    cost_s: float = 60.0
    optional: bool = False
    dots: bool = False

    def code_sha256(self) -> str:
        """Hash of what the function's module does: an experiment that was changed is done again.

        Imports and docstrings do not count: modules that move, and better words, change no result.
        """
        source = inspect.getsourcefile(self.run)
        return "" if source is None else hashlib.sha256(_statements(Path(source)).encode()).hexdigest()


def _statements(source: Path) -> str:
    """The lines of a module, without its imports, docstrings and empty lines."""
    text = source.read_text("utf-8")
    left_out = {
        line
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.Import | ast.ImportFrom)
        or (isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant))
        for line in range(node.lineno, (node.end_lineno or node.lineno) + 1)
    }
    kept = (line for number, line in enumerate(text.splitlines(), 1) if number not in left_out)
    return "\n".join(line for line in kept if line.strip())


def column(table: ResultTable, name: str) -> Sequence[Cell]:
    """A table's cells under that name."""
    place = table.columns.index(name)
    return [row[place] for row in table.rows]
