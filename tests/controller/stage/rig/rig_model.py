"""A stage of models: a camera that writes what it was asked, a display that remembers, lamps with a clock."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import numpy.typing as npt

from controller.optics.capture.acquire import Acquirer
from controller.stage.rig.lamp_guard import LampGuard
from controller.stage.rig.rig import Rig, RigProjector
from hal.deadline import Deadline
from hal.errors import DeviceError
from hal.values import (
    CameraCapabilities,
    CapturedFile,
    DeviceIdentity,
    ExposureSettings,
    FileKind,
    OutputInfo,
    Presented,
)
from tests.controller.stage.rig.lamp_model import Lamp, Shelf, World, soon

EXPOSURES_S = (0.25, 0.5, 1.0, 2.0)
SIZE_PX = (4, 3)
STEADY_S = 20.0


@dataclass
class ModelDisplay:
    """Remembers every set of frames that it showed."""

    shown: list[dict[str, npt.NDArray[np.uint8]]] = field(default_factory=list)

    def identity(self, *, deadline: Deadline) -> DeviceIdentity:
        return DeviceIdentity("Model", "Display")

    def close(self) -> None:
        """Nothing to release."""

    def outputs(self, *, deadline: Deadline) -> tuple[OutputInfo, ...]:
        return tuple(OutputInfo(name, *SIZE_PX) for name in ("P1", "P2"))

    def show(self, frames: Mapping[str, npt.NDArray[np.uint8]], *, deadline: Deadline) -> Presented:
        self.shown.append({name: frame.copy() for name, frame in frames.items()})
        return Presented(len(self.shown), 0.0)

    def play(self, appearance: str, *, deadline: Deadline) -> Presented:
        return Presented(0, 0.0)


@dataclass
class ModelCamera:
    """Writes files that say how they were taken; ``kinds`` per picture, ``fails`` at the next one."""

    kinds: tuple[FileKind, ...] = (FileKind.JPEG, FileKind.RAW)
    configured: list[ExposureSettings] = field(default_factory=list)
    taken: list[str] = field(default_factory=list)
    rounding: float = 1.0
    fails: DeviceError | None = None

    @property
    def capabilities(self) -> CameraCapabilities:
        return CameraCapabilities(EXPOSURES_S, (100,), (), raw=True, jpeg=True)

    def identity(self, *, deadline: Deadline) -> DeviceIdentity:
        return DeviceIdentity("Model", "Camera")

    def close(self) -> None:
        """Nothing to release."""

    def configure(self, settings: ExposureSettings, *, deadline: Deadline) -> ExposureSettings:
        self.configured.append(settings)
        return ExposureSettings(settings.exposure_s * self.rounding, settings.iso, settings.aperture_f)

    def capture(self, destination: Path, *, deadline: Deadline) -> list[CapturedFile]:
        if self.fails is not None:
            raise self.fails
        self.taken.append(destination.name)
        destination.parent.mkdir(parents=True, exist_ok=True)
        return [self._file(destination.with_suffix(f".{kind.value}"), kind) for kind in self.kinds]

    def _file(self, path: Path, kind: FileKind) -> CapturedFile:
        data = f"{path.name}, picture {len(self.taken)}".encode()
        path.write_bytes(data)
        return CapturedFile(path, kind, len(data), hashlib.sha256(data).hexdigest())


@dataclass
class ModelRig:
    """Two lit and steady projectors, ``left`` on P1 and ``right`` on P2, a camera and a display."""

    folder: Path
    world: World = field(default_factory=World)
    display: ModelDisplay = field(default_factory=ModelDisplay)
    camera: ModelCamera = field(default_factory=ModelCamera)

    def __post_init__(self) -> None:
        self.lamps = {name: Lamp(self.world) for name in ("left", "right")}
        shelf = Shelf()
        guards = [LampGuard(name, lamp, shelf, clock=self.world) for name, lamp in self.lamps.items()]
        for guard in guards:
            guard.switch_on(deadline=soon())
        self.world.time_s += STEADY_S
        projectors = tuple(
            RigProjector(guard.name, output, SIZE_PX, guard) for guard, output in zip(guards, ("P1", "P2"), strict=True)
        )
        acquirer = Acquirer(self.display, self.camera, iso=100, aperture_f=None, settle_s=0.0)
        self.rig = Rig(self.folder, projectors, self.camera, self.display, acquirer)
