"""``python -m lab.timings NAME [--size small|medium|paper] [--json FILE]``: measure one area and print a table.

Exit codes: 0 measured (whether or not the goals hold: a slow machine fails nothing), 2 wrong use.
"""

from __future__ import annotations

import argparse
import dataclasses
import importlib
import json
import platform
import sys
from collections.abc import Sequence
from pathlib import Path

from lab.timings import SIZES, Row, areas, machine


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one area's ``measure`` and report its rows."""
    parser = argparse.ArgumentParser(prog="python -m lab.timings", description="Measure one area.")
    parser.add_argument("name", choices=areas(), help="what to measure")
    parser.add_argument("--size", default="small", help=f"one of {', '.join(SIZES)}; memory has more")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the rows to FILE as well")
    options = parser.parse_args(arguments)
    area = importlib.import_module(areas()[options.name])
    sizes = getattr(area, "SIZES", SIZES)
    if options.size not in sizes:
        parser.error(f"{options.name} has no size {options.size}; choose one of {', '.join(sizes)}")
    rows: list[Row] = area.measure(options.size)
    print_table(options.name, options.size, rows)
    if options.json is not None:
        options.json.parent.mkdir(parents=True, exist_ok=True)
        options.json.write_text(json.dumps([dataclasses.asdict(row) for row in rows], indent=2) + "\n")
    return 0


def print_table(name: str, size: str, rows: Sequence[Row]) -> None:
    """The rows as a Markdown table, with the machine they were measured on."""
    host = machine()
    print(f"{name}, size {size}, {host['cores']} cores, {host['memory_bytes'] / 2**30:.0f} GiB, {platform.machine()}\n")
    print("| figure | value | goal | holds | how |\n|---|---|---|---|---|")
    for row in rows:
        goal = "" if row.goal is None else f"{row.goal:g} {row.unit}"
        holds = "" if row.holds is None else ("yes" if row.holds else "no")
        print(f"| {row.figure} | {row.value:.4g} {row.unit} | {goal} | {holds} | {row.how} |")


if __name__ == "__main__":
    sys.exit(main())
