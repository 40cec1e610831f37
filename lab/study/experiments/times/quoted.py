"""Figures quoted from the tables of ``lab/timings/README.md``, which other programs measured at other moments."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

_SECONDS: Final = re.compile(r"(\d+(?:\.\d+)?) (ms|s|min|minutes)\b")
_UNITS: Final = {"ms": 1e-3, "s": 1.0, "min": 60.0, "minutes": 60.0}


@dataclass(frozen=True, slots=True)
class Quote:
    """A cell: its ``section`` ("solve", or "capture/paper" for one inside another), how its row's ``figure`` begins,
    and its ``column``. Of several, the last one counts: tables are written in the order in which they were measured."""

    section: str
    figure: str
    column: str


def quoted(text: str, quotes: Sequence[Quote]) -> tuple[float | None, str]:
    """The seconds that the quotes add up to, and their cells as they stand; None where one has no seconds.

    A cell's seconds are the first time in it. ``text``: the whole page, or nothing.
    """
    cells = [_cell(text, quote) for quote in quotes]
    seconds = [None if cell is None else seconds_in(cell) for cell in cells]
    words = "; ".join(cell for cell in cells if cell)
    known = [value for value in seconds if value is not None]
    return (sum(known) if known and len(known) == len(quotes) else None), words


def seconds_in(cell: str) -> float | None:
    """The first time in some words: "264 ms (once 64 ms)" is 0.264."""
    found = _SECONDS.search(cell)
    return None if found is None else float(found[1]) * _UNITS[found[2]]


def _cell(text: str, quote: Quote) -> str | None:
    found = [
        row[quote.column]
        for section, row in _rows(text)
        if section == quote.section and row.get("figure", "").startswith(quote.figure) and row.get(quote.column)
    ]
    return found[-1] if found else None


def _rows(text: str) -> Iterator[tuple[str, dict[str, str]]]:
    """Every row of every table, by the names of its columns, with the section in which it stands."""
    section, inner, columns = "", "", None
    for line in text.splitlines():
        if line.startswith("## "):
            section, inner = line[3:].strip(), ""
        elif line.startswith("### "):
            inner = "/" + line[4:].strip()
        if not line.startswith("|"):
            columns = None
            continue
        cells = [cell.strip() for cell in line.strip().strip("|").split("|")]
        if columns is None:
            columns = cells
        elif not set(line) <= set("|-: "):
            yield section + inner, dict(zip(columns, cells, strict=False))
