"""Appearances on stages whose surfaces light each other, by paths through Mitsuba: against the light without noise.

Stages: a bust in a painted corner, a bowl, a vase beside a bust, balls on steps, a bust in a niche, a vase between
coloured walls, a fence before a wall (``lab.timings.tools.scenes``).
Each is calibrated and refined as the command line would, through its devices; then its frames are judged in the optical
model. The worst stage counts.
``BENCH_SCENES`` and ``BENCH_SEEDS`` choose some; ``BENCH_FOLDER`` keeps the stages, and measures kept ones again.
"""

from __future__ import annotations

import dataclasses
import os
import tempfile
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import cv2
import numpy as np

from controller.core.arrays import ByteImage, Float64, FloatImage, Mask
from controller.demo import DemoStage, prepare
from controller.optics.solve.result.metrics import colour_difference
from controller.run.progress import Silent
from controller.stage.artefacts.calibrated import Calibrated
from controller.stage.artefacts.solved import Solved, read_solved
from controller.stage.services.calibrate import AppearanceOrder, calibrate, make_appearances
from controller.stage.services.refine import Refinement
from controller.stage.sessions.bench import BenchProcess
from controller.stage.sessions.calibrations import finished_calibrations
from controller.stage.sessions.check import check_stage
from controller.stage.sessions.session import OwnSession
from lab.timings import Row, at_most
from lab.timings.tools.judge import predicted_light
from lab.timings.tools.scenes import SCENES, write_scene
from lab.timings.tools.truth import Truth, developed
from plugins.emulated.core.truth import read_truth, write_truth

SEEDS: Final = "1"
REFINED: Final = (0, 1, 2)
"""Photographs of each result."""
NAMES: Final = ("grey", "wrapped", "seen")
GOALS: Final = {0: (0.7, 4.0), 1: (0.5, 3.5), 2: (0.4, 3.0)}
BLOCK_PX: Final = 50
BORDER_PX: Final = 6
OUTLINE_PX: Final = 3
"""Pixels so near to the object's border see the room, too, where projectors stay dark (docs/decisions/0011)."""
RESPONSE_AT: Final = 64
FORGIVEN: Final = 0.02
"""Drive beyond [0, 1] that counts as in reach yet."""
UNLIT: Final = 1e-12
"""Of the brightest light's determinant: three colours of light that are none."""
APPEARANCES: Final = """
[[appearances]]
name = "grey"
kind = "picture"
file = "grey.png"

[[appearances]]
name = "wrapped"
kind = "photograph"
file = "photograph.png"

[[appearances]]
name = "seen"
kind = "picture"
file = "seen.png"
"""


def measure(size: str) -> list[Row]:
    """Calibrate, refine and judge every chosen scene and seed."""
    scenes = os.environ.get("BENCH_SCENES", " ".join(SCENES)).split()
    seeds = [int(seed) for seed in os.environ.get("BENCH_SEEDS", SEEDS).split()]
    found: list[dict[str, float]] = []
    with tempfile.TemporaryDirectory(prefix="velatura-bench-") as temporary:
        folder = Path(os.environ.get("BENCH_FOLDER", temporary))
        for scene in scenes:
            for seed in seeds:
                stage = traced_stage(folder / f"{scene}-{size}-{seed}", scene, size, seed)
                run = worked(stage)
                found.append(judged(stage, run))
                print(f"{scene}, seed {seed}: " + ", ".join(f"{k} {v:.4g}" for k, v in found[-1].items()), flush=True)
    return _rows(found)


def traced_stage(folder: Path, scene: str, size: str, seed: int) -> Path:
    """The stage of a scene, prepared now or before."""
    if (folder / "stage" / "stage.toml").exists():
        return folder / "stage"
    folder.mkdir(parents=True, exist_ok=True)
    stage = prepare(folder, DemoStage(size, seed, str(write_scene(scene, folder / "scene.ply"))))
    write_truth(stage, dataclasses.replace(read_truth(stage), engine="mitsuba"))
    width, height = read_truth(stage).camera.lens.size_px
    cv2.imwrite(str(stage / "grey.png"), np.full((height, width, 3), 188, np.uint8))
    picture = cv2.imread(str(stage / "photograph.png"))
    assert picture is not None
    large = cv2.resize(picture, (width, width), interpolation=cv2.INTER_AREA)
    cv2.imwrite(str(stage / "seen.png"), large[(width - height) // 2 :][:height])
    toml = stage / "stage.toml"
    toml.write_text(toml.read_text().split("[[appearances]]")[0] + APPEARANCES)
    return stage


def worked(stage: Path, names: Sequence[str] = NAMES, refined: Sequence[int] = REFINED) -> Path:
    """Calibrate the stage, make its appearances, refine them, where that was not done before; the calibration's run."""
    session, cancel = OwnSession(stage), threading.Event()
    left = [photographs for photographs in refined if not _kept(stage, names[-1], photographs).exists()]
    if left:
        with BenchProcess(stage, cancel=cancel):
            if not finished_calibrations(stage):
                calibrate(session=session, reporter=Silent(), cancel=cancel, accept_grade=True)
            for photographs in left:
                make_appearances(
                    AppearanceOrder(names=names, accept_grade=True, refinement=Refinement(photographs)),
                    session=session,
                    reporter=Silent(),
                    cancel=cancel,
                )
                _keep(stage, names, photographs)
    return finished_calibrations(stage)[0]


def _kept(stage: Path, name: str, photographs: int) -> Path:
    return stage.parent / f"{name}-{photographs}.npz"


def _keep(stage: Path, names: Sequence[str], photographs: int) -> None:
    """The device frames of each appearance, beside the stage."""
    run = finished_calibrations(stage)[0]
    projectors = check_stage(stage).names
    for name in names:
        solved = read_solved(run, name, projectors)
        np.savez(_kept(stage, name, photographs), *[solved.frames[projector] for projector in projectors])


def kept_frames(stage: Path, name: str, photographs: int) -> list[ByteImage]:
    """The device frames that ``worked`` has kept, in the order of the projectors."""
    with np.load(_kept(stage, name, photographs)) as kept:
        return [kept[key] for key in kept.files]


def judged(stage: Path, run: Path, names: Sequence[str] = NAMES, refined: Sequence[int] = REFINED) -> dict[str, float]:
    """All figures of a stage."""
    projectors = check_stage(stage).names
    judge = Judge(stage, Calibrated(run, projectors))
    found = judge.calibration()
    for photographs in refined:
        for name in names:
            figures = judge.appearance(read_solved(run, name, projectors), kept_frames(stage, name, photographs))
            found |= {f"{name} {key}, {photographs}": value for key, value in figures.items()}
    return found


class Judge:
    """What a calibration and its frames are worth in the light of the stage, without noise."""

    def __init__(self, stage: Path, calibrated: Calibrated) -> None:
        self.truth, self.calibrated = Truth(stage), calibrated
        self.calibration_ = calibrated.calibration
        projectors = range(len(calibrated.projectors))
        whites = [self.truth.white(n) for n in projectors]
        self.full = 1.02 * float(np.sum(whites, axis=0).max())
        self.lit = calibrated.transport.object_mask
        seen = np.sum([self.clean(white) for white in whites], axis=0)
        known = np.sum([part.white for part in self.calibration_.projectors], axis=0)
        for part in self.calibration_.projectors:
            known = known if part.indirect is None else known + part.indirect
        self.unit = float(known[self.lit].sum(dtype=np.float64) / seen[self.lit].sum(dtype=np.float64))
        direct = [self.clean(self.truth.white(n, direct=True)) for n in projectors]
        self.light = np.zeros((*self.lit.shape, 3, 3))
        for n, white in enumerate(direct):
            self.light += self.unit * white[..., None] * self.truth.mixing(n)
        whole = [self.truth.wholly_lit(n).astype(np.uint8) for n in projectors]
        around = np.ones((2 * BORDER_PX + 1,) * 2, np.uint8)
        borders = [(cv2.dilate(one, around) > 0) & (cv2.erode(one, around) == 0) for one in whole]
        self.border: Mask = np.asarray(np.any(borders, axis=0))
        outline = np.ones((2 * OUTLINE_PX + 1,) * 2, np.uint8)
        self.inner: Mask = np.asarray(cv2.erode(self.lit.astype(np.uint8), outline) > 0)

    def clean(self, light: FloatImage) -> FloatImage:
        """As the controller develops it."""
        return developed(light, self.full)

    def calibration(self) -> dict[str, float]:
        """Response, and the prediction of a pattern of blocks."""
        found: dict[str, float] = {}
        errors = []
        for n, part in enumerate(self.calibration_.projectors):
            true = self.truth.response(n)[:, RESPONSE_AT]
            errors.append(part.radiometry.response[:, RESPONSE_AT] / true - 1)
            found[f"blocks %, {n}"] = 100 * self._blocks(n)
        for channel, colour in enumerate(("red", "green", "blue")):
            found[f"response %, {colour}"] = 100 * float(max(np.array(errors)[:, channel], key=abs))
        return found

    def _blocks(self, n: int) -> float:
        """Relative rms error of a projector's picture of random blocks, as large as ``BLOCK_PX`` for the camera."""
        part = self.calibration_.projectors[n]
        rows, columns = part.metapixels.valid.shape
        side = max(1, round(BLOCK_PX * columns / self.lit.shape[1]))
        coarse = np.random.default_rng(5).choice((0, 255), (-(-rows // side), -(-columns // side), 3))
        frame = np.repeat(np.repeat(coarse, side, axis=0), side, axis=1)[:rows, :columns].astype(np.uint8)
        light = (frame / 255).astype(np.float32)
        predicted = predicted_light(self.calibrated, n, light)
        real = self.unit * self.clean(self.truth.light(n, frame))
        use = self.calibrated.transport.lit[n]
        return float(np.sqrt(np.mean((predicted - real)[use] ** 2) / np.mean(real[use] ** 2)))

    def appearance(self, solved: Solved, frames: Sequence[ByteImage]) -> dict[str, float]:
        """Colour differences, over pixels said to be in reach; and what they are in reach of."""
        shown = self.unit * self.clean(self.truth.picture(frames))
        direct = self.unit * self.clean(self.truth.picture(frames, direct=True))
        mask = solved.reachable & self.lit
        to_xyz = self.calibration_.camera_to_xyz
        error = colour_difference(shown, solved.target, to_xyz, solved.exposure, self.lit)
        inside = error[mask]
        light = self.light[mask]
        some = np.abs(np.linalg.det(light)) > UNLIT * np.abs(light).max() ** 3
        # where no projector's light falls in truth, nothing is in reach
        drive = np.full((len(light), 3), np.inf)
        needed = self._needed(solved, shown, direct)[mask][some]
        drive[some] = np.linalg.solve(light[some], needed[..., None])[..., 0]
        beyond = (drive < -FORGIVEN) | (drive > 1 + FORGIVEN)
        return {
            "median": float(np.median(inside)),
            "95": float(np.percentile(inside, 95)),
            "all 95": float(np.percentile(error[self.lit], 95)),
            "reach %": 100 * float(mask.sum() / self.lit.sum()),
            "falsely %": 100 * float(beyond.any(axis=1).mean()),
            "border 95": float(np.percentile(error[mask & self.border], 95)),
            "inner border 95": float(np.percentile(error[mask & self.border & self.inner], 95)),
            "no border 95": float(np.percentile(error[mask & ~self.border], 95)),
            "blocks %": 100 * self._block_error(shown, solved.target, mask),
        }

    def _needed(self, solved: Solved, shown: FloatImage, direct: FloatImage) -> Float64:
        """Direct light that the target asks of the projectors, while what bounces is as it is now."""
        dark = [np.zeros((p.lens.size_px[1], p.lens.size_px[0], 3), np.uint8) for p in self.truth.bench.projectors]
        black = self.unit * self.clean(self.truth.picture(dark, direct=True))
        return np.asarray(solved.target - (shown - direct) - black, np.float64)

    def _block_error(self, shown: FloatImage, wanted: FloatImage, mask: Mask) -> float:
        """Rms of the blocks' relative errors; blocks half of which are in reach."""
        rows, columns = (range(0, length, BLOCK_PX) for length in mask.shape)
        errors = []
        for row in rows:
            for column in columns:
                here = np.s_[row : row + BLOCK_PX, column : column + BLOCK_PX]
                if mask[here].mean() >= 0.5:
                    errors.append(shown[here][mask[here]].mean(axis=0) / wanted[here][mask[here]].mean(axis=0) - 1)
        return float(np.sqrt(np.mean(np.square(errors)))) if errors else float("nan")


def _rows(found: list[dict[str, float]]) -> list[Row]:
    rows = []

    def worst(figure: str, keys: Sequence[str], goal: float | None, unit: str) -> None:
        values = [abs(one[key]) for one in found for key in keys if np.isfinite(one[key])]
        rows.append(at_most(figure, max(values), goal, unit=unit, how=f"min {min(values):.3g} over {len(values)}"))

    for photographs, (median, p95) in GOALS.items():
        after = f", {photographs} photographs" if photographs else ""
        for name in NAMES:
            worst(f"{name}, median{after}", [f"{name} median, {photographs}"], median, "CIEDE2000")
            worst(f"{name}, 95 %{after}", [f"{name} 95, {photographs}"], p95, "CIEDE2000")
        worst(f"falsely in reach{after}", [f"{name} falsely %, {photographs}" for name in NAMES], 2.0, "%")
        worst(f"shadow borders, even grey, 95 %{after}", [f"grey border 95, {photographs}"], 5.0, "CIEDE2000")
        worst(f"the same, off the outline{after}", [f"grey inner border 95, {photographs}"], None, "CIEDE2000")
        worst(f"error of blocks{after}", [f"{name} blocks %, {photographs}" for name in NAMES], 4.0, "%")
    worst("predicted blocks", [key for key in found[0] if key.startswith("blocks %")], 4.0, "% rms")
    for colour in ("red", "green", "blue"):
        worst(f"response at {RESPONSE_AT}, {colour}", [f"response %, {colour}"], 1.0, "%")
    return rows


__all__: Sequence[str] = ("GOALS", "Judge", "judged", "kept_frames", "measure", "traced_stage", "worked")
