"""report.html and report.json from what a run measured."""

from __future__ import annotations

import base64
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib import resources
from pathlib import Path
from typing import Any, Final

import jinja2

from controller.core.arrays import ByteImage
from controller.core.plotting import font_file
from controller.core.storage import write_atomically
from controller.optics.solve.reach.feasibility import HELD_BACK, SMALL_PART
from controller.optics.solve.result.metrics import as_rows
from controller.stage.artefacts.names import REPORT_FIGURES, REPORT_PAGE
from controller.stage.artefacts.solved import of_asked
from controller.stage.report.pictures import ERROR_SCALE_DELTA_E, data_uri, scale_bar


@dataclass(frozen=True, slots=True)
class ReportPicture:
    """``large``: it holds small text, and wants more than a column of a strip. ``points``: a list below it."""

    caption: str
    image: ByteImage
    note: str = ""
    large: bool = False
    points: tuple[str, ...] = ()


Gallery = tuple[str, str, tuple[ReportPicture, ...]]
"""A title, a text, and pictures."""


@dataclass(frozen=True, slots=True)
class Nearness:
    """How near a photograph is to its target: in words, as the median CIEDE2000, and on which part of the object."""

    words: str
    delta_e: float
    part: str


NEARNESS: Final = (
    (1.0, "No visible difference"),
    (2.0, "Very near"),
    (4.0, "Near"),
    (8.0, "A visible difference"),
    (math.inf, "Not near"),
)
"""Words for a median colour difference (CIEDE2000) up to a limit. 1 is about the smallest that a trained eye sees."""
WHOLE: Final = 0.95
"""Share of the object in reach above which nothing is said of the rest."""


def nearness(delta_e: float, reachable_share: float | None) -> Nearness:
    """The words for a median difference over the pixels in reach, which are ``reachable_share`` of the object."""
    words = next((words for limit, words in NEARNESS if delta_e <= limit), NEARNESS[-1][1])
    if reachable_share is None or reachable_share >= WHOLE:
        return Nearness(words, delta_e, "")
    return Nearness(words, delta_e, f"on {reachable_share:.0%} of the object")


@dataclass(frozen=True, slots=True)
class PictureRow:
    """One appearance on the page. The first three pictures are seen at once: before, target, achieved.

    The other pictures and the figures, name and text, are below a fold.
    """

    title: str
    near: Nearness
    figures: tuple[tuple[str, str], ...]
    pictures: tuple[ReportPicture, ...]


@dataclass(frozen=True, slots=True)
class Goal:
    """A figure with what was asked for; ``holds`` None where nothing was asked. ``note`` stands in small below it."""

    name: str
    value: str
    goal: str = ""
    holds: bool | None = None
    note: str = ""


@dataclass(frozen=True, slots=True)
class PageTable:
    """Figures side by side: ``header`` and every row have one more column than what is compared."""

    title: str
    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


@dataclass(frozen=True, slots=True)
class Page:
    title: str
    summary: str
    goals: tuple[Goal, ...]
    rows: tuple[PictureRow, ...]
    galleries: tuple[Gallery, ...] = ()
    steps: tuple[tuple[str, float], ...] = ()
    facts: Mapping[str, str] = field(default_factory=dict)
    tables: tuple[PageTable, ...] = ()
    troubles: tuple[str, ...] = ()


def refined_row(figures: Any) -> tuple[tuple[str, str], ...]:
    """What refining an appearance achieved, as a row of its figures; none where it was not refined."""
    if figures is None or figures["before"] is None:
        return ()
    count = len(figures["photographs"])
    change = f"{figures['before']:.2f} to {figures['after']:.2f}{of_asked(figures).removesuffix(',')}"
    text = f"{change}, {count} photograph{'s' * (count != 1)}"
    return (("refined", text),)


def judged_rows(figures: Mapping[str, Any]) -> tuple[tuple[str, str], ...]:
    """An appearance's error by sets of pixels and of its adapted target, its ghosting, and what keeps it dark."""
    rows = as_rows(figures["pixels"]) if figures["pixels"] is not None else []
    if (ghost := figures["ghosting"]) is not None:
        both = ghost["both"]
        rows.append(("ghosting", f"correlation {both['correlation']:.2f}, {100 * both['share']:.1f} % of the pattern"))
    if (adapted := figures["adapted"]) is not None:
        rows.append(("adapted target, median / 95 %", f"{adapted['delta_e00_median']:.2f} / "
                     f"{adapted['delta_e00_p95']:.2f}; {100 * adapted['reachable_share']:.1f} % in reach"))  # fmt: skip
    if (held_back := figures["held_back"]) is not None and held_back > HELD_BACK:
        rows.append(
            ("white", f"could be {held_back:.2f} times as bright without the darkest {SMALL_PART:.0%} of the object")
        )
    return tuple(rows)


def render(page: Page) -> str:
    """The page as one self-contained HTML file; every text is escaped, since device names are hostile input."""
    source = resources.files("controller.stage.report").joinpath("report.html").read_text("utf-8")
    environment = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True)
    environment.filters["uri"] = data_uri
    environment.filters["commands"] = _commands
    return environment.from_string(source).render(
        page=page,
        scale=scale_bar(),
        typeface=_typeface(),
        scale_top=ERROR_SCALE_DELTA_E,
        slowest=max((s for _, s in page.steps), default=1.0),
    )


def _commands(text: str) -> list[tuple[str, bool]]:
    """The parts of ``text``, and whether each is a command, which stands in backticks."""
    parts = text.split("`")
    return [(part, n % 2 == 1) for n, part in enumerate(parts)] if len(parts) % 2 else [(text, False)]


def _typeface() -> str:
    """The letters of the plots for the page, too; inside it, because a report is one file."""
    font = font_file().read_bytes()
    return f"data:font/ttf;base64,{base64.b64encode(font).decode()}"


def write_report(folder: Path, page: Page, figures: Mapping[str, Any]) -> tuple[Path, Path]:
    """Write ``report.html`` and ``report.json`` (keys: docs/reference/report.md) into ``folder``; return both paths.

    A figure that is no finite number becomes null: what could not be measured must not cost what could.
    """
    html, machine = folder / REPORT_PAGE, folder / REPORT_FIGURES
    write_atomically(machine, (json.dumps(_finite(figures), indent=2, allow_nan=False) + "\n").encode())
    write_atomically(html, render(page).encode())
    return html, machine


def _finite(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _finite(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(inner) for inner in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
