"""Which of the bench's objects are calibrated, as what shape; and what one projector makes of a smooth picture.

For the latter, the same projector lights the same object twice: on a stage of its own, and as one of three that were
calibrated together. Its frames are judged in the light of the stage, without noise. ``BENCH_OBJECTS``,
``BENCH_SEEDS`` and ``BENCH_ALONE`` choose some; ``BENCH_FOLDER`` keeps the stages, and measures kept ones again.
"""

from __future__ import annotations

import dataclasses
import os
import tempfile
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np

from controller.core.arrays import FloatImage
from controller.demo import DemoStage, prepare
from controller.optics.solve.bounded.equations import SolveSettings, appearance_weights
from controller.optics.solve.bounded.solver import solve_bounded
from controller.optics.solve.reach.feasibility import expose_target, target_radiance
from controller.optics.solve.result.metrics import colour_difference
from controller.optics.transport import build_transport
from controller.run.progress import Silent
from controller.stage.artefacts.calibrated import Calibrated
from controller.stage.artefacts.depth_edges import edged
from controller.stage.artefacts.geometry import read_geometry_figures
from controller.stage.services.calibrate import calibrate
from controller.stage.sessions.bench import BenchProcess
from controller.stage.sessions.calibrations import finished_calibrations
from controller.stage.sessions.check import check_stage
from controller.stage.sessions.session import OwnSession
from controller.stage.steps.appearance.solving import device_frames
from controller.stage.steps.calibrate.gate import grade_figures
from hal.errors import CodedError
from lab.timings import Row, at_least, at_most
from lab.timings.calibration.indirect import Judge

OBJECTS: Final = "painting relief corner cylinder sphere two-objects"
ALONE: Final = "vase painting"
VASE: Final = "vase"
"""The vase and the bust, which have no name on the bench."""
FEW, MANY = 1, 3
SHARE: Final = 0.95


def measure(size: str) -> list[Row]:
    """Calibrate every chosen object and seed, and judge one projector on the chosen ones."""
    seeds = [int(seed) for seed in os.environ.get("BENCH_SEEDS", "1").split()]
    rows: list[Row] = []
    with tempfile.TemporaryDirectory(prefix="velatura-bench-") as temporary:
        folder = Path(os.environ.get("BENCH_FOLDER", temporary))
        for thing in os.environ.get("BENCH_OBJECTS", OBJECTS).split():
            said = [_said(folder, DemoStage(size, seed, thing)) for seed in seeds]
            done = sum(words.startswith("grade") for words in said)
            rows.append(at_least(f"{thing}, calibrated", done, len(seeds), unit="stages", how="; ".join(said)))
        for thing in os.environ.get("BENCH_ALONE", ALONE).split():
            rows += _one_projector(folder, size, thing, seeds)
    return rows


def _calibrated(folder: Path, asked: DemoStage) -> tuple[Path, Path]:
    """The stage and its calibration, made now or before. Raises CodedError."""
    extra = [str(one) for one in (asked.thing or VASE, asked.projectors) if one is not None]
    stage = prepare(folder / "-".join((asked.size, str(asked.seed), *extra)), asked)
    if not finished_calibrations(stage):
        cancel = threading.Event()
        with BenchProcess(stage, cancel=cancel):
            calibrate(session=OwnSession(stage), reporter=Silent(), cancel=cancel, accept_grade=True)
    return stage, finished_calibrations(stage)[0]


def _said(folder: Path, asked: DemoStage) -> str:
    try:
        stage, run = _calibrated(folder, asked)
    except CodedError as error:
        return f"{error.code}: {error.what}"
    shape = read_geometry_figures(run).get("shape", "surface")
    return f"grade {grade_figures(run)['grade']} and {shape} with {len(check_stage(stage).names)} projectors"


def _one_projector(folder: Path, size: str, thing: str, seeds: Sequence[int]) -> list[Row]:
    """Medians and 95th percentiles on a stage of one projector, against the same one of three."""
    built_in = None if thing == VASE else thing
    found: dict[int, list[tuple[float, float]]] = {FEW: [], MANY: []}
    for count, seed in ((count, seed) for count in found for seed in seeds):
        stage, run = _calibrated(folder, DemoStage(size, seed, built_in, projectors=count))
        found[count].append(_alone(stage, run))
    rows = []
    for n, name in enumerate(("median", "95 %")):
        alone, among = (max(one[n] for one in found[count]) for count in (FEW, MANY))
        how = f"worst of {len(seeds)}; the same one of three: {among:.2f}"
        rows.append(at_most(f"{thing}, one projector, {name}", alone, round(among, 2), unit="CIEDE2000", how=how))
    return rows


def _alone(stage: Path, run: Path) -> tuple[float, float]:
    """Of the first projector alone, the others black, at its own exposure: median and 95th percentile of CIEDE2000."""
    names = check_stage(stage).names
    calibrated = Calibrated(run, names)
    whole = calibrated.calibration
    one = dataclasses.replace(whole, projectors=whole.projectors[:1])
    transport = edged(build_transport(one), run, names[:1])
    asked = expose_target(transport, _smooth(whole.black.shape), whole.black, share=SHARE)
    radiance, direct = (target_radiance(image, whole.black, 1.0) for image in (asked.wanted, asked.needed))
    mask = asked.possible.reachable & transport.object_mask
    settings = SolveSettings(weights=appearance_weights(radiance, mask, asked.exposure))
    solved = solve_bounded(transport, direct, whole.black, settings).frames
    black = [np.zeros((*part.metapixels.valid.shape, 3), np.float32) for part in whole.projectors[1:]]
    judge = Judge(stage, calibrated)
    shown = judge.unit * judge.clean(judge.truth.picture(list(device_frames(whole, [*solved, *black]).values())))
    error = colour_difference(shown, radiance, whole.camera_to_xyz, asked.exposure, mask)[mask]
    return float(np.median(error)), float(np.percentile(error, 95))


def _smooth(shape: Sequence[int]) -> FloatImage:
    """A picture whose colours change slowly, (rows, columns, 3), linear."""
    y, x = np.meshgrid(np.linspace(0, 1, shape[0]), np.linspace(0, 1, shape[1]), indexing="ij")
    waves = [0.55 + 0.25 * np.sin(2 * np.pi * (f * x + g * y)) for f, g in ((1.0, 0.5), (0.5, -1.0), (-1.5, 0.5))]
    return np.stack(waves, axis=-1).astype(np.float32)


__all__: Sequence[str] = ("measure",)
