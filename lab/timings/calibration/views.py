"""An appearance for two cameras, against those of stages with one of them alone, and from where no camera stands; and
one for four cameras and six projectors all around the object.

Each view, and judge's cameras between and 15 degrees beyond, photograph the frames in the light of the stage, without
noise. Where a judge's camera sees what a view sees, the view's target is its target. All around, the error of the
picture may not change along seams, where other cameras begin or end to see the object.
``BENCH_SEEDS`` and ``BENCH_CAMERAS`` (``2 4``) choose; ``BENCH_FOLDER`` keeps the stages, and continues them. Rows are
printed as they come.
"""

from __future__ import annotations

import itertools
import os
import re
import shutil
import tempfile
import threading
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Final

import cv2
import numpy as np

from controller.core.arrays import ByteImage, Float64, FloatImage, Mask
from controller.demo import DemoStage, prepare
from controller.optics.solve.result.metrics import colour_difference
from controller.run.progress import Silent
from controller.stage.artefacts.calibrated import Calibrated, all_views
from controller.stage.artefacts.solved import read_solved
from controller.stage.artefacts.views import VIEWS, view_folders
from controller.stage.services.calibrate import calibrate
from controller.stage.sessions.bench import BenchProcess
from controller.stage.sessions.calibrations import finished_calibrations
from controller.stage.sessions.check import check_stage
from controller.stage.sessions.session import OwnSession
from lab.emulated.judge_camera import JudgeCamera, carried
from lab.timings import Row, at_least, at_most
from lab.timings.calibration.indirect import kept_frames, worked
from lab.timings.tools.truth import developed, surface_points
from plugins.emulated.core.truth import BenchTruth, CameraTruth, read_truth
from plugins.emulated.optics.rays import project
from plugins.emulated.optics.world import object_of

NAME: Final = "photograph"
REFINED: Final = (0, 1)
"""Photographs of the result."""
ALONE, BESIDE = 1.3, 1.5
"""Goals: each view as a share of that view alone, and the worst judge's camera as a share of the best view."""
PLACES: Final = {"between": (0, 30.0), "15 degrees beyond the first": (0, -15.0), "15 beyond the second": (1, 15.0)}
"""Judge's cameras: which camera is carried, and how far to the right."""
CONTROLLED, SEAM = 95.0, 1.0
"""Goals all around: share of the lit surface in %, and the step of the error along seams."""
LIT: Final = 0.02
"""Of the brightest direct light: less counts as none."""
SMOOTH_PX: Final = 2.0
"""Both sides of a seam are means over about so many pixels."""
SAME_M: Final = 0.003
"""Two points on the surface nearer than this are one."""
OUTLINE_PX: Final = 3
BLOCK: Final = re.compile(r"\[\[cameras\]\]\n(?:.+\n)+\n")


@dataclass(frozen=True, slots=True)
class Error:
    """CIEDE2000 in reach."""

    median: float
    p95: float

    def __str__(self) -> str:
        return f"{self.median:.2f} / {self.p95:.2f}"


def measure(size: str) -> list[Row]:
    """Make the appearance on every seed's stage, and judge it."""
    rows: list[Row] = []
    with tempfile.TemporaryDirectory(prefix="velatura-bench-") as temporary:
        folder = Path(os.environ.get("BENCH_FOLDER", temporary))
        for seed in os.environ.get("BENCH_SEEDS", "1").split():
            for cameras in os.environ.get("BENCH_CAMERAS", "2 4").split():
                if cameras == "2":
                    made = _side_by_side(folder / f"{size}-{seed}", DemoStage(size, int(seed), cameras=2), seed)
                else:
                    stage = DemoStage(size, int(seed), cameras=4, projectors=6)
                    made = _all_around(folder / f"{size}-{seed}-around", stage, seed)
                for row in made:
                    print(f"{row.figure}: {row.value:.4g} {row.unit} ({row.how})", flush=True)
                    rows.append(row)
    return rows


def _calibrated(folder: Path, asked: DemoStage) -> tuple[Path, list[str]]:
    """The stage with a calibration, made now or before, and its views."""
    stage = prepare(folder, asked)
    if not finished_calibrations(stage):
        cancel = threading.Event()
        with BenchProcess(stage, cancel=cancel):
            calibrate(session=OwnSession(stage), reporter=Silent(), cancel=cancel, accept_grade=True)
    return stage, list(view_folders(finished_calibrations(stage)[0]))


def _all_around(folder: Path, asked: DemoStage, seed: str) -> Iterator[Row]:
    stage, names = _calibrated(folder, asked)
    judged = _Judged(stage, worked(stage, (NAME,), (0,)))
    share = 100 * judged.controlled()
    yield at_least(f"all around, seed {seed}: controlled", share, CONTROLLED, unit="%", how="lit, seen by a camera")
    for n, name in enumerate(names):
        step = judged.seams(n, 0)
        how = f"median of {step.size} pixels; 95 %: {np.percentile(step, 95):.2f}; of the picture: {judged.view(n, 0)}"
        yield at_most(
            f"all around, seed {seed}: seams, {name}", float(np.median(step)), SEAM, unit="CIEDE2000", how=how
        )


def _side_by_side(folder: Path, asked: DemoStage, seed: str) -> Iterator[Row]:
    stage, names = _calibrated(folder, asked)
    alone = [_alone(stage, folder / f"alone-{n}" / "stage", n, name) for n, name in enumerate(names)]
    together = _Judged(stage, worked(stage, (NAME,), REFINED))
    single = [_Judged(one, worked(one, (NAME,), REFINED), n) for n, one in enumerate(alone)]
    for photographs in REFINED:
        after = f"seed {seed}, {photographs} photographs"
        errors = [together.view(n, photographs) for n in range(len(names))]
        for n, error in enumerate(errors):
            yield from _ratios(f"{names[n]} against alone, {after}", error, single[n].view(n, photographs), ALONE)
        best = Error(min(one.median for one in errors), min(one.p95 for one in errors))
        for place, (n, right) in PLACES.items():
            yield from _ratios(
                f"{place} against the best view, {after}", together.judge(n, right, photographs), best, BESIDE
            )


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
        return self._error(n, self._truth.cameras[n], solved.target, solved.reachable, photographs)

    def judge(self, n: int, right: float, photographs: int) -> Error:
        """Of camera ``n``, carried so many degrees to the right."""
        camera = carried(self._truth.cameras[n], right)
        target, reachable = self._target(camera)
        own = np.asarray(target / self._gains[n], np.float32)
        return self._error(n, camera, own, reachable, photographs)

    def controlled(self) -> float:
        """The share of the surface that projectors light and cameras see which some camera's view solves for."""
        total = good = 0.0
        for n, view in self._views.items():
            points, whites = surface_points(self._thing, self._truth.cameras[n]).astype(np.float32), self._whites()
            judge = JudgeCamera(self._stage, self._truth.cameras[n], direct=True)
            light = (judge.light({k: frame for one in whites for k, frame in one.items()}) - judge.light({})).mean(2)
            lit = np.isfinite(points).all(axis=-1) & (light > LIT * np.percentile(light, 99))
            often, solved = np.ones(lit.shape), view.transport.object_mask.copy()
            for m in self._views.keys() - {n}:
                x, y, seen = self._there(m, points)
                often += seen
                mask = self._views[m].transport.object_mask.astype(np.uint8)
                solved |= seen & (cv2.remap(mask, x, y, cv2.INTER_NEAREST) > 0)
            total += float((lit / often).sum())
            good += float(((lit & solved) / often).sum())
        return good / total

    def seams(self, n: int, photographs: int) -> Float64:
        """(pixels,): CIEDE2000 between both sides of seams, by how the error of the picture changes there."""
        camera, solved = self._truth.cameras[n], self._solved[n]
        points = surface_points(self._thing, camera).astype(np.float32)
        there = [self._there(m, points)[2] for m in sorted(self._views) if m != n]
        label = np.sum([seen << bit for bit, seen in enumerate(np.asarray(there, np.int32))], axis=0)
        shown = self._shown(n, camera, photographs)
        use = solved.reachable & np.isfinite(points).all(axis=-1) & ~_jumps(points)
        steps = []
        numbers = np.unique(label[use])
        for a, b in itertools.combinations(numbers, 2):
            sides, masks = [], []
            for one in (a, b):
                mine = (use & (label == one)).astype(np.float32)
                blur = partial(cv2.GaussianBlur, ksize=(0, 0), sigmaX=SMOOTH_PX)
                sides.append(blur(shown * mine[..., None]) / np.maximum(blur(solved.target * mine[..., None]), 1e-6))
                masks.append(cv2.dilate(mine, np.ones((3, 3), np.uint8)) > 0)
            seam = masks[0] & masks[1] & use
            if not seam.any():
                continue
            one, other = (np.asarray(solved.target * side, np.float32) for side in sides)
            to_xyz = self._views[n].calibration.camera_to_xyz
            steps.append(colour_difference(one, other, to_xyz, solved.exposure, seam)[seam])
        return np.concatenate(steps).astype(np.float64)

    def _error(self, n: int, camera: CameraTruth, target: FloatImage, reachable: Mask, photographs: int) -> Error:
        shown = self._shown(n, camera, photographs)
        inner = cv2.erode(reachable.astype(np.uint8), np.ones((2 * OUTLINE_PX + 1,) * 2, np.uint8)) > 0
        to_xyz = self._views[n].calibration.camera_to_xyz
        error = colour_difference(shown, target, to_xyz, self._solved[n].exposure, inner)[inner]
        return Error(float(np.median(error)), float(np.percentile(error, 95)))

    def _shown(self, n: int, camera: CameraTruth, photographs: int) -> FloatImage:
        """What a camera sees of the frames, in the units of view ``n``."""
        frames = dict(zip(self._projectors, kept_frames(self._stage, NAME, photographs), strict=True))
        full, unit = self._units[n]
        return np.asarray(unit * developed(_judge(self._truth, self._stage, camera).light(frames), full), np.float32)

    def _unit(self, n: int) -> tuple[float, float]:
        """Full scale of a camera's light, and the controller's units for it."""
        view, judge = self._views[n], _judge(self._truth, self._stage, self._truth.cameras[n])
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
            x, y, seen = self._there(n, points)
            target = cv2.remap(solved.target, x, y, cv2.INTER_LINEAR)
            total += np.where(seen[..., None], target * np.asarray(self._gains[n], np.float32), 0)
            count += seen
            reached &= ~seen | (cv2.remap(solved.reachable.astype(np.uint8), x, y, cv2.INTER_NEAREST) > 0)
        return np.asarray(total / np.maximum(count, 1)[..., None], np.float32), np.asarray(reached & (count > 0))

    def _there(self, n: int, points: FloatImage) -> tuple[FloatImage, FloatImage, Mask]:
        """Where ``points`` (rows, columns, 3) are in a view's picture, and which of them it sees."""
        camera = self._truth.cameras[n]
        at, _ = project(camera.pose, camera.lens, np.nan_to_num(points).reshape(-1, 3).astype(np.float64))
        x, y = (at[:, axis].reshape(points.shape[:2]).astype(np.float32) for axis in (0, 1))
        own = surface_points(self._thing, camera).astype(np.float32)
        there = cv2.remap(own, x, y, cv2.INTER_NEAREST, borderValue=(np.nan,) * 3)
        return x, y, np.asarray(np.linalg.norm(there - points, axis=-1) < SAME_M)


_judges: Final[dict[CameraTruth, JudgeCamera]] = {}


def _judge(truth: BenchTruth, stage: Path, camera: CameraTruth) -> JudgeCamera:
    """Each is made once: its light takes long. A stage of one view has the truth of the whole one."""
    if _judges and next(iter(_judges)) not in truth.cameras:
        _judges.clear()
    if camera not in _judges:
        _judges[camera] = JudgeCamera(stage, camera)
    return _judges[camera]


def _jumps(points: FloatImage) -> Mask:
    """Pixels beside which another surface is, nearer or farther."""
    beside = np.ones((3, 3), np.uint8)
    low, high = cv2.erode(points, beside), cv2.dilate(points, beside)
    return np.asarray(~(np.linalg.norm(high - low, axis=-1) < 5 * SAME_M))


__all__: Sequence[str] = ("measure",)
