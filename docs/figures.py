"""Measured figures in documents: each has one place, from which it is written into every document that names it.

    python -m docs.figures          # says which documents differ, and ends with 1 if any does
    python -m docs.figures write    # writes them

A document names a figure as ``<!--figure NAME-->VALUE<!--/figure-->``; the marks do not show. The same thing told in
words without marks is found by ``Figure.told``, and has to be the same, too. Pages of ``velatura study`` are made from
``docs/study/data`` alone, so they are compared as a whole.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from controller.core.storage import write_atomically
from lab.study.catalogue import EXPERIMENTS
from lab.study.output.figures import figure, span
from lab.study.output.keeping import StoredStudy, read_study
from lab.study.output.pages import DATA, INDEX, index_page, page

ROOT: Final = Path(__file__).resolve().parents[1]
STUDY: Final = "docs/study"
MARK: Final = re.compile(r"<!--figure ([a-z0-9-]+)-->(.*?)<!--/figure-->", re.DOTALL)
NUMBER: Final = r"(\d+(?:\.\d+)?)"


@dataclass(frozen=True, slots=True)
class Figure:
    """``value``: from its one place below ``root``; ``told``: patterns of the same thing in words, its number a group.

    Every match of a pattern in a document has to be the value; one that matches nowhere is of no use and is told.
    """

    value: Callable[[Path], str]
    told: tuple[str, ...] = ()


def study(root: Path, name: str) -> StoredStudy:
    """The kept results of an experiment."""
    return read_study(root / STUDY / DATA / f"{name}.json")


def _stages(root: Path, name: str) -> str:
    """Of which size, room and seeds an experiment's results are."""
    kept = study(root, name)
    several = "s" * (len(kept.seeds) > 1)
    facts = kept.results[0].facts
    return f"size {facts['size']}, room {facts['room']}, seed{several} {', '.join(map(str, kept.seeds))}"


def _times(root: Path, asked: str) -> str:
    """Least to most "N times" in what the criteria of the appearances reached that ask so."""
    found: list[float] = []
    for one in study(root, "appearances").criteria:
        if asked in one.asked:
            for reached in one.reached.values():
                found += [float(v) for v in re.findall(rf"{NUMBER} times", reached)]
                found += [float(v) for v in re.findall(rf"{NUMBER} \(", reached)]
    return span(list(found), ".1f")


def _own_exposure(root: Path) -> str:
    table = study(root, "appearances").table("errors")
    way, place = table.columns.index("way"), table.columns.index("exposure")
    return span([row[place] for row in table.rows if row[way] == "one projector, dimmed"], ".2f")


def _errors(root: Path, compared: str) -> str:
    """Least to most of the appearances' medians over that set of pixels."""
    table = study(root, "appearances").table("errors")
    way, over, median = (table.columns.index(name) for name in ("way", "compared", "CIEDE2000 median"))
    return span([row[median] for row in table.rows if (row[way], row[over]) == ("ours", compared)], ".2f")


def _photographs(root: Path) -> str:
    """Of a projector of the paper's size: the last row of the note's table, rounded up."""
    (note,) = (root / "docs" / "notes").glob("*-0009-*.md")
    (_, now) = re.findall(r"\*\*([\d.]+)\*\*", note.read_text())
    return str(-int(-float(now) // 1))


def _residual(root: Path, projectors: int) -> str:
    """At our exposure where the page knows two, else at the only one."""
    kept = study(root, "residual")
    two = "as bright as" in kept.table("residual").columns
    row = f"all can make it, {projectors}" if two else f"{projectors}"
    return figure(kept, "residual", row, "photographed, mean", ".4f")


FIGURES: Final[Mapping[str, Figure]] = {
    "appearances-stages": Figure(lambda root: _stages(root, "appearances")),
    "residual-stages": Figure(lambda root: _stages(root, "residual")),
    "photographs": Figure(_photographs, (rf"{NUMBER} photographs per projector of the paper's size",)),
    "nearer-at-our-exposure": Figure(lambda root: _times(root, "nearer than one projector at the same exposure")),
    "nearer-at-its-exposure": Figure(lambda root: _times(root, "at the exposure that this one can reach")),
    "its-exposure": Figure(_own_exposure),
    "error-in-reach": Figure(lambda root: _errors(root, "in reach")),
    "error-of-all-lit": Figure(lambda root: _errors(root, "all lit pixels")),
    **{f"residual-{n}": Figure(lambda root, n=n: _residual(root, n)) for n in (1, 2, 3)},  # type: ignore[misc]
}


def documents(root: Path) -> Iterator[Path]:
    """Every document that people read, but for the pages that are made as a whole and those made by the build."""
    made = {f"{experiment.name}.md" for experiment in EXPERIMENTS} | {INDEX}
    for path in [*root.glob("*.md"), *(root / "docs").rglob("*.md"), *(root / "lab" / "timings").glob("*.md")]:
        beside = path.relative_to(root).as_posix()
        if not (beside.startswith("docs/generated/") or (beside.startswith(f"{STUDY}/") and path.name in made)):
            yield path


def written(text: str, root: Path) -> str:
    """``text`` with its marked figures as they are now. Raises KeyError for an unknown name."""
    return MARK.sub(lambda mark: f"<!--figure {mark[1]}-->{FIGURES[mark[1]].value(root)}<!--/figure-->", text)


def pages(root: Path) -> Iterator[tuple[Path, str]]:
    """The pages of the study, as their data say."""
    kept = {}
    for experiment in EXPERIMENTS:
        path = root / STUDY / DATA / f"{experiment.name}.json"
        kept[experiment] = read_study(path) if path.exists() else None
        if (one := kept[experiment]) is not None:
            yield root / STUDY / f"{experiment.name}.md", page(experiment, one)
    yield root / STUDY / INDEX, index_page(list(kept.items()))


def differing(root: Path) -> Iterator[tuple[Path, str, str]]:
    """What does not agree: the file, what is wrong, and its right content where that is known, else nothing."""
    for path, text in pages(root):
        if not path.exists() or path.read_text() != text:
            yield path, "is not what docs/study/data says", text
    texts = {path: path.read_text() for path in documents(root)}
    for path, text in texts.items():
        try:
            new = written(text, root)
        except KeyError as error:
            yield path, f"names a figure that is not known: {error}", ""
            continue
        if new != text:
            yield path, "has a figure that is not the measured one", new
    named = {mark[1] for text in texts.values() for mark in MARK.finditer(text)}
    for name, one in FIGURES.items():
        if name not in named and not one.told:
            yield root / "docs" / "figures.py", f"{name} is in no document", ""
        for pattern in one.told:
            yield from _told(root, texts, name, pattern)


def _told(root: Path, texts: Mapping[Path, str], name: str, pattern: str) -> Iterator[tuple[Path, str, str]]:
    """Documents that tell a figure otherwise, without a mark; and a pattern that nothing is told by any more."""
    value = FIGURES[name].value(root)
    found = [(path, told) for path, text in texts.items() for told in re.finditer(pattern, _plain(text))]
    for path, told in found:
        if told[1] != value:
            yield path, f"says {told[0]!r}, and {name} is {value}", ""
    if not found:
        yield root / "docs" / "figures.py", f"nothing is said as {pattern!r}", ""


def _plain(text: str) -> str:
    """Without marks, and every line break a space."""
    return " ".join(re.sub(r"<!--.*?-->", "", text).split())


def main(arguments: list[str]) -> int:
    wrong = list(differing(ROOT))
    for path, why, text in wrong:
        if arguments == ["write"] and text:
            write_atomically(path, text.encode())
            continue
        sys.stderr.write(f"{path.relative_to(ROOT)} {why}.\n")
    left = [path for path, _, text in wrong if not (arguments == ["write"] and text)]
    if left:
        sys.stderr.write("Run `make figures`, then look at what it changed.\n")
    return 1 if left else 0


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
