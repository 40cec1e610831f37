"""Ways to measure metapixels against the truth of one stage: sinusoids, and dots at two spacings.

And how fast dots are fitted at the paper's size, on pictures that are made here.
"""

from __future__ import annotations

import dataclasses
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np

from controller.core.arrays import ByteImage, Float64, FloatImage, Mask
from controller.optics.calibrate.metapixels.from_dots import fit_picture
from controller.optics.calibrate.values import Calibration
from controller.optics.capture.pattern_frames import device_frame
from controller.optics.transport import LightTransport, build_transport
from controller.run.progress import Silent
from controller.stage.artefacts.calibration import read_calibration
from controller.stage.artefacts.kinds import StepKind
from controller.stage.artefacts.photographs import PhotographSet, captured
from controller.stage.services.calibrate import calibrate
from controller.stage.sessions.bench import BenchProcess
from controller.stage.sessions.check import check_stage
from controller.stage.sessions.session import OwnSession
from controller.stage.steps.appearance.solving import random_pattern
from controller.stage.steps.modes import dot_options
from lab.timings import Row, at_most, peak_bytes
from lab.timings.tools.judge import metapixel_errors, relative, rms
from lab.timings.tools.stage import FIRST_SEED, over, prepared_stage
from lab.timings.tools.truth import Truth, developed

RUNS: Final = (("fast", None), ("paper", "6"), ("paper", "16"))
EDGE_PX: Final = 3
"""Camera pixels around an edge or a fold that count as near it."""
GRID_PX: Final = 12
PAPER_PX: Final = (1400, 1050)
CAMERA_PX: Final = (3888, 2592)
BLURS_PX: Final = {"in focus": 0.47, "blurred 1.2 px": 1.22}
"""Standard deviations in projector pixels, the camera's blur in them."""


def measure(size: str) -> list[Row]:
    """Calibrate one stage in every mode, judge each, and time the fits."""
    rows: list[Row] = []
    with prepared_stage(size, FIRST_SEED) as stage:
        names, truth = check_stage(stage).names, Truth(stage)
        for mode, spacing in RUNS:
            began = time.perf_counter()
            run = _calibrated(stage, mode, spacing)
            wall_s = time.perf_counter() - began
            calibration = read_calibration(run, names)
            dots = sum(captured(run, PhotographSet(StepKind.DOTS, name)) for name in names) / len(names)
            if mode == "fast":
                rows += _judged("fast", truth, calibration, build_transport(calibration))
                plain = tuple(dataclasses.replace(part, phase_map=None) for part in calibration.projectors)
                gaussians = dataclasses.replace(calibration, projectors=plain)
                rows += _judged("fast, Gaussians", truth, gaussians, build_transport(gaussians))
            else:
                rows += _judged(f"dots r = {spacing}", truth, calibration, build_transport(calibration))
            label = mode if mode == "fast" else f"dots r = {spacing}"
            rows.append(at_most(f"{label}: photographs of dots, a projector", dots, None, unit="", how=""))
            rows.append(at_most(f"{label}: calibration", wall_s, None, unit="s", how="all projectors, lamps included"))
    return rows + fit_rows()


def _calibrated(stage: Path, mode: str, spacing: str | None) -> Path:
    cancel = threading.Event()
    with BenchProcess(stage, cancel=cancel):
        done = calibrate(
            session=OwnSession(stage),
            reporter=Silent(),
            cancel=cancel,
            dots=dot_options(mode, spacing),
            accept_grade=True,
        )
    return Path(str(done["run"]))


def _judged(label: str, truth: Truth, calibration: Calibration, transport: LightTransport) -> list[Row]:
    """Errors of the metapixels, and of pictures predicted everywhere and near edges, over the projectors."""
    found: dict[str, list[float]] = {}
    for n, part in enumerate(calibration.projectors):
        errors = metapixel_errors(truth, n, part.metapixels)
        figures = {f"metapixel {key}": errors[key] for key in ("centre in focus px", "centre defocused px", "sigma")}
        for name, (everywhere, near) in _predicted(truth, n, calibration, transport).items():
            figures |= {f"{name} %": 100 * everywhere, f"{name} near edges %": 100 * near}
        for key, value in figures.items():
            found.setdefault(key, []).append(value)
    return [at_most(f"{label}: {key}", max(values), None, unit="", how=over(values)) for key, values in found.items()]


def _predicted(
    truth: Truth, n: int, calibration: Calibration, transport: LightTransport
) -> dict[str, tuple[float, float]]:
    """Relative rms error of a random pattern, of columns of T (a grid of single pixels) and of one-pixel chequers.

    Of direct light alone: these transports hold nothing else.
    """
    part = calibration.projectors[n]
    rows, columns = part.metapixels.valid.shape
    white, response = truth.white(n, direct=True), truth.response(n)
    full = 1.02 * float(white.max())
    lit = transport.lit[n] & (developed(white, full).sum(axis=2) > 0)
    unit = _unit(part.white, developed(white, full), lit)
    edge = lit & ~truth.one_surface(n, EDGE_PX)
    grid = np.zeros((rows, columns, 3), np.uint8)
    grid[3::GRID_PX, 5::GRID_PX] = 255
    y, x = np.mgrid[0:rows, 0:columns]
    chequers = np.repeat((((x + y) % 2) * 255).astype(np.uint8)[..., None], 3, axis=2)
    random = device_frame(random_pattern((columns, rows)), (columns, rows), response)
    found = {}
    for name, shown in (("random pattern", random), ("column of T", grid), ("chequers", chequers)):
        real = developed(truth.light(n, shown, direct=True), full) * np.float32(unit)
        seen = transport.forward_part(n, _light(shown, response))
        found[name] = relative(seen, real, lit), relative(seen, real, edge)
    return found


def _unit(measured: FloatImage, true: FloatImage, lit: Mask) -> float:
    return float(measured[lit].sum(dtype=np.float64) / true[lit].sum(dtype=np.float64))


def _light(shown: ByteImage, response: Float64) -> FloatImage:
    return np.stack([response[c][shown[..., c]] for c in range(3)], axis=-1).astype(np.float32)


def fit_rows() -> list[Row]:
    """Seconds and memory of the fits at the paper's size: one picture of 256, times 256."""
    rows = []
    for name, sigma_px in BLURS_PX.items():
        seconds, cpu_s, error_px = fit_seconds(sigma_px)
        how = f"{cpu_s / 2:.3g} s if two cores were free (CPU time); centre {error_px:.3f} px rms; 256 x one picture"
        rows.append(at_most(f"fits at paper size, {name}, a projector", seconds, 20.0, unit="s", how=how))
    rows.append(
        at_most("peak memory of the process", peak_bytes() / 1e9, 3.0, unit="GB", how="truth and judging included")
    )
    return rows


def fit_seconds(sigma_px: float, r: int = 16) -> tuple[float, float, float]:
    """Wall and CPU seconds of a projector's r^2 pictures at the paper's size, and the centres' rms error."""
    random = np.random.default_rng(1)
    scale = CAMERA_PX[0] / PAPER_PX[0]
    y, x = np.mgrid[0 : PAPER_PX[1], 0 : PAPER_PX[0]].astype(np.float32)
    bent = np.stack([x + np.sin(y / 50) / 4, y + np.cos(x / 40) / 4], axis=-1)
    centre: FloatImage = (scale * bent + 1).astype(np.float32)
    spread = (scale * sigma_px) ** 2
    covariance = np.broadcast_to(np.array([spread, 0.1 * spread, spread], np.float32), (*x.shape, 3)).copy()
    shape = (CAMERA_PX[1], CAMERA_PX[0], 3)
    white: FloatImage = np.broadcast_to(random.uniform(0.4, 0.8, (*shape[:2], 1)).astype(np.float32), shape).copy()
    black = np.full(shape, 0.002, np.float32)
    noise = random.normal(0, 0.002, (*shape[:2], 1)).astype(np.float32)
    picture: FloatImage = black + noise + white * _drawn(centre[3::r, 5::r], spread, scale)[..., None]
    start: FloatImage = (centre + random.normal(0, 0.15, centre.shape)).astype(np.float32)
    valid = np.ones(x.shape, np.bool_)
    found, status = start.copy(), np.zeros(x.shape, np.uint8)
    wall_s, cpu_s = [], []
    for _ in range(4):
        began, cpu_began = time.perf_counter(), time.process_time()
        fit_picture(
            picture, black, white, start, covariance, valid, (3, 5, r), found, covariance.copy(), status,
            np.empty(x.shape, np.float32),
        )  # fmt: skip
        wall_s.append(time.perf_counter() - began)
        cpu_s.append(time.process_time() - cpu_began)
    fitted = status == 1
    return r * r * min(wall_s[1:]), r * r * min(cpu_s[1:]), rms((found - centre)[fitted].astype(np.float64))


def _drawn(centre: FloatImage, spread: float, scale: float) -> FloatImage:
    """Shares of the light of dots with these centres, as ellipses of covariance spread (1, 0.1, 1)."""
    shares = np.zeros((CAMERA_PX[1], CAMERA_PX[0]), np.float32)
    reach = int(np.ceil(5 * np.sqrt(spread)))
    along = np.arange(-reach, reach + 1)
    height = scale**2 / (2 * np.pi * spread * np.sqrt(0.99))
    for x, y in centre.reshape(-1, 2).astype(np.float64):
        column, row = round(x), round(y)
        if not (reach <= column < CAMERA_PX[0] - reach and reach <= row < CAMERA_PX[1] - reach):
            continue
        dx, dy = (along + column - x)[None, :], (along + row - y)[:, None]
        squared = (dx * dx - 0.2 * dx * dy + dy * dy) / (0.99 * spread)
        shares[row - reach : row + reach + 1, column - reach : column + reach + 1] += height * np.exp(-squared / 2)
    return shares


__all__: Sequence[str] = ("fit_rows", "fit_seconds", "measure")
