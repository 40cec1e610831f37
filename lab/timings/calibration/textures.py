"""Where the lines of a grid that was painted on a mesh's sheet fall on the object, in the light of the stage.

The bench's statue is calibrated and its scan laid on it as the demo does; an appearance of kind ``texture`` shows the
grid, refined with one photograph. The truth's own mesh says which place of the sheet each camera pixel sees.
``BENCH_SEEDS`` chooses seeds; ``BENCH_FOLDER`` keeps the stages, and measures kept ones again.
"""

from __future__ import annotations

import os
import tempfile
import threading
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final

import cv2
import numpy as np

from controller.core.arrays import Float64, Mask
from controller.demo import SCAN, DemoStage, prepare
from controller.run.progress import Silent
from controller.stage.artefacts.calibrated import Calibrated
from controller.stage.artefacts.solved import read_solved
from controller.stage.services.calibrate import AppearanceOrder, calibrate, make_appearances
from controller.stage.services.refine import Refinement
from controller.stage.services.register import MeshOrder, register
from controller.stage.sessions.bench import BenchProcess
from controller.stage.sessions.calibrations import finished_calibrations
from controller.stage.sessions.check import check_stage
from controller.stage.sessions.session import OwnSession
from lab.timings import Row, at_most
from lab.timings.calibration.indirect import Judge
from lab.timings.tools.truth import seen_values
from plugins.emulated.core.truth import read_truth

NAME, SHEET = "grid", "grid.png"
SHEET_PX: Final = 2048
LINES: Final = (12, 10)
"""To the right and up the sheet."""
HALF_WIDTH: Final = 0.2
"""Of the distance between two lines, at the line's foot."""
PALE, DARK = 200, 120
CLEAR: Final = 0.28
"""Of the distance between two lines: so far from the other family's."""
SPACING_PX: Final = (7.0, 60.0)
"""Camera pixels between two lines; nearer ones run into each other where the surface turns away."""
STEEPEST: Final = 3.0
"""Times slower or faster than at the line itself: the surface breaks here."""
GOALS: Final = {50: None, 95: 0.5}


def measure(size: str) -> list[Row]:
    """The grid's misplacement on every chosen seed, camera pixels across the line. The worst seed counts."""
    seeds = [int(seed) for seed in os.environ.get("BENCH_SEEDS", "1").split()]
    found: list[Float64] = []
    with tempfile.TemporaryDirectory(prefix="velatura-bench-") as temporary:
        folder = Path(os.environ.get("BENCH_FOLDER", temporary))
        for seed in seeds:
            stage = prepare(folder / f"{size}-{seed}-statue", DemoStage(size, seed, "statue"))
            found.append(np.abs(_off_px(stage, _worked(stage))))
    rows = []
    for percent, goal in GOALS.items():
        values = [float(np.percentile(one, percent)) for one in found]
        how = "; ".join(f"{value:.2f} of {len(one)}" for value, one in zip(values, found, strict=True))
        figure = f"grid on a statue's sheet, {percent} % of the crossings"
        rows.append(at_most(figure, max(values), goal, unit="camera px", how=how))
    return rows


def _worked(stage: Path) -> Path:
    if not (stage / SHEET).exists():
        cv2.imwrite(str(stage / SHEET), _sheet())
        toml = stage / "stage.toml"
        table = f'\n[[appearances]]\nname = "{NAME}"\nkind = "texture"\nfile = "{SHEET}"\n'
        toml.write_text(toml.read_text().split("[[appearances]]")[0] + table)
    session, cancel = OwnSession(stage), threading.Event()
    if not (stage.parent / "made").exists():
        with BenchProcess(stage, cancel=cancel):
            if not finished_calibrations(stage):
                calibrate(session=session, reporter=Silent(), cancel=cancel, accept_grade=True)
            register(stage, MeshOrder(stage / SCAN), Silent())
            order = AppearanceOrder(names=[NAME], accept_grade=True, refinement=Refinement(1))
            make_appearances(order, session=session, reporter=Silent(), cancel=cancel)
        (stage.parent / "made").touch()
    return finished_calibrations(stage)[0]


def _sheet() -> np.ndarray:
    """Dark lines with soft sides on a pale ground, at the middles of the sheet's parts."""
    at = (np.arange(SHEET_PX) + 0.5) / SHEET_PX
    across, up = (_line(at * count) for count in LINES)
    lines = np.maximum(across[None], up[::-1][:, None])
    return np.repeat(np.rint(PALE + (DARK - PALE) * lines)[..., None], 3, axis=2).astype(np.uint8)


def _line(at: Float64) -> Float64:
    """How much of a line is at places in parts of the sheet, 0 to 1."""
    away = np.abs(at - np.floor(at) - 0.5) / HALF_WIDTH
    return np.where(away < 1, 0.5 + 0.5 * np.cos(np.pi * away), 0.0)


def _off_px(stage: Path, run: Path) -> Float64:
    """(N,) how far each crossing of a pixel row or column with a line lies from where it belongs, camera pixels."""
    names = check_stage(stage).names
    judge = Judge(stage, Calibrated(run, names))
    solved = read_solved(run, NAME, names)
    shown = judge.clean(judge.truth.picture([solved.frames[name] for name in names])).mean(axis=2).astype(np.float64)
    thing = judge.truth.stage_object
    places = seen_values(thing, read_truth(stage).camera, thing.corner_values) * LINES
    mask = solved.reachable & judge.lit
    across = _crossings(shown, places, mask)
    up = _crossings(shown.T, places[..., ::-1].transpose(1, 0, 2), mask.T)
    return np.array([*across, *up])


def _crossings(shown: Float64, places: Float64, mask: Mask) -> Iterator[float]:
    """Of the lines of ``places[..., 0]`` with the rows."""
    with np.errstate(invalid="ignore"):
        at, other = places[..., 0] - 0.5, places[..., 1] - 0.5
        step = np.gradient(at, axis=1)
        slope = np.abs(step) / np.hypot(step, np.gradient(at, axis=0))
        rows, columns = np.nonzero(np.floor(at[:, :-1]) != np.floor(at[:, 1:]))
    for row, column in zip(rows.tolist(), columns.tolist(), strict=True):
        here = step[row, column]
        spacing = 1 / abs(here)
        if not SPACING_PX[0] <= spacing <= SPACING_PX[1] or slope[row, column] < 0.5:
            continue
        half = round(spacing * HALF_WIDTH + 2)
        window = np.s_[row, column - half : column + half + 2]
        if column < half or column + half + 2 > at.shape[1] or not mask[window].all():
            continue
        steps = step[window] / here
        beside = np.abs(other[window] - np.round(other[window]))
        if not ((steps > 1 / STEEPEST) & (steps < STEEPEST)).all() or not (beside > CLEAR).all():
            continue
        level = np.floor(at[row, column : column + 2].max())
        belongs = column + (level - at[row, column]) / (at[row, column + 1] - at[row, column])
        x = np.arange(column - half, column + half + 2, dtype=np.float64)
        values = shown[window]
        ground = np.interp(x, x[[0, -1]], values[[0, -1]])
        depth = np.clip(ground - values, 0, None)
        if depth.max() < 0.15 * ground.mean():
            continue
        yield float((x @ depth / depth.sum() - belongs) * slope[row, column])


__all__: Sequence[str] = ("measure",)
