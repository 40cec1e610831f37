"""Which of the bench's objects are calibrated, as what shape, and how well they show a smooth picture.

At last the same projector lights the same object twice: on a stage of its own, and as one of three that were
calibrated together. Where a stage of one has no shape, the object's outline is drawn, as docs/how-to/flat-objects.md
says; the one without it is reported, too. All frames are judged in the light of the stage, without noise.
``BENCH_OBJECTS``, ``BENCH_SEEDS`` and ``BENCH_ALONE`` choose some; ``BENCH_FOLDER`` keeps the stages, and measures
kept ones again.
"""

from __future__ import annotations

import dataclasses
import os
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import cv2
import numpy as np

from controller.core.arrays import FloatImage
from controller.core.colour import linear_to_srgb
from controller.demo import DemoStage, prepare
from controller.optics.solve.bounded.equations import SolveSettings, appearance_weights
from controller.optics.solve.bounded.solver import solve_bounded
from controller.optics.solve.reach.drive_levels import DriveLevels
from controller.optics.solve.reach.feasibility import expose_target, target_radiance
from controller.optics.solve.result.metrics import colour_difference
from controller.optics.transport import build_transport
from controller.stage.artefacts.calibrated import Calibrated
from controller.stage.artefacts.geometry import read_shape
from controller.stage.artefacts.outline import Regions, keep_outline
from controller.stage.sessions.check import check_stage
from controller.stage.steps.appearance.solving import device_frames
from controller.stage.steps.calibrate.gate import grade_figures
from hal.errors import CodedError
from lab.timings import Row, at_least, at_most
from lab.timings.calibration.indirect import Judge, judged, worked
from lab.timings.tools.truth import Truth
from plugins.emulated.core.truth import read_truth

OBJECTS: Final = "painting painting:3 relief corner cylinder sphere two-objects"
ALONE: Final = "vase painting"
VASE: Final = "vase"
"""The vase and the bust, which have no name on the bench."""
PICTURE, PICTURE_FILE = "smooth", "smooth.png"
REFINED: Final = {0: (1.2, 6.0), 1: (0.9, 5.0)}
"""Goals at size medium, median and 95 % of CIEDE2000 in reach, by photographs of the result."""
FEW, MANY = 1, 3
SHARE: Final = 0.95
DRAWN_PX: Final = 2.0
SPECK_PX: Final = 500
"""Square pixels of what a person would not draw around."""


def measure(size: str) -> list[Row]:
    """Calibrate every chosen object and seed, and judge a smooth picture on it; then one projector on some."""
    seeds = [int(seed) for seed in os.environ.get("BENCH_SEEDS", "1").split()]
    rows: list[Row] = []
    with tempfile.TemporaryDirectory(prefix="velatura-bench-") as temporary:
        folder = Path(os.environ.get("BENCH_FOLDER", temporary))
        for thing in os.environ.get("BENCH_OBJECTS", OBJECTS).split():
            rows += _rows(folder, size, thing, seeds)
        for thing in os.environ.get("BENCH_ALONE", ALONE).split():
            rows += _one_projector(folder, size, thing, seeds)
    return rows


def _rows(folder: Path, size: str, thing: str, seeds: Sequence[int]) -> list[Row]:
    """``thing``: a name, and perhaps a colon and how many projectors light it."""
    name, _, count = thing.partition(":")
    built_in, projectors = None if name == VASE else name, int(count) if count else None
    said, figures = [], []
    for seed in seeds:
        try:
            stage, run = _calibrated(folder, DemoStage(size, seed, built_in, projectors=projectors))
        except CodedError as error:
            said.append(f"{error.code}: {error.what}")
            continue
        shape = read_shape(run).shape
        said.append(f"grade {grade_figures(run)['grade']} and {shape} with {len(check_stage(stage).names)} projectors")
        figures.append(judged(stage, run, (PICTURE,), tuple(REFINED)))
    rows = [at_least(f"{thing}, calibrated", len(figures), len(seeds), unit="stages", how="; ".join(said))]
    for photographs, goals in REFINED.items() if figures else ():
        for key, goal in zip(("median", "95"), goals, strict=True):
            values = [one[f"{PICTURE} {key}, {photographs}"] for one in figures]
            how = ", ".join(f"{value:.2f}" for value in values)
            figure = f"{thing}, smooth picture, {key}, {photographs} photographs"
            rows.append(at_most(figure, max(values), goal, unit="CIEDE2000", how=how))
    return rows


def _calibrated(folder: Path, asked: DemoStage) -> tuple[Path, Path]:
    """The stage and its calibration, with the picture solved on it, made now or before. Raises CodedError."""
    extra = [str(one) for one in (asked.thing or VASE, asked.projectors) if one is not None]
    stage = prepare(folder / "-".join((asked.size, str(asked.seed), *extra)), asked)
    if not (stage / PICTURE_FILE).exists():
        width, height = read_truth(stage).camera.lens.size_px
        screen = np.rint(255 * linear_to_srgb(_smooth((height, width)))).astype(np.uint8)
        cv2.imwrite(str(stage / PICTURE_FILE), screen[..., ::-1])
        toml = stage / "stage.toml"
        table = f'\n[[appearances]]\nname = "{PICTURE}"\nkind = "picture"\nfile = "{PICTURE_FILE}"\n'
        toml.write_text(toml.read_text().split("[[appearances]]")[0] + table)
    return stage, worked(stage, (PICTURE,), tuple(REFINED))


def _one_projector(folder: Path, size: str, thing: str, seeds: Sequence[int]) -> list[Row]:
    """Medians and 95th percentiles on a stage of one projector, against the same one of three."""
    built_in = None if thing == VASE else thing
    found: dict[int, list[tuple[float, float]]] = {FEW: [], MANY: []}
    plain: list[tuple[float, float]] = []
    for count, seed in ((count, seed) for count in found for seed in seeds):
        stage, run = _calibrated(folder, DemoStage(size, seed, built_in, projectors=count))
        keep_outline(run, ())
        found[count].append(_alone(stage, run))
        if count == FEW and read_shape(run).shape == "unknown":
            plain.append(found[count].pop())
            keep_outline(run, _silhouette(stage))
            found[count].append(_alone(stage, run))
    rows = []
    for n, name in enumerate(("median", "95 %")):
        alone, among = (max(one[n] for one in found[count]) for count in (FEW, MANY))
        how = f"worst of {len(seeds)}; the same one of three: {among:.2f}"
        how += f"; without an outline {max(one[n] for one in plain):.2f}" if plain else ""
        rows.append(at_most(f"{thing}, one projector, {name}", alone, round(among, 2), unit="CIEDE2000", how=how))
    return rows


def _silhouette(stage: Path) -> Regions:
    """What a person would draw around the object, 2 px from the truth at most."""
    seen = np.isfinite(Truth(stage).points_m()[..., 2]).astype(np.uint8)
    parts, _ = cv2.findContours(seen, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    drawn = [cv2.approxPolyDP(part, DRAWN_PX, True)[:, 0] for part in parts if cv2.contourArea(part) > SPECK_PX]
    return [[(float(x) / seen.shape[1], float(y) / seen.shape[0]) for x, y in part] for part in drawn]


def _alone(stage: Path, run: Path) -> tuple[float, float]:
    """Of the first projector alone, the others black, at its own exposure: median and 95th percentile of CIEDE2000."""
    names = check_stage(stage).names
    calibrated = Calibrated(run, names)
    whole = calibrated.calibration
    one = dataclasses.replace(whole, projectors=whole.projectors[:1])
    transport = build_transport(one)
    asked = expose_target(DriveLevels.of_transport(transport), _smooth(whole.black.shape), whole.black, share=SHARE)
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
