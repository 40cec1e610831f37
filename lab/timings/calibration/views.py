"""An appearance for two cameras, against those of stages with one of them alone, and from where no camera stands.

Each view, and judge's cameras between and 15 degrees beyond, photograph the frames in the light of the stage, without
noise. Where a judge's camera sees what a view sees, the view's target is its target.
``BENCH_SEEDS`` chooses; ``BENCH_FOLDER`` keeps the stages, and measures kept ones again.
"""

from __future__ import annotations

import os
import re
import shutil
import tempfile
import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import cv2
import numpy as np

from controller.core.arrays import ByteImage, FloatImage, Mask
from controller.demo import DemoStage, prepare
from controller.optics.solve.result.metrics import colour_difference
from controller.run.progress import Silent
from controller.stage.artefacts.calibrated import Calibrated, all_views
from controller.stage.artefacts.solved import Solved, read_solved
from controller.stage.artefacts.views import VIEWS, view_folders
from controller.stage.services.calibrate import calibrate
from controller.stage.sessions.bench import BenchProcess
from controller.stage.sessions.calibrations import finished_calibrations
from controller.stage.sessions.check import check_stage
from controller.stage.sessions.session import OwnSession
from lab.emulated.judge_camera import JudgeCamera, carried
from lab.timings import Row, at_most
from lab.timings.calibration.indirect import kept_frames, worked
from lab.timings.tools.truth import developed, surface_points
from plugins.emulated.core.truth import CameraTruth, read_truth
from plugins.emulated.optics.rays import project
from plugins.emulated.optics.world import object_of

NAME: Final = "photograph"
REFINED: Final = (0, 1)
"""Photographs of the result."""
ALONE, BESIDE = 1.3, 1.5
"""Goals: each view as a share of that view alone, and the worst judge's camera as a share of the best view."""
PLACES: Final = {"between": (0, 30.0), "15 degrees beyond the first": (0, -15.0), "15 beyond the second": (1, 15.0)}
"""Judge's cameras: which camera is carried, and how far to the right."""
SAME_M: Final = 0.003
"""Two points on the surface nearer than this are one."""
OUTLINE_PX: Final = 3
BLOCK: Final = re.compile(r"\[\[cameras\]\]\n(?:.+\n)+\n")


@dataclass(frozen=True, slots=True)
class Error:
    """CIEDE2000 in reach."""

    median: float
    p95: float


def measure(size: str) -> list[Row]:
    """Make the appearance on every seed's stage, and judge it."""
    rows: list[Row] = []
    with tempfile.TemporaryDirectory(prefix="velatura-bench-") as temporary:
        folder = Path(os.environ.get("BENCH_FOLDER", temporary))
        for seed in os.environ.get("BENCH_SEEDS", "1").split():
            rows += _rows(folder / f"{size}-{seed}", DemoStage(size, int(seed), cameras=2), seed)
    return rows


def _rows(folder: Path, asked: DemoStage, seed: str) -> list[Row]:
    stage = prepare(folder, asked)
    if not finished_calibrations(stage):
        cancel = threading.Event()
        with BenchProcess(stage, cancel=cancel):
            calibrate(session=OwnSession(stage), reporter=Silent(), cancel=cancel, accept_grade=True)
    names = list(view_folders(finished_calibrations(stage)[0]))
    alone = [_alone(stage, folder / f"alone-{n}" / "stage", n, name) for n, name in enumerate(names)]
    together = _Judged(stage, worked(stage, (NAME,), REFINED))
    single = [_Judged(one, worked(one, (NAME,), REFINED), n) for n, one in enumerate(alone)]
    rows = []
    for photographs in REFINED:
        after = f"seed {seed}, {photographs} photographs"
        errors = [together.view(n, photographs) for n in range(len(names))]
        for n, error in enumerate(errors):
            rows += _ratios(f"{names[n]} against alone, {after}", error, single[n].view(n, photographs), ALONE)
        best = Error(min(one.median for one in errors), min(one.p95 for one in errors))
        for place, (n, right) in PLACES.items():
            rows += _ratios(
                f"{place} against the best view, {after}", together.judge(n, right, photographs), best, BESIDE
            )
    return rows


def _ratios(figure: str, error: Error, other: Error, goal: float) -> list[Row]:
    pairs = {"median": (error.median, other.median), "95 %": (error.p95, other.p95)}
    return [at_most(f"{figure}, {key}", one / two, goal, unit="times", how=f"{one:.2f} against {two:.2f} CIEDE2000")
            for key, (one, two) in pairs.items()]  # fmt: skip


def _alone(stage: Path, to: Path, n: int, name: str) -> Path:
    """The stage with one camera alone and the calibration of its view, made now or before."""
    if to.exists():
        return to

    def copied(source: str, target: str) -> None:
        (os.link if source.endswith((".dng", ".npz")) else shutil.copy2)(source, target)

    shutil.copytree(stage, to, copy_function=copied, ignore=shutil.ignore_patterns("run", "runs", "bundles"))
    run = finished_calibrations(stage)[0]
    out = shutil.ignore_patterns(VIEWS, "view.json")
    shutil.copytree(view_folders(run)[name], to / "runs" / run.name, copy_function=copied, ignore=out)
    toml = to / "stage.toml"
    blocks = BLOCK.findall(toml.read_text())
    toml.write_text(BLOCK.sub(lambda found: blocks[n] if found.group() == blocks[n] else "", toml.read_text()))
    return to


class _Judged:
    """Frames in the light of the stage. ``only``: the number of the stage's only view, if it has one."""

    def __init__(self, stage: Path, run: Path, only: int | None = None) -> None:
        self._stage, self._truth = stage, read_truth(stage)
        self._thing = object_of(stage, self._truth.object)
        self._projectors = check_stage(stage).names
        folders = list(view_folders(run).values())
        numbers = range(len(folders)) if only is None else (only,)
        self._views = {n: Calibrated(folder, self._projectors) for n, folder in zip(numbers, folders, strict=True)}
        gains = [view.gain for view in all_views(run, self._projectors).views()]
        self._gains = {n: np.ones(3) if gain is None else gain for n, gain in zip(numbers, gains, strict=True)}
        self._solved = {n: read_solved(view.folder, NAME, self._projectors) for n, view in self._views.items()}
        self._units = {n: self._unit(n) for n in numbers}

    def view(self, n: int, photographs: int) -> Error:
        """Of a view's own camera."""
        solved = self._solved[n]
        return self._error(n, self._camera(n), solved.target, solved.reachable, photographs)

    def judge(self, n: int, right: float, photographs: int) -> Error:
        """Of camera ``n``, carried so many degrees to the right."""
        camera = carried(self._camera(n), right)
        target, reachable = self._target(camera)
        own = np.asarray(target / self._gains[n], np.float32)
        return self._error(n, camera, own, reachable, photographs)

    def _camera(self, n: int) -> CameraTruth:
        return self._truth.cameras[n]

    def _error(self, n: int, camera: CameraTruth, target: FloatImage, reachable: Mask, photographs: int) -> Error:
        frames = dict(zip(self._projectors, kept_frames(self._stage, NAME, photographs), strict=True))
        full, unit = self._units[n]
        shown = unit * developed(JudgeCamera(self._stage, camera).light(frames), full)
        inner = cv2.erode(reachable.astype(np.uint8), np.ones((2 * OUTLINE_PX + 1,) * 2, np.uint8)) > 0
        to_xyz = self._views[n].calibration.camera_to_xyz
        error = colour_difference(shown, target, to_xyz, self._solved[n].exposure, inner)[inner]
        return Error(float(np.median(error)), float(np.percentile(error, 95)))

    def _unit(self, n: int) -> tuple[float, float]:
        """Full scale of a camera's light, and the controller's units for it."""
        view, judge = self._views[n], JudgeCamera(self._stage, self._camera(n))
        whites = [judge.light(frames) for frames in self._whites()]
        full, black = 1.02 * float(max(white.max() for white in whites)), judge.light({})
        lit = view.transport.object_mask
        seen = sum(float(developed(white - black, full)[lit].sum(dtype=np.float64)) for white in whites)
        known = 0.0
        for part in view.calibration.projectors:
            light = part.white if part.indirect is None else part.white + part.indirect
            known += float(light[lit].sum(dtype=np.float64))
        return full * len(whites), known / seen

    def _whites(self) -> Sequence[Mapping[str, ByteImage]]:
        sizes = {one.name: one.lens.size_px for one in self._truth.projectors}
        return [{name: np.full((height, width, 3), 255, np.uint8)} for name, (width, height) in sizes.items()]

    def _target(self, camera: CameraTruth) -> tuple[FloatImage, Mask]:
        """What the views' targets are from elsewhere, in the first view's units, and where all that see it reach it."""
        points = np.asarray(surface_points(self._thing, camera), np.float32)
        total, count = np.zeros(points.shape, np.float32), np.zeros(points.shape[:2], np.float32)
        reached = np.isfinite(points).all(axis=-1)
        for n, solved in self._solved.items():
            seen, target, reachable = self._seen(n, solved, points)
            total += np.where(seen[..., None], target * np.asarray(self._gains[n], np.float32), 0)
            count += seen
            reached &= ~seen | reachable
        return np.asarray(total / np.maximum(count, 1)[..., None], np.float32), np.asarray(reached & (count > 0))

    def _seen(self, n: int, solved: Solved, points: FloatImage) -> tuple[Mask, FloatImage, Mask]:
        """Which ``points`` a view sees, and its target and its reach there."""
        camera = self._camera(n)
        at, _ = project(camera.pose, camera.lens, np.nan_to_num(points).reshape(-1, 3).astype(np.float64))
        x, y = (at[:, axis].reshape(points.shape[:2]).astype(np.float32) for axis in (0, 1))
        own = surface_points(self._thing, camera).astype(np.float32)
        there = cv2.remap(own, x, y, cv2.INTER_NEAREST, borderValue=(np.nan,) * 3)
        seen = np.linalg.norm(there - points, axis=-1) < SAME_M
        reachable = cv2.remap(solved.reachable.astype(np.uint8), x, y, cv2.INTER_NEAREST) > 0
        return np.asarray(seen), np.asarray(cv2.remap(solved.target, x, y, cv2.INTER_LINEAR)), np.asarray(reachable)


__all__: Sequence[str] = ("measure",)
