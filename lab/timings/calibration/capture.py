"""What a photograph costs: on the bench (rays, light, file), through the whole chain, and its development."""

from __future__ import annotations

import tempfile
import threading
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import rawpy

from controller.core.arrays import ByteImage
from controller.optics.capture.acquire import Shot
from controller.optics.capture.latency import fingerprint
from controller.optics.capture.raw import read_photograph
from controller.run.progress import Silent
from controller.run.runner import Context, Step
from controller.run.step_id import StepId
from controller.stage.rig.rig import Rig
from controller.stage.sessions.bench import BenchProcess
from controller.stage.sessions.check import check_stage
from controller.stage.sessions.session import OwnSession, StageWork
from hal.deadline import in_seconds
from lab.timings import Row, Timing, at_most, peak_bytes, timed
from lab.timings.tools.stage import FIRST_SEED, over, prepared_stage
from plugins.emulated.core.truth import BenchTruth, read_truth
from plugins.emulated.optics.dng import PictureFacts, dng
from plugins.emulated.optics.rays import cast
from plugins.emulated.optics.render import Renderer
from plugins.emulated.optics.sensor import mosaic
from plugins.emulated.optics.world import object_of

SHOTS = {"small": 20, "medium": 10, "paper": 6}
EXPOSURE_S = 1 / 30
FRAME_GOAL_S = 4.0
BORDER_PX = 4


def measure(size: str) -> list[Row]:
    """Frames of the bench in this process, then shots through drivers with the bench in its own."""
    with prepared_stage(size, FIRST_SEED) as stage:
        truth = read_truth(stage)
        rows = _bench(stage, truth, paper=size == "paper")
        rows += _chain(stage, SHOTS[size])
    rows.append(
        at_most("peak memory of the process", peak_bytes() / 1e9, None, unit="GB", how="the bench's optics are in it")
    )
    return rows


def _bench(stage: Path, truth: BenchTruth, *, paper: bool) -> list[Row]:
    stage_object = object_of(stage, truth.object)
    began = time.perf_counter()
    samples = cast(truth, stage_object, lambda share: None)
    cast_s = time.perf_counter() - began
    renderer = Renderer(truth, samples)
    frames, rng = _Fresh(truth), np.random.default_rng(0)
    shown = frames.all()
    all_new = timed(lambda: renderer.light(frames.all(), [1.0] * len(shown)))
    one_new = timed(lambda: renderer.light([frames.one(0), *shown[1:]], [1.0] * len(shown)))
    light = renderer.light(shown, [1.0] * len(shown))

    def file() -> bytes:
        raw = mosaic(light, truth.camera.sensor, rng, exposure_s=EXPOSURE_S, iso=100, aperture_f=8.0)
        facts = PictureFacts(EXPOSURE_S, 100, 8.0, 50.0, "2024:01:01 00:00:00", "0")
        return dng(raw, black_level=truth.camera.sensor.black_level, white_level=4095, facts=facts)

    written = timed(file)
    whole = all_new.median + written.median
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "photograph.dng"
        path.write_bytes(file())
        developing = _development(path)
    return [
        at_most("rays of a stage, cast once", cast_s, None, unit="s", how=f"{len(samples.albedo)} rays that hit"),
        at_most("light, three new outputs", all_new.median, None, unit="s", how=str(all_new)),
        at_most("light, one new output", one_new.median, None, unit="s", how=str(one_new)),
        at_most("sensor and DNG", written.median, None, unit="s", how=str(written)),
        at_most("one captured frame", whole, FRAME_GOAL_S if paper else None, unit="s", how="three new outputs"),
        *developing,
    ]


class _Fresh:
    """Frames that were never shown before, so that the renderer has no layer of them."""

    def __init__(self, truth: BenchTruth) -> None:
        self._sizes = [projector.lens.size_px for projector in truth.projectors]
        self._rng = np.random.default_rng(1)

    def one(self, n: int) -> ByteImage:
        width, height = self._sizes[n]
        return self._rng.integers(0, 256, (height, width, 3), dtype=np.uint8)

    def all(self) -> list[ByteImage]:
        return [self.one(n) for n in range(len(self._sizes))]


def _development(path: Path) -> list[Row]:
    """Our development against LibRaw's reading with OpenCV's interpolation, and against the reading alone."""
    ours = timed(lambda: read_photograph(path))
    theirs = timed(partial(_opencv, path))
    reading = timed(partial(_mosaic, path))
    image, other = read_photograph(path).image, _opencv(path)
    inner = slice(BORDER_PX, -BORDER_PX)
    difference = float(np.abs(image[inner, inner] - other[inner, inner]).max())
    ratios = [getattr(ours, key) / getattr(theirs, key) for key in Timing.__dataclass_fields__]
    how = f"ours {ours}; theirs {theirs}; ratios {', '.join(f'{ratio:.2f}' for ratio in ratios)}"
    return [
        at_most("RAW development", ours.median, None, unit="s", how=f"LibRaw's reading in it: {reading}"),
        at_most("RAW development by rawpy and OpenCV's bilinear", ratios[1], 2.0, unit="x", how=how),
        at_most("is it the picture before?", timed(lambda: fingerprint(path, EXPOSURE_S)).median, None, unit="s",
                how="a photograph's sparse samples, LibRaw's reading in it"),
        at_most("largest difference from OpenCV's", 100 * difference, None, unit="% of full scale",
                how=f"but {BORDER_PX} pixels of border; its output has 16 bits"),
    ]  # fmt: skip


def _mosaic(path: Path) -> np.ndarray[tuple[int, ...], np.dtype[np.uint16]]:
    with rawpy.imread(str(path)) as raw:
        return np.array(raw.raw_image_visible)


def _opencv(path: Path) -> np.ndarray[tuple[int, ...], np.dtype[np.float32]]:
    """Linear RGB, 0 at the black level and 1 at the white level, as a short script would make it."""
    with rawpy.imread(str(path)) as raw:
        pixels = np.array(raw.raw_image_visible)
        black, white = float(raw.black_level_per_channel[0]), float(raw.white_level)
    # OpenCV names the pattern by its second row and column: BG is what others call RGGB.
    colour = cv2.cvtColor(pixels, cv2.COLOR_BayerBG2RGB).astype(np.float32)
    colour -= np.float32(black)
    colour *= np.float32(1 / (white - black))
    return colour


def _chain(stage: Path, shots: int) -> list[Row]:
    """Seconds a shot with the lamps lit: frames to the player, exposure, light, file, PTP/IP, disk."""
    checked, cancel = check_stage(stage), threading.Event()
    new: list[float] = []
    same: list[float] = []

    def take(rig: Rig, context: Context) -> Sequence[Path]:
        rng = np.random.default_rng(2)
        for number in range(shots + 1):
            frames = {
                p.output: rng.integers(0, 256, (p.size_px[1], p.size_px[0], 3), dtype=np.uint8) for p in rig.projectors
            }
            for kind, times in (("new", new), ("same", same)):
                times.append(_shot(rig, frames, context.folder / f"{kind}-{number}"))
        return ()

    began = time.perf_counter()
    with BenchProcess(stage, cancel=cancel):
        started_s = time.perf_counter() - began
        OwnSession(stage).run(
            checked,
            StageWork("shots", lambda rig, _: [Step(StepId("shots"), partial(take, rig))]),
            reporter=Silent(),
            cancel=cancel,
        )
    settle_s = checked.stage.tables.capture.settle_s
    how = f"{over(new[1:])}; {settle_s:g} s to settle and the exposure ({EXPOSURE_S:.3g} s, a quarter of it) in it"
    return [
        at_most("bench, start", started_s, None, unit="s", how="process, rays, compiling; devices answer"),
        at_most("a shot, three new outputs", float(np.median(new[1:])), None, unit="s", how=how),
        at_most("a shot, the same picture", float(np.median(same[1:])), None, unit="s", how=over(same[1:])),
        at_most("capture rate", 60 / float(np.median(new[1:])), None, unit="shots a minute", how="three new outputs"),
    ]


def _shot(rig: Rig, frames: dict[str, ByteImage], path: Path) -> float:
    path.parent.mkdir(parents=True, exist_ok=True)
    began = time.perf_counter()
    file, _ = rig.acquirer.take(Shot(path.name, frames, EXPOSURE_S), path.parent, deadline=in_seconds(120))
    elapsed = time.perf_counter() - began
    file.path.unlink()
    return elapsed
