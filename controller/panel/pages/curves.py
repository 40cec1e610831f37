"""Values over time as lines of a drawing: positions for the pages' SVG, and the series of results that they show."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from controller.kiosk.state import DriftCheck, Grade
from controller.kiosk.values import Comparison, Sharpness
from controller.panel.words import figures

LEFT, RIGHT, TOP, BOTTOM = 44, 452, 16, 156
"""The drawing's frame, in a view of 460 x 180."""
TICKS: Final = (0.0, 0.5, 1.0)
STEPS: Final = (1.0, 2.0, 5.0)


@dataclass(frozen=True, slots=True)
class Value:
    """One measured value at Unix seconds; ``label`` is written above it."""

    unix_s: float
    value: float
    label: str = ""


@dataclass(frozen=True, slots=True)
class Dot:
    """A value at its place."""

    x: float
    y: float
    unix_s: float
    text: str
    label: str


@dataclass(frozen=True, slots=True)
class Line:
    """One series: ``points`` as a polyline has them."""

    name: str
    points: str
    dots: tuple[Dot, ...]


@dataclass(frozen=True, slots=True)
class Tick:
    y: float
    text: str


@dataclass(frozen=True, slots=True)
class Curve:
    """All series in one frame, from 0 up to a round number."""

    lines: tuple[Line, ...]
    ticks: tuple[Tick, ...]
    first_s: float
    last_s: float


def curve(series: Sequence[tuple[str, Sequence[Value]]], unit: str = "") -> Curve | None:
    """Lines of values from left to right by time; None without any value."""
    known = [(name, sorted(values, key=lambda one: one.unix_s)) for name, values in series if values]
    every = [one for _, values in known for one in values]
    if not every:
        return None
    first, last = min(one.unix_s for one in every), max(one.unix_s for one in every)
    top = _round_up(max(one.value for one in every))
    digits = 0 if top >= 10 else 1 if top >= 1 else 2
    lines = []
    for name, values in known:
        dots = tuple(
            Dot(
                round(LEFT + (RIGHT - LEFT) * ((one.unix_s - first) / (last - first) if last > first else 0.5), 1),
                round(BOTTOM - (BOTTOM - TOP) * min(max(one.value, 0.0), top) / top, 1),
                one.unix_s, _text(one.value, unit, digits + 1), one.label,
            )
            for one in values
        )  # fmt: skip
        lines.append(Line(name, " ".join(f"{dot.x},{dot.y}" for dot in dots), dots))
    ticks = tuple(Tick(BOTTOM - (BOTTOM - TOP) * share, _text(share * top, unit, digits)) for share in TICKS)
    return Curve(tuple(lines), ticks, first, last)


def _text(value: float, unit: str, digits: int) -> str:
    return figures.percent(value / 100, digits) if unit == "%" else figures.number(value, digits)


def _round_up(value: float) -> float:
    """The smallest 1, 2 or 5 times a power of ten that is not below ``value``."""
    power = 1e-3
    while power < 1e9:
        for step in STEPS:
            if step * power >= value:
                return step * power
        power *= 10
    return max(value, 1.0)


def grade_errors(grades: Sequence[Grade]) -> list[tuple[str, list[Value]]]:
    """The largest predicted error of each calibration, with its letter."""
    rows = [Value(one.unix_s, one.worst_percent, one.grade) for one in grades if one.worst_percent is not None]
    return [("", rows)]


def drift_moves(drifts: Sequence[DriftCheck]) -> list[tuple[str, list[Value]]]:
    """How far the picture had moved at each drift check."""
    return [("", [Value(one.unix_s, one.moved_px) for one in drifts if one.moved_px is not None])]


def colour_differences(compared: Sequence[Comparison]) -> list[tuple[str, list[Value]]]:
    """The median colour difference of each photographed appearance."""
    return [(one.name, [Value(then.unix_s, then.delta_e) for then in one.history]) for one in compared]


def sharpness_of(history: Sequence[Sharpness], projectors: Sequence[str]) -> list[tuple[str, list[Value]]]:
    """The focus of each projector in each of the test shots, in per cent; ``projectors`` in the picture's order, so
    that each has its colour there.
    """
    names = dict.fromkeys((*projectors, *(name for one in history for name in one.projectors)))
    return [
        (name, [Value(one.unix_s, 100 * one.projectors[name]) for one in history if name in one.projectors])
        for name in names
    ]


def bars(shares: Sequence[float]) -> str:
    """The outline of a histogram as an SVG path in a view of 300 x 90; the tallest bar fills it."""
    tallest = max(shares, default=0.0) or 1.0
    wide = 300 / max(1, len(shares))
    parts = ["M0 90"]
    for number, share in enumerate(shares):
        # The square root shows bars of a few pixels beside one of most.
        high = round(90 - 84 * (share / tallest) ** 0.5, 1)
        parts.append(f"V{high}H{round((number + 1) * wide, 1)}")
    return "".join(parts) + "V90Z"
