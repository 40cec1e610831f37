"""The demo in rooms with real light: its appearances without and with one photograph, and the troubles it names.

Each demo is a whole job through emulated devices, and its figures are those of its report: photographed, against the
adapted target over what is in reach of it; then against the target as asked. What it names is compared with what
bench.toml says there is. ``BENCH_ROOMS`` and ``BENCH_SEEDS`` choose some; ``BENCH_FOLDER`` keeps the demos, and
measures kept ones again. ``BENCH_OBJECT`` is one of the bench's objects instead of vase and bust, and
``BENCH_PROJECTORS`` how many projectors light it.
"""

from __future__ import annotations

import json
import math
import os
import tempfile
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

from controller.core.errors import TroubleCode
from controller.demo import DemoStage, demo, prepare
from controller.run.progress import Silent
from lab.timings import Row, at_least, at_most
from plugins.emulated.core.truth import NO_BANDS, BenchTruth, ProjectorTruth, read_truth

ROOMS: Final = "room hard"
SEEDS: Final = "1 7 23"
GOALS: Final = {"room": ((1.2, 6.0), (0.9, 5.0)), "hard": (None, (2.0, 8.0))}
"""CIEDE2000, median and 95 %, without and with one photograph."""
Named = tuple[TroubleCode, str | None]
"""A trouble, and the projector that has it."""
BENT_PX: Final = (0.4, 0.6)
"""A lens that displaces no corner of the picture by more than the first counts as straight, from the second on as bent.

Between them is the level from which it is named: either is right there.
"""


def measure(size: str) -> list[Row]:
    """Run every chosen demo that is not there yet, and judge all of them."""
    rooms = os.environ.get("BENCH_ROOMS", ROOMS).split()
    seeds = os.environ.get("BENCH_SEEDS", SEEDS).split()
    thing, count = os.environ.get("BENCH_OBJECT"), int(os.environ.get("BENCH_PROJECTORS", "0")) or None
    rows: list[Row] = []
    with tempfile.TemporaryDirectory(prefix="velatura-bench-") as temporary:
        folder = Path(os.environ.get("BENCH_FOLDER", temporary))
        for room in rooms:
            found = [_figures(folder, DemoStage(size, int(seed), thing, room, count)) for seed in seeds]
            rows += _appearances(room, found)
            rows += _troubles(room, [(read_truth(out / "stage"), figures) for out, figures in found])
    return rows


def _figures(folder: Path, asked: DemoStage) -> tuple[Path, dict[str, Any]]:
    """The folder of a demo, run now or before, and its report.json."""
    extra = [str(one) for one in (asked.thing, asked.projectors) if one is not None]
    out = folder / "-".join((asked.room, asked.size, str(asked.seed), *extra))
    if not (out / "report.json").exists():
        stage = prepare(out, asked)
        demo(stage, reporter=Silent(), cancel=threading.Event())
    return out, json.loads((out / "report.json").read_bytes())


def _appearances(room: str, found: Sequence[tuple[Path, dict[str, Any]]]) -> list[Row]:
    before, after = GOALS.get(room, (None, None))
    rows = []
    for appearance in (one["name"] for one in found[0][1]["appearances"]):
        each = [next(one for one in figures["appearances"] if one["name"] == appearance) for _, figures in found]
        ways = (
            ("no photograph", [one["refined"]["photographs"][0] for one in each], before),
            ("one photograph", [one["adapted"] for one in each], after),
            ("one photograph, as asked", [one["pixels"]["in_reach"] for one in each], None),
            ("all lit pixels, as asked", [one["pixels"]["lit"] for one in each], None),
        )
        for way, values, goals in ways:
            for n, key in enumerate(("delta_e00_median", "delta_e00_p95")):
                seen = [one[key] for one in values]
                name = f"{room}, {appearance}, {way}, {('median', '95 %')[n]}"
                how = "by seed " + ", ".join(f"{value:.2f}" for value in seen)
                rows.append(at_most(name, max(seen), None if goals is None else goals[n], unit="CIEDE2000", how=how))
    return rows


def _troubles(room: str, found: Sequence[tuple[BenchTruth, dict[str, Any]]]) -> list[Row]:
    """Every trouble counts once for each projector that has it; the worst demo counts."""
    named, false = [], []
    for truth, figures in found:
        possible = possible_troubles(truth)
        said = {(TroubleCode(one["code"]), one["projector"]) for one in figures["troubles"]} & set(possible)
        there = {one for one, level in possible.items() if level}
        named.append((len(said & there), len(there), sorted(f"{code} ({whose})" for code, whose in there - said)))
        false.append((len(said - there), sorted(f"{code} ({whose})" for code, whose in said - there)))
    worst = min(named, key=lambda one: one[0] - one[1])
    wrong = max(false)
    missing = "; ".join(worst[2]) or "nothing missing"
    return [
        at_least(f"{room}, troubles named", worst[0], worst[1], unit="troubles", how=missing),
        at_most(f"{room}, named though not there", wrong[0], 0, unit="troubles", how="; ".join(wrong[1])),
    ]


def possible_troubles(truth: BenchTruth) -> dict[Named, float]:
    """All troubles that may be reported, with their levels; 0 where there is none."""
    sensor = truth.camera.sensor
    found: dict[Named, float] = {
        (TroubleCode.CAMERA_GLARE, None): truth.camera.glare,
        (TroubleCode.EXPOSURE_TIMES, None): sensor.shutter_spread,
        (TroubleCode.HOT_PIXELS, None): sensor.hot_pixels,
        (TroubleCode.PIXEL_RESPONSE, None): sensor.response_spread,
        (TroubleCode.GLOSS, None): truth.object.gloss,
        (TroubleCode.SURFACE_SPREAD, None): truth.object.subsurface.share,
    }
    for one in truth.projectors:
        shifts = [abs(px) for shift in one.panels.shift_px for px in shift]
        found |= {
            (TroubleCode.UNSTEADY_LAMP, one.name): one.lamp.flicker,
            (TroubleCode.PANEL_ALIGNMENT, one.name): max(shifts),
            (TroubleCode.COLOUR_FRINGES, one.name): max(abs(size) for size in one.panels.magnified),
            (TroubleCode.WHITE_SEGMENT, one.name): one.light.white_segment,
            (TroubleCode.PROJECTOR_GLARE, one.name): one.light.glare,
            (TroubleCode.PAINT_COLOURS, one.name): float(one.light.bands_nm != NO_BANDS),
        }
        if not BENT_PX[0] <= (bend_px := _bend_px(one)) < BENT_PX[1]:
            found[TroubleCode.LENS_DISTORTION, one.name] = float(bend_px >= BENT_PX[1])
    return found


def _bend_px(projector: ProjectorTruth) -> float:
    """By which its lens displaces the corner that it displaces most."""
    lens = projector.lens
    (width, height), (x, y) = lens.size_px, lens.centre_px
    away = math.hypot(max(x, width - x), max(y, height - y)) / lens.focal_px
    return abs(lens.distortion[0]) * away**3 * lens.focal_px


__all__: Sequence[str] = ("measure", "possible_troubles")
