"""The emulated stage as one world: lamps, outputs, object and camera, so that a shot shows what is really lit."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Protocol

import cv2
import numpy as np
import numpy.typing as npt

from plugins.emulated.core.extensions import extension
from plugins.emulated.core.shot import ShotFiles, ShotSettings
from plugins.emulated.core.truth import BUMPS_FILE, FOLDER, BenchTruth, ObjectTruth
from plugins.emulated.optics.dng import XYZ_TO_LINEAR_SRGB, PictureFacts, dng, with_exif
from plugins.emulated.optics.effects import flickering, rare
from plugins.emulated.optics.indirect.transfers import IndirectTransfers
from plugins.emulated.optics.light_cache import light_folder
from plugins.emulated.optics.objects import StageObject, default_object
from plugins.emulated.optics.outputs import VisibleFrames, VisibleFrameSet
from plugins.emulated.optics.rays import Progress, samples_of
from plugins.emulated.optics.render import Renderer, Shutter
from plugins.emulated.optics.sensor import SENSOR_WIDTH_MM, jpeg, mosaic

MOST_FRAMES_IN_A_SHOT = 6


class LightSource(Protocol):
    """The part of an emulated projector that the world needs."""

    def light_level(self) -> float:
        """Light now: 0 dark (off, shutter closed, lamp failed) to 1 full."""


class World:
    """Makes the camera's pictures of ``stage``. Use in a ``with`` statement: the outputs are watched inside.

    ``lamps``: one for each projector of ``truth``, in its order. Thread-safe as far as one camera needs.
    """

    def __init__(
        self, stage: Path, truth: BenchTruth, lamps: Sequence[LightSource], *, progress: Progress = lambda share: None
    ) -> None:
        self._stage, self._set_up, self._truth = stage, truth, truth
        self._lamps = tuple(lamps)
        thing = object_of(stage, truth.object)
        kept = light_folder(stage / FOLDER)
        self._samples = samples_of(truth, thing, kept, progress)
        self._indirect = IndirectTransfers(thing, kept)
        transfer = self._indirect.transfer(truth, self._samples.pixels, progress, keep=True)
        self._renderer = Renderer(truth, self._samples, transfer)
        self._bumps_seen: tuple[int, int] | None = None
        self._visible = VisibleFrames(stage / truth.frames, truth.latency_s)
        if any(one.frames or one.late_s for one in truth.projectors):
            self._visible = rare("A player or a delay of its own").SeparateOutputs(stage, truth)
        self._rng = np.random.default_rng([truth.seed, 2])
        self._flicker = np.random.default_rng([truth.seed, 5])
        self._moment = np.random.default_rng([truth.seed, 9])
        sensor = truth.camera.sensor
        flawed = sensor.response_spread or sensor.hot_pixels or sensor.shutter_spread
        self._sensor = rare("A flawed sensor, as bench.toml has it,") if flawed else None
        self._flaws = self._sensor and self._sensor.sensor_flaws(truth.camera, truth.seed)
        self._xyz_to_camera = XYZ_TO_LINEAR_SRGB
        if truth.camera.spectral:
            filters = rare("A camera with filters, as bench.toml has it,")
            self._xyz_to_camera = filters.xyz_to_camera(truth.camera.bands_nm)

    def __enter__(self) -> World:
        self._visible.__enter__()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._visible.__exit__(kind, error, trace)

    def warm(self) -> None:
        """Compile the kernels now, so that the first exposure is not late."""
        self._renderer.light([self._frame(i, None) for i in range(len(self._lamps))], [1.0] * len(self._lamps))

    def follow_bumps(self) -> int | None:
        """Look at the bumps of the stage; where they have changed, let them count, and return how many there are.

        Rays are cast again for that; until they are, pictures show the stage as it was.
        Raises DeviceError for a wrong file, or ``bench-part-missing``; the stage then stays as it is.
        """
        path = self._stage / BUMPS_FILE
        try:
            state = path.stat()
            seen: tuple[int, int] | None = (state.st_mtime_ns, state.st_size)
        except OSError:
            seen = None
        if seen == self._bumps_seen:
            return None
        self._bumps_seen = seen
        truth, count = self._set_up, 0
        if seen is not None:
            truth, count = extension("bumps", asked_by=BUMPS_FILE).changed(path, self._set_up)
        if truth == self._truth:
            return count
        samples = self._samples
        if count:
            samples = samples_of(truth, object_of(self._stage, truth.object), None, lambda share: None)
        transfer = self._indirect.transfer(truth, samples.pixels, lambda share: None, keep=not count)
        self._truth, self._renderer = truth, Renderer(truth, samples, transfer)
        return count

    def expose(self, settings: ShotSettings) -> ShotFiles:
        """Take one picture of what is visible during the (scaled) exposure time; lasts ``picture_s`` at least."""
        taken = time.strftime("%Y:%m:%d %H:%M:%S")
        before = [lamp.light_level() for lamp in self._lamps]
        start_s = time.monotonic()
        end_s = start_s + settings.exposure_s * self._truth.time_scale
        time.sleep(max(0.0, end_s - time.monotonic()))
        levels = [0.5 * (first + lamp.light_level()) for first, lamp in zip(before, self._lamps, strict=True)]
        for index, projector in enumerate(self._truth.projectors):
            levels[index] *= flickering(projector.lamp, settings.exposure_s, self._flicker)
        # Panels and shutter keep no time with each other.
        shutter = Shutter(float(self._moment.random()), settings.exposure_s, settings.aperture_f)
        light = self._mixed(self._visible.during(start_s, end_s), levels, shutter)
        files = self._files(light, settings, taken)
        time.sleep(max(0.0, start_s + self._truth.camera.picture_s - time.monotonic()))
        return files

    def _mixed(
        self, visible: list[tuple[float, VisibleFrameSet | None]], levels: Sequence[float], shutter: Shutter
    ) -> npt.NDArray[np.float32]:
        """The time-weighted mean of what was visible; of many frames, the longest-shown few stand for all."""
        longest = sorted(visible, key=lambda part: part[0], reverse=True)[:MOST_FRAMES_IN_A_SHOT]
        total = sum(share for share, _ in longest)
        pictures = [
            (share / total, self._renderer.light([self._frame(i, shown) for i in range(len(levels))], levels, shutter))
            for share, shown in longest
        ]
        if len(pictures) == 1:
            return pictures[0][1]
        mixed = np.zeros_like(pictures[0][1])
        for share, picture in pictures:
            mixed += np.float32(share) * picture
        return mixed

    def _frame(self, index: int, shown: VisibleFrameSet | None) -> npt.NDArray[np.uint8]:
        """What a projector's panel shows: black without a picture, scaled when the picture has another size."""
        projector = self._truth.projectors[index]
        width, height = projector.lens.size_px
        frame = None if shown is None else shown.frames.get(projector.output)
        if frame is None:
            return np.zeros((height, width, 3), dtype=np.uint8)
        if frame.shape != (height, width, 3):
            return np.asarray(cv2.resize(frame, (width, height), interpolation=cv2.INTER_LINEAR), dtype=np.uint8)
        return frame

    def _files(self, light: npt.NDArray[np.float32], settings: ShotSettings, taken: str) -> ShotFiles:
        camera, exposure_s = self._truth.camera, settings.exposure_s
        raw = mosaic(
            light if camera.tint == (1.0, 1.0, 1.0) else light * np.asarray(camera.tint, np.float32),
            camera.sensor,
            self._rng,
            exposure_s=self._sensor.exposed_s(camera, self._truth.seed, exposure_s) if self._sensor else exposure_s,
            iso=settings.iso,
            aperture_f=settings.aperture_f,
            flaws=self._flaws,
        )
        facts = PictureFacts(
            exposure_s=exposure_s,
            iso=settings.iso,
            aperture_f=settings.aperture_f,
            # Lenses report whole millimetres, so a picture tells the focal length only roughly.
            focal_length_mm=float(round(camera.lens.focal_px / camera.lens.size_px[0] * SENSOR_WIDTH_MM)),
            taken=taken,
            serial_number=camera.serial_number,
            xyz_to_camera=self._xyz_to_camera,
        )
        levels = {"black_level": camera.sensor.black_level, "white_level": camera.sensor.white_level}
        return ShotFiles(
            raw=dng(raw, facts=facts, **levels) if settings.raw else None,
            jpeg=with_exif(jpeg(raw, camera.sensor), facts) if settings.jpeg else None,
        )


def object_of(stage: Path, kept: ObjectTruth) -> StageObject:
    """The object of a prepared stage. Raises DeviceError ``object-unreadable``."""
    if kept.kind == "mesh" or kept.file:
        return StageObject.read(stage / kept.file)
    return default_object()
