"""Live targets: how long their frames take, how far they are from the reference, how many a real player shows a second.

Everything is on the processor: memory outputs have no shaders.
"""

from __future__ import annotations

import os
import statistics
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import cv2
import numpy as np
import numpy.typing as npt

from controller.bundle.live_maps import LiveMaps, compensate
from controller.core.arrays import ByteImage, FloatImage
from controller.core.colour import linear_to_srgb
from controller.optics.calibrate.values import Calibration, Radiometry
from controller.optics.solve.appearance import StageLight, base_image, scale_frames, solve_base
from controller.optics.solve.bounded.equations import SolveSettings
from controller.optics.solve.scaling.dither import to_device, to_light
from controller.optics.solve.scaling.interactive import Interactive
from controller.optics.solve.scaling.stage_maps import reduced, reduction, scaling_maps
from controller.optics.solve.targets.files import shipped_photograph
from controller.optics.transport import LightTransport, build_transport
from controller.play.control.launch import PlayerSettings, start_player
from controller.play.frames import FrameFile, FrameSet, OutputSize
from controller.stage.live import LivePicture, LiveSource, VideoSource
from controller.stage.steps.appearance.live import FrameMaker, run_live
from hal.deadline import in_seconds
from hal.registry import OpenContext
from hal.values import LiveStatus
from lab.timings import Row, at_least, at_most
from lab.timings.tools.synthetic import synthetic_calibration, synthetic_indirect, synthetic_target
from plugins.display.player import DRIVER, PlayerDisplay

BRIGHTNESS: Final = 0.25
"""The radiance of white: most of the synthetic target is within reach of it."""
REPEATS: Final = 15
TURNS: Final = 40
STREAMED_S: Final = 12.0
AS_FAST_HZ: Final = 1000.0
DIFFERENT: Final = 6
VIDEO_PX: Final = (1280, 720)


def measure(size: str) -> list[Row]:
    """A float picture and an sRGB target to frames, their errors, and a stream of both kinds through a player."""
    paper = size == "paper"
    calibration = synthetic_calibration(size)
    transport = build_transport(calibration)
    base = solve_base(transport, base_image(calibration, "white"), calibration.black, SolveSettings(tolerance=1e-2))
    radiometries = [part.radiometry for part in calibration.projectors]
    maps = scaling_maps(StageLight(transport, calibration.black), base, radiometries, ["P1", "P2", "P3"])
    wanted = synthetic_target(transport.camera_shape)
    small = reduced(wanted, reduction(transport.camera_shape))
    target = np.asarray(np.rint(255 * linear_to_srgb(small)), np.uint8)
    scaler = Interactive(maps, transport.camera_shape)
    rows = _speeds(scaler, np.float32(BRIGHTNESS) * wanted, target, paper=paper)
    thrown = synthetic_indirect(calibration, transport.object_mask)
    with_g = scaling_maps(StageLight(transport, calibration.black, thrown), base, radiometries, ["P1", "P2", "P3"])
    rows += _indirect(scaler, Interactive(with_g, transport.camera_shape), target)
    rows += _errors(scaler, target, paper=paper)
    radiance = np.float32(BRIGHTNESS) * wanted
    exact = scale_frames(transport, base, radiance, calibration.black)
    papers = scaling_maps(StageLight(transport, calibration.black), base, radiometries, ["P1", "P2", "P3"], spread=1.0)
    papers_way = Interactive(papers, transport.camera_shape)
    rows.append(_error_of_maps(papers_way, exact, radiometries, radiance))
    rows.append(_nearer(transport, calibration, {"ours": scaler, "eq. 6": papers_way}))
    with tempfile.TemporaryDirectory(prefix="velatura-bench-") as folder:
        rows += _streams(Path(folder), scaler, target, paper=paper)
    return rows


@dataclass(frozen=True, slots=True)
class _Spent:
    """Milliseconds over repeats: of the clock, and of the processor in all threads together."""

    wall_ms: list[float]
    cpu_ms: list[float]

    def __str__(self) -> str:
        low, middle, high = min(self.wall_ms), statistics.median(self.wall_ms), max(self.wall_ms)
        cpu = min(self.cpu_ms), statistics.median(self.cpu_ms)
        return (
            f"min {low:.1f}, median {middle:.1f}, max {high:.1f} ms; processor time of all threads "
            f"min {cpu[0]:.1f}, median {cpu[1]:.1f} ms"
        )


def _spent(work: Callable[[], object], repeats: int = REPEATS) -> _Spent:
    work()
    found = _Spent([], [])
    for _ in range(repeats):
        began, cpu = time.perf_counter(), time.process_time()
        work()
        found.wall_ms.append(1e3 * (time.perf_counter() - began))
        found.cpu_ms.append(1e3 * (time.process_time() - cpu))
    return found


def _speeds(scaler: Interactive, radiance: FloatImage, target: ByteImage, *, paper: bool) -> list[Row]:
    frames = scaler.blank()
    appearance = _spent(lambda: scaler.frames(radiance))
    live = _spent(lambda: scaler.show_picture(target, BRIGHTNESS, frames))
    return [
        at_most(
            "new appearance, float picture to 8-bit frames",
            min(appearance.wall_ms),
            100.0 if paper else None,
            unit="ms",
            how=str(appearance),
        ),
        at_most(
            "a live target, sRGB in memory to 8-bit frames",
            min(live.wall_ms),
            40.0 if paper else None,
            unit="ms",
            how=str(live),
        ),
    ]


def _indirect(without: Interactive, with_g: Interactive, target: ByteImage) -> list[Row]:
    """What indirect light costs a live target: both ways turn about, so that what else runs slows both alike."""
    frames = without.blank()
    ways = [lambda: without.show_picture(target, BRIGHTNESS, frames),
            lambda: with_g.show_picture(target, BRIGHTNESS, frames)]  # fmt: skip
    spent = [_Spent([], []), _Spent([], [])]
    for _ in range(TURNS):
        for way, so_far in zip(ways, spent, strict=True):
            once = _spent(way, 1)
            so_far.wall_ms.extend(once.wall_ms)
            so_far.cpu_ms.extend(once.cpu_ms)
    plain, more = spent
    blocks = 0 if with_g.maps.indirect is None else len(with_g.maps.indirect.factors)
    how = f"{TURNS} of each, turn about, {blocks} blocks; without {plain}; with {more}"
    apart = statistics.median(np.subtract(more.wall_ms, plain.wall_ms))
    return [
        at_most("a live target with indirect light, more than without", apart, 2.0, unit="ms",
                how=f"median of the differences; {how}"),
        at_most("the same, processor time of all threads", statistics.median(np.subtract(more.cpu_ms, plain.cpu_ms)),
                None, unit="ms", how="median of the differences"),
        at_most("the same, to that without", statistics.median(more.wall_ms) / statistics.median(plain.wall_ms), None,
                unit="x", how="of the medians"),
    ]  # fmt: skip


def _errors(scaler: Interactive, target: ByteImage, *, paper: bool) -> list[Row]:
    """Against the reference in numpy, dithering included."""
    frames = scaler.blank()
    scaler.show_picture(target, BRIGHTNESS, frames)
    began = time.perf_counter()
    reference = compensate(scaler.maps, target, BRIGHTNESS)
    seconds = time.perf_counter() - began
    away = _away(scaler.maps, frames, reference)
    return [
        at_most(
            "error of live frames against the numpy reference, mean",
            float(away.mean()),
            2.0,
            unit="of 255",
            how=f"lit pixels; 99 % within {np.percentile(away, 99):.0f}, at most {away.max()}; "
            f"the reference took {seconds:.2g} s",
        )
    ]


def _error_of_maps(
    scaler: Interactive, exact: Sequence[FloatImage], radiometries: Sequence[Radiometry], radiance: FloatImage
) -> Row:
    """Against base times scale with the light transport's own means, dithered by the same thresholds."""
    wanted = [
        to_device(frame, radiometry, method="blue-noise", phase=output.dither)
        for frame, radiometry, output in zip(exact, radiometries, scaler.maps.outputs, strict=True)
    ]
    away = _away(scaler.maps, scaler.frames(radiance), wanted)
    return at_most(
        "error of frames by eq. 6's means against every camera sample with its own share, mean",
        float(away.mean()),
        None,
        unit="of 255",
        how=f"lit pixels; 99 % within {np.percentile(away, 99):.0f}, at most {away.max()}",
    )


def _nearer(transport: LightTransport, calibration: Calibration, ways: Mapping[str, Interactive]) -> Row:
    """How far the light of frames is from a photograph, in the model, with means narrower than a pixel's light."""
    picture = cv2.resize(shipped_photograph(), transport.camera_shape[::-1], interpolation=cv2.INTER_AREA)
    radiance = np.asarray(picture * np.float32(BRIGHTNESS), np.float32)
    mask = transport.object_mask & (transport.reach() + calibration.black > radiance).all(axis=2)
    rms = {}
    for name, way in ways.items():
        frames = zip(way.frames(radiance), calibration.projectors, strict=True)
        seen = transport.forward([to_light(frame, part.radiometry) for frame, part in frames]) + calibration.black
        rms[name] = float(np.sqrt(np.mean((seen - radiance)[mask].astype(np.float64) ** 2)))
    told = ", ".join(f"{name} {100 * value / BRIGHTNESS:.2f} %" for name, value in rms.items())
    return at_most(
        "a live picture's rms error against its target, to that of eq. 6",
        rms["ours"] / rms["eq. 6"],
        1.0,
        unit="",
        how=f"rms of white, where the target is in reach: {told}",
    )


def _away(maps: LiveMaps, frames: Sequence[ByteImage], wanted: Sequence[ByteImage]) -> npt.NDArray[np.int64]:
    """How far apart the device values of lit pixels are."""
    parts = zip(frames, wanted, maps.outputs, strict=True)
    lit = [np.abs(frame.astype(np.int64) - other)[output.shape[..., 0] > 0].ravel() for frame, other, output in parts]
    return np.concatenate(lit)


class _Pictures:
    """Different targets in memory, as fast as they are asked for."""

    def __init__(self, target: ByteImage) -> None:
        self._targets = [np.roll(target, 31 * number, axis=1) for number in range(DIFFERENT)]
        self._number = -1

    def next(self, at_s: float) -> LivePicture | None:
        """See ``controller.stage.live.LiveSource``."""
        self._number += 1
        return LivePicture(self._targets[self._number % DIFFERENT], self._number, 0)

    @property
    def ended(self) -> bool:
        return False

    def close(self) -> None:
        """Nothing is open."""


def _streams(folder: Path, scaler: Interactive, target: ByteImage, *, paper: bool) -> list[Row]:
    outputs = [OutputSize(output.name, *output.size_px) for output in scaler.maps.outputs]
    settings = PlayerSettings([(o.name, o.width_px, o.height_px) for o in outputs], folder / "out.frame")
    video = _video(folder / "video.avi", target)
    kinds: list[tuple[str, Callable[[], LiveSource], bool]] = [
        ("live targets shown, from memory", lambda: _Pictures(target), paper),
        ("live targets shown, from a video file", lambda: VideoSource(video, loop=True), False),
    ]
    rows = []
    with start_player(folder, settings) as player:
        display = DRIVER.open({}, OpenContext(stage=folder, runtime=folder), in_seconds(20))
        assert isinstance(display, PlayerDisplay)
        for figure, source, has_goal in kinds:
            cpu_s = time.process_time(), _cpu_s(player.pid)
            shown, seconds, live = _streamed(display, folder / "live.frame", outputs, scaler, source())
            ours_ms, players_ms = (
                1e3 * (now - before) / max(shown, 1)
                for now, before in zip((time.process_time(), _cpu_s(player.pid)), cpu_s, strict=True)
            )
            delay_ms = 1e3 * (live.delay_p50_s or 0.0)
            rows.append(
                at_least(figure, shown / seconds, 25.0 if has_goal else None, unit="/s",
                         how=f"{shown} in {seconds:.1f} s by a player of its own, into memory outputs; from written "
                         f"to presented p50 {delay_ms:.0f} ms; processor time a target {ours_ms:.0f} ms here and "
                         f"{players_ms:.0f} ms in the player")
            )  # fmt: skip
        display.close()
    return rows


def _cpu_s(pid: int) -> float:
    """Processor time of a process so far."""
    fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _streamed(
    display: PlayerDisplay, path: Path, outputs: Sequence[OutputSize], scaler: Interactive, source: LiveSource
) -> tuple[int, float, LiveStatus]:
    path.unlink(missing_ok=True)
    file = FrameFile(path, outputs)
    display.live(path, deadline=in_seconds(20))
    began = time.perf_counter()
    run_live(source, FrameMaker(scaler, BRIGHTNESS), lambda frames: file.write(FrameSet(tuple(frames))),
             rate_hz=AS_FAST_HZ, seconds=STREAMED_S)  # fmt: skip
    seconds = time.perf_counter() - began
    status = display.playing(deadline=in_seconds(20)).live
    assert status is not None
    display.stop(deadline=in_seconds(20))
    file.close()
    return status.shown, seconds, status


def _video(path: Path, target: ByteImage) -> Path:
    """A second of motion at 60 frames a second, MJPG."""
    picture = cv2.resize(np.ascontiguousarray(target[..., ::-1]), VIDEO_PX)
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 60.0, VIDEO_PX)
    for number in range(60):
        writer.write(np.roll(picture, 20 * number, axis=1))
    writer.release()
    return path
