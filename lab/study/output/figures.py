"""Figures for sentences, taken from kept results, so that no document holds a number of its own."""

from __future__ import annotations

from lab.study.output.keeping import StoredStudy
from lab.study.values import Cell


def figure(kept: StoredStudy, table: str, row: str, column: str, form: str) -> str:
    """A cell over all seeds, as text; over seeds that differ it is "least to most".

    ``row``: a row's first cell, or several of its first cells with a comma and a space between them; ``form`` is
    Python's, as ".2f". Raises KeyError if there is no such table, row or column.
    """
    found = kept.table(table)
    try:
        place = found.columns.index(column)
    except ValueError as error:
        raise KeyError(f"{kept.name}: the table {table} has no column {column}") from error
    cells = [each[place] for each in found.rows if _names(each[1:], row)]
    if not cells:
        raise KeyError(f"{kept.name}: the table {table} has no row {row}")
    return span(cells, form)


def span(cells: list[Cell], form: str) -> str:
    """The least and the most of numbers, or one of them where they look alike."""
    numbers = sorted(float(cell) for cell in cells if isinstance(cell, int | float))
    if not numbers:
        return str(cells[0])
    least, most = (format(value, form) for value in (numbers[0], numbers[-1]))
    return least if least == most else f"{least} to {most}"


def _names(cells: tuple[Cell, ...], row: str) -> bool:
    """Whether a row's first cell, or its first few, are ``row``."""
    start = ""
    for cell in cells:
        start = f"{start}, {cell}" if start else f"{cell}"
        if start == row:
            return True
        if not row.startswith(start):
            return False
    return False
