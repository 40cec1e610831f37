"""A page an experiment, and an index of them, as Markdown with tables and pictures."""

from __future__ import annotations

import csv
import io
import shutil
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from controller.core.storage import write_atomically
from controller.study.output.keeping import StoredResult, read_result
from controller.study.output.words import description, miss_reason
from controller.study.values import Cell, Experiment, ResultTable

DATA, PICTURES, INDEX = "data", "pictures", "README.md"
HOLDS = {True: "yes", False: "**no**", None: "not known"}


def publish(made: Iterable[Path], pages: Path, experiments: Sequence[Experiment]) -> Path:
    """Take over results (their JSON files) with their pictures into ``pages``, and write all pages; return the index.

    What ``pages`` holds of other experiments stays, and is in the index, too.
    """
    for folder in (pages / DATA, pages / PICTURES):
        folder.mkdir(parents=True, exist_ok=True)
    for path in made:
        kept = read_result(path)
        for old in [*(pages / PICTURES).iterdir(), *(pages / DATA).glob("*.csv")]:
            if _owner(old.name, experiments) == kept.name:
                old.unlink()
        for file, _ in kept.figures:
            shutil.copyfile(path.with_name(file), pages / PICTURES / file)
        for table in kept.tables:
            write_atomically(pages / DATA / f"{kept.name}-{table.name}.csv", _csv(table).encode())
        write_atomically(pages / DATA / path.name, path.read_bytes())
    return write_pages(pages, experiments)


def _owner(file: str, experiments: Sequence[Experiment]) -> str:
    """The experiment that a picture or table is of: the longest of those names that the file's begins with."""
    return max((one.name for one in experiments if file.startswith(f"{one.name}-")), key=len, default="")


def write_pages(pages: Path, experiments: Sequence[Experiment]) -> Path:
    """Write the page of each experiment whose result lies in ``pages``, and the index; return the index."""
    rows = []
    for experiment in experiments:
        path = pages / DATA / f"{experiment.name}.json"
        kept = read_result(path) if path.exists() else None
        rows.append((experiment, kept))
        if kept is not None:
            write_atomically(pages / f"{experiment.name}.md", page(experiment, kept).encode())
    index = pages / INDEX
    write_atomically(index, index_page(rows).encode())
    return index


def page(experiment: Experiment, kept: StoredResult) -> str:
    """The page of one experiment."""
    parts = [
        f"# {experiment.title}",
        f"{experiment.paper}. Must show: {experiment.shows}",
        _facts(kept.facts),
        description(kept.name),
        kept.text,
        "## Criteria and results",
        _criteria(kept),
    ]
    for file, caption in kept.figures:
        parts.append(f"![{_plain(caption)}]({PICTURES}/{file})\n\n*{caption}*")
    for table in kept.tables:
        parts += [f"## {table.title}", _markdown(table.columns, table.rows)]
        parts.append(f"[{DATA}/{kept.name}-{table.name}.csv]({DATA}/{kept.name}-{table.name}.csv)")
    parts.append(
        f"Made by `velatura study {kept.name} --size {kept.facts.get('size', 'small')}`; all pages: [index]({INDEX})."
    )
    return "\n\n".join(part for part in parts if part) + "\n"


def index_page(rows: Sequence[tuple[Experiment, StoredResult | None]]) -> str:
    """The index: each experiment with what it asks and how much of it holds."""
    lines = []
    for experiment, kept in rows:
        if kept is None:
            lines.append((experiment.title, experiment.paper, "not done", ""))
            continue
        decided = [criterion.holds for criterion in kept.criteria if criterion.holds is not None]
        lines.append((
            f"[{experiment.title}]({experiment.name}.md)", experiment.paper,
            f"{sum(decided)} of {len(decided)} hold", str(kept.facts.get("size", "")),
        ))  # fmt: skip
    missed = [
        f"- [{experiment.title}]({experiment.name}.md): {one.asked}: {one.reached}."
        for experiment, kept in rows
        if kept is not None
        for one in kept.criteria
        if one.holds is False
    ]
    head = (
        "`velatura study` repeats the paper's evaluation on emulated stages whose optics share no code with "
        "the controller. Everything uses a calibration and is judged by photographs; nothing uses the true "
        "values of a stage. Each experiment has a page, with its tables under `data/`. The command writes "
        "the pages; `docs/study/adding.md` describes how to add an experiment."
    )
    parts = [
        "# The paper's experiments, repeated",
        head,
        _markdown(("experiment", "after", "criteria", "size"), lines),
    ]
    if missed:
        parts += ["## Missed criteria", "\n".join(missed)]
    return "\n\n".join(parts) + "\n"


def _facts(facts: Mapping[str, object]) -> str:
    words = {
        "scene": "Stage: {}",
        "size": "size {}",
        "seed": "seed {}",
        "photographs": "{} photographs",
        "seconds": "{} s of work",
    }
    decided = [text.format(facts[key]) for key, text in words.items() if key in facts]
    return "; ".join(decided) + "." if decided else ""


def _criteria(kept: StoredResult) -> str:
    rows = []
    for one in kept.criteria:
        reason = "" if one.holds else f"{one.reason} {miss_reason(kept.name, one.asked)}".strip()
        rows.append((one.asked, one.reached, HOLDS[one.holds], reason))
    return _markdown(("asked", "reached", "holds", "why not"), rows)


def _markdown(columns: Sequence[str], rows: Sequence[Sequence[Cell]]) -> str:
    lines = ["| " + " | ".join(map(_plain, columns)) + " |", "|" + "---|" * len(columns)]
    lines += ["| " + " | ".join(_cell(cell) for cell in row) + " |" for row in rows]
    return "\n".join(lines)


def _cell(cell: Cell) -> str:
    if cell is None:
        return ""
    if isinstance(cell, bool):
        return "yes" if cell else "no"
    return f"{cell:.4g}" if isinstance(cell, float) else _plain(str(cell))


def _plain(text: str) -> str:
    return text.replace("|", "\\|").replace("\n", " ")


def _csv(table: ResultTable) -> str:
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(table.columns)
    writer.writerows([f"{cell:.6g}" if isinstance(cell, float) else cell for cell in row] for row in table.rows)
    return out.getvalue()
