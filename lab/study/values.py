"""An experiment and its result."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from controller.core.arrays import ByteImage
from controller.core.storage import sha256_of
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
        """Hash of the module that the function stands in: an experiment that was changed is done again."""
        source = inspect.getsourcefile(self.run)
        return "" if source is None else sha256_of(Path(source))


def column(table: ResultTable, name: str) -> Sequence[Cell]:
    """A table's cells under that name."""
    place = table.columns.index(name)
    return [row[place] for row in table.rows]
