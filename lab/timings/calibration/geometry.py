"""The geometry by itself: random stages with a known truth, correspondences with noise and wrong ones among them.

The emulated bench casts the rays (it shares no model code with the controller): lens shift, radial distortion of two
terms, where the controller's model has one, shadows, silhouettes. Nothing is photographed, so decoding is not in it.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
import trimesh
from scipy.spatial.transform import Rotation

from controller.core.arrays import Float64
from controller.core.errors import VelaturaError
from controller.optics.calibrate.geometry.intrinsics import read_intrinsics
from controller.optics.calibrate.geometry.self_calibration import reconstruct
from controller.optics.calibrate.geometry.values import CameraPrior, Reconstruction
from controller.optics.calibrate.values import Correspondence
from lab.timings import Row, at_least, at_most, peak_bytes
from lab.timings.tools.alignment import similarity
from lab.timings.tools.stage import over
from lab.timings.tools.truth import points_from
from plugins.emulated.core.truth import BenchTruth, ObjectTruth
from plugins.emulated.optics.objects import StageObject, default_object, load_object
from plugins.emulated.optics.rays import cast
from plugins.emulated.optics.staging import device_tables, intrinsics_of, random_truth

FIRST_SEED = 900
STAGES = {"small": 20, "medium": 5, "paper": 1}
NOISE_PX = (0.03, 0.05)
OUTLIERS = 0.02
GROSS_MM = 5.0
LARGEST_K1 = 0.06
"""Of a projector's lens, where pictures are bent: k1 up to this to either side, and k2 of -0.25 k1."""


@dataclass(slots=True)
class Found:
    """Figures by name, one value a stage, and what was refused."""

    values: dict[str, list[float]] = field(default_factory=dict)
    refused: list[str] = field(default_factory=list)

    def add(self, figures: dict[str, float]) -> None:
        for name, value in figures.items():
            self.values.setdefault(name, []).append(value)


def measure(size: str) -> list[Row]:
    """``STAGES`` random stages of a size with three projectors, their first two alone, and three with bent pictures."""
    rows: list[Row] = []
    for projectors, bend in ((3, 0.0), (2, 0.0), (3, LARGEST_K1)):
        found = Found()
        for seed in range(FIRST_SEED, FIRST_SEED + STAGES[size]):
            _one(size, seed, projectors, found, bend)
        rows += _rows(found, STAGES[size], projectors, paper=size == "paper", bent=bend > 0)
    rows.append(at_most("peak memory of the process", peak_bytes() / 1e9, None, unit="GB", how="rays included"))
    return rows


def geometry_seconds(size: str, seed: int) -> tuple[float, float]:
    """Wall and CPU seconds of one solve with three projectors; raises what ``reconstruct`` raises."""
    truth, _, seen, _, prior = _posed(size, seed, 3)
    sizes = [p.lens.size_px for p in truth.projectors]
    began, cpu_began = time.perf_counter(), time.process_time()
    reconstruct(seen, truth.camera.lens.size_px, sizes, prior)
    return time.perf_counter() - began, time.process_time() - cpu_began


def _posed(
    size: str, seed: int, projectors: int, bend: float = 0.0
) -> tuple[BenchTruth, StageObject, list[Correspondence], Float64, CameraPrior]:
    """A random stage, what is seen of it, its true points and what is known of the camera."""
    stage_object = default_object() if seed % 2 == 0 else _rock(seed)
    truth = random_truth(size, seed, stage_object, ObjectTruth("mesh", "object.npz", seed), (1, 2))
    rng = np.random.default_rng([seed, 9])
    bent = []
    for one in truth.projectors[:projectors]:
        k1 = float(rng.uniform(-bend, bend))
        bent.append(replace(one, lens=replace(one.lens, distortion=(k1, -0.25 * k1))))
    truth = replace(truth, subsamples=1, projectors=tuple(bent))
    seen, points = _correspondences(truth, stage_object, seed)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "camera-intrinsics.toml"
        path.write_text(intrinsics_of(truth))
        prior = read_intrinsics(path).prior(
            distance_m=float(device_tables(truth, stage_object)["camera"]["distance_m"])
        )
    return truth, stage_object, seen, points, prior


def _one(size: str, seed: int, projectors: int, found: Found, bend: float) -> None:
    truth, _, seen, points, prior = _posed(size, seed, projectors, bend)
    sizes = [p.lens.size_px for p in truth.projectors]
    began = time.perf_counter()
    try:
        result = reconstruct(seen, truth.camera.lens.size_px, sizes, prior)
    except VelaturaError as error:
        found.refused.append(f"seed {seed}: {error.code}")
        return
    found.add({"seconds": time.perf_counter() - began})
    found.add(_errors(truth, points, result))


def _rock(seed: int) -> StageObject:
    """A random lump of about 30 cm."""
    rng = np.random.default_rng([seed, 7])
    ball = trimesh.creation.icosphere(subdivisions=6)
    radius = np.ones(len(ball.vertices))
    for _ in range(24):
        direction = rng.normal(size=3)
        radius += rng.normal(0, 0.16) * np.sin(ball.vertices @ direction * 3.0 + rng.uniform(0, 6.28)) / 3.0
    ball.vertices *= np.clip(radius, 0.5, 1.6)[:, None] * (1.3, 1.0, 0.7)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "rock.ply"
        ball.export(path)
        return load_object(path)


def _correspondences(truth: BenchTruth, stage_object: StageObject, seed: int) -> tuple[list[Correspondence], Float64]:
    """What each camera pixel's middle sees of each projector, with noise and outliers; and the points (camera)."""
    rng = np.random.default_rng([seed, 8])
    width, height = truth.camera.lens.size_px
    samples = cast(truth, stage_object, lambda share: None)
    out = []
    for n, projector in enumerate(truth.projectors):
        size = np.asarray(projector.lens.size_px)
        px = np.full((height * width, 2), np.nan)
        at = samples.at_px[n].astype(np.float64)
        lit = (samples.gain[n] > 0) & np.all((at > 0) & (at < size - 1), axis=1)
        at = at + rng.uniform(*NOISE_PX) * rng.normal(size=at.shape)
        wrong = rng.random(len(at)) < OUTLIERS
        at[wrong] = rng.uniform(0, 1, (int(wrong.sum()), 2)) * size
        px[samples.pixels[lit]] = at[lit]
        shaped = px.reshape(height, width, 2).astype(np.float32)
        valid = np.isfinite(shaped[..., 0])
        out.append(Correspondence(shaped, valid.astype(np.float32), valid))
    return out, points_from(truth.camera, stage_object)


def _errors(truth: BenchTruth, true: Float64, result: Reconstruction) -> dict[str, float]:
    measured = result.geometry.points_m.astype(np.float64)
    both = np.isfinite(measured).all(axis=2) & np.isfinite(true).all(axis=2)
    a, b = measured[both], true[both]
    near: npt.NDArray[np.bool_] = np.ones(len(a), np.bool_)
    for _ in range(4):
        scale, turn, move = similarity(a[near], b[near])
        off_mm = 1000 * np.linalg.norm(scale * a @ turn.T + move - b, axis=1)
        near = off_mm <= GROSS_MM
    turned, displaced = [], []
    camera = truth.camera.pose
    for own, real in zip(result.geometry.projectors, truth.projectors, strict=True):
        rotation = real.pose.rotation @ camera.rotation.T
        centre = camera.rotation @ (np.asarray(real.pose.position_m) - camera.position_m)
        apart = own.rotation @ turn.T @ rotation.T
        turned.append(float(np.degrees(Rotation.from_matrix(apart).magnitude())))
        found = scale * turn @ (-own.rotation.T @ own.translation_m) + move
        displaced.append(1000 * float(np.linalg.norm(found - centre)))
    focal = result.geometry.camera.matrix[0, 0] / truth.camera.lens.focal_px
    return {
        "shape mm": float(np.sqrt(np.mean(off_mm[near] ** 2))),
        "median mm": float(np.median(off_mm)),
        "gross": float(np.mean(~near)),
        "known": float(both.sum() / np.isfinite(true[..., 0]).sum()),
        "degrees": max(turned),
        "mm": max(displaced),
        "focal": abs(focal - 1),
        "scale": abs(scale - 1),
        "in sigmas": float(np.median(off_mm / (1000 * scale * result.sigma_m[both]))),
    }


def _rows(found: Found, stages: int, projectors: int, *, paper: bool, bent: bool) -> list[Row]:
    goals = projectors == 3
    name = f"N = {projectors}{', bent pictures' if bent else ''}: "
    done = len(found.values.get("seconds", ()))
    how = "; ".join(found.refused) or "every one"
    rows = [at_least(f"{name}stages converged", done, stages if goals else None, unit=f"of {stages}", how=how)]
    if not done:
        return rows

    def worst(figure: str, key: str, goal: float | None, unit: str, scale: float = 1.0, more: str = "") -> None:
        values = [scale * value for value in found.values[key]]
        text = over(values) + (f"; {more}" if more else "")
        rows.append(at_most(name + figure, max(values), goal if goals else None, unit=unit, how=text))

    worst("shape", "shape mm", 0.2, "mm rms", more=f"aligned by a similarity; points beyond {GROSS_MM:g} mm left out")
    worst("shape, median point", "median mm", None, "mm")
    worst(f"points beyond {GROSS_MM:g} mm", "gross", None, "%", 100)
    rows.append(
        at_least(
            f"{name}object known", 100 * min(found.values["known"]), None, unit="% of visible pixels",
            how=over([100 * value for value in found.values["known"]]) + "; the rest is unlit or at edges",
        )
    )  # fmt: skip
    worst("projector poses, turned", "degrees", 0.2, "degrees", more="worst projector")
    worst("projector poses, displaced", "mm", 4.0, "mm", more="worst projector")
    worst("camera's focal length", "focal", None, "%", 100)
    worst("scale", "scale", None, "%", 100, more="the tape measure's 1 % is in it")
    worst("error in its own sigmas", "in sigmas", None, "", more="median over points; 0.67 for one coordinate")
    worst("time", "seconds", 60.0 if paper else None, "s", more="compiling at the first")
    return rows


__all__: Sequence[str] = ("measure",)
