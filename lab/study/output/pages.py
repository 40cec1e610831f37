"""A page an experiment, and an index of them, as Markdown with tables and pictures."""

from __future__ import annotations

import csv
import io
import shutil
from collections.abc import Iterable, Sequence
from pathlib import Path

from controller.core.storage import write_atomically
from lab.study.output.keeping import SEEDS, JudgedCriterion, StoredStudy, read_result, read_study, with_seed
from lab.study.output.words import description, miss_reason
from lab.study.values import Cell, Experiment, ResultTable

DATA, PICTURES, INDEX = "data", "pictures", "README.md"
HOLDS = {True: "yes", False: "**no**", None: "open"}

EARLIER = (
    "> **Note.** These results are of an earlier version of the experiment. Where the text differs from them, it is "
    "of the present one. The command at the end of the page makes them again."
)


def publish(made: Iterable[Path], pages: Path, experiments: Sequence[Experiment]) -> Path:
    """Take over results (their JSON files) with their pictures into ``pages``, and write all pages; return the index.

    What ``pages`` holds of other experiments stays, and is in the index, too.
    """
    for folder in (pages / DATA, pages / PICTURES):
        folder.mkdir(parents=True, exist_ok=True)
    for path in made:
        new = read_result(path)
        place = pages / DATA / path.name
        kept = with_seed(read_study(place) if place.exists() else None, new)
        for old in [*(pages / PICTURES).iterdir(), *(pages / DATA).glob("*.csv")]:
            superseded = old.suffix == ".csv" or kept.seeds[0] == new.seed
            if _owner(old.name, experiments) == kept.name and superseded:
                old.unlink()
        if kept.seeds[0] == new.seed:
            for file, _ in new.figures:
                shutil.copyfile(path.with_name(file), pages / PICTURES / file)
        for table in kept.tables:
            write_atomically(pages / DATA / f"{kept.name}-{table.name}.csv", _csv(table).encode())
        write_atomically(place, kept.encoded())
    return write_pages(pages, experiments)


def _owner(file: str, experiments: Sequence[Experiment]) -> str:
    """The experiment that a picture or table is of: the longest of those names that the file's begins with."""
    return max((one.name for one in experiments if file.startswith(f"{one.name}-")), key=len, default="")


def write_pages(pages: Path, experiments: Sequence[Experiment]) -> Path:
    """Write the page of each experiment whose result lies in ``pages``, and the index; return the index."""
    rows = []
    for experiment in experiments:
        path = pages / DATA / f"{experiment.name}.json"
        kept = read_study(path) if path.exists() else None
        rows.append((experiment, kept))
        if kept is not None:
            write_atomically(pages / f"{experiment.name}.md", page(experiment, kept).encode())
    index = pages / INDEX
    write_atomically(index, index_page(rows).encode())
    return index


def up_to_date(experiment: Experiment, kept: StoredStudy) -> bool:
    """Whether the results are of the experiment as it is now."""
    return bool(kept.results[0].facts.get("code") == experiment.code_sha256())


def page(experiment: Experiment, kept: StoredStudy) -> str:
    """The page of one experiment, its pictures those of the lowest seed."""
    first = kept.results[0]
    size = first.facts.get("size", "small")
    parts = [
        f"# {experiment.title}",
        f"{experiment.paper}. Must show: {experiment.shows}",
        _facts(kept),
        "" if up_to_date(experiment, kept) else EARLIER,
        description(kept.name),
        first.text,
        "## Criteria and results",
        _criteria(kept),
    ]
    seed = f" Seed {first.seed}." if len(kept.seeds) > 1 else ""
    for file, caption in first.figures:
        parts.append(f"![{_plain(caption)}]({PICTURES}/{file})\n\n*{caption}{seed}*")
    for table in kept.tables:
        parts += [f"## {table.title}", markdown(table.columns, table.rows)]
        parts.append(f"[{DATA}/{kept.name}-{table.name}.csv]({DATA}/{kept.name}-{table.name}.csv)")
    seeds = " ".join(f"--seed {one}" for one in kept.seeds)
    parts.append(f"Made by `velatura study {kept.name} --size {size} {seeds}`; all pages: [index]({INDEX}).")
    return "\n\n".join(part for part in parts if part) + "\n"


def index_page(rows: Sequence[tuple[Experiment, StoredStudy | None]]) -> str:
    """The index: each experiment with what it asks and how much of it holds."""
    lines = []
    for experiment, kept in rows:
        if kept is None:
            lines.append((experiment.title, experiment.paper, "not done", "", "", ""))
            continue
        facts = kept.results[0].facts
        lines.append((
            f"[{experiment.title}]({experiment.name}.md)", experiment.paper,
            _counted(kept) + ("" if up_to_date(experiment, kept) else "; earlier version"),
            str(facts.get("size", "")), str(facts.get("room", "")), ", ".join(map(str, kept.seeds)),
        ))  # fmt: skip
    missed = [
        f"- [{experiment.title}]({experiment.name}.md): {one.asked}: {_reached(one)}."
        for experiment, kept in rows
        if kept is not None
        for one in kept.criteria
        if one.holds is False
    ]
    head = (
        "`velatura study` repeats the paper's evaluation on emulated stages whose optics share no code with "
        "the controller. Everything uses a calibration and is judged by photographs; nothing uses the true "
        "values of a stage. Each experiment has a page, with its tables under `data/`. The command writes "
        "the pages; `docs/study/adding.md` describes how to add an experiment.\n\n"
        f"A criterion holds only if it holds for {SEEDS} seeds: each seed is another stage, with other lenses, "
        "lamps, positions and noise. One that fails for a seed is missed. One that held so far, for fewer seeds, is "
        "*open*."
    )
    parts = [
        "# The paper's experiments, repeated",
        head,
        markdown(("experiment", "after", "criteria", "size", "room", "seeds"), lines),
    ]
    if missed:
        parts += ["## Missed criteria", "\n".join(missed)]
    return "\n\n".join(parts) + "\n"


def _counted(kept: StoredStudy) -> str:
    holds = [one.holds for one in kept.criteria]
    parts = [f"{holds.count(True)} of {len(holds)} hold"]
    parts += [f"{holds.count(value)} {word}" for value, word in ((False, "missed"), (None, "open"))
              if holds.count(value)]  # fmt: skip
    return ", ".join(parts)


def _reached(one: JudgedCriterion) -> str:
    if len(one.reached) == 1:
        return next(iter(one.reached.values()))
    return "; ".join(f"seed {seed}: {text}" for seed, text in one.reached.items())


def _facts(kept: StoredStudy) -> str:
    words = {
        "scene": "Stage: {}",
        "size": "size {}",
        "room": "room {}",
        "photographs": "{} photographs",
        "seconds": "{} s of work",
    }
    facts = kept.results[0].facts
    phrases = [text.format(facts[key]) for key, text in words.items() if key in facts]
    if "seed" in facts:
        several = len(kept.seeds) > 1
        phrases.append(f"seed{'s' * several} {', '.join(map(str, kept.seeds))}")
        if several and len(phrases) > 2:
            phrases.append("photographs and seconds of the first")
    return "; ".join(phrases) + "." if phrases else ""


def _criteria(kept: StoredStudy) -> str:
    rows = []
    for one in kept.criteria:
        reason = "" if one.holds is not False else f"{one.reason} {miss_reason(kept.name, one.asked)}"
        each = [one.reached.get(seed, "") for seed in kept.seeds]
        rows.append((one.asked, *each, HOLDS[one.holds], reason.strip()))
    reached = ["reached"] if len(kept.seeds) == 1 else [f"seed {seed}" for seed in kept.seeds]
    return markdown(("asked", *reached, "holds", "why not"), rows)


def markdown(columns: Sequence[str], rows: Sequence[Sequence[Cell]]) -> str:
    """A table."""
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
