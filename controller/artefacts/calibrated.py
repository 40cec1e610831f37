"""The calibration of a run with its transport and base image, read when needed."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from controller.artefacts.calibration import read_calibration
from controller.artefacts.depth_edges import edged
from controller.artefacts.geometry import camera_px
from controller.artefacts.solved import SolvedBase
from controller.calibrate.values import Calibration
from controller.solve.appearance import Base, prepare_base
from controller.solve.drive_levels import DriveLevels
from controller.transport import LightTransport, build_transport


class Calibrated:
    """The calibration of a run and its transport, read at the first use and kept."""

    def __init__(self, folder: Path, projectors: Sequence[str]) -> None:
        self.folder = folder
        self.projectors = tuple(projectors)
        self._calibration: Calibration | None = None
        self._transport: LightTransport | None = None
        self._base: Base | None = None
        self._drive: DriveLevels | None = None

    @property
    def base_folder(self) -> Path:
        """The folder of the base image."""
        return self.folder

    @property
    def camera_px(self) -> tuple[int, int] | None:
        """(width, height) of the camera's picture; None before the geometry is known."""
        return camera_px(self.folder)

    @property
    def calibration(self) -> Calibration:
        if self._calibration is None:
            self._calibration = read_calibration(self.folder, self.projectors)
        return self._calibration

    @property
    def transport(self) -> LightTransport:
        if self._transport is None:
            self._transport = edged(build_transport(self.calibration), self.folder, self.projectors)
        return self._transport

    @property
    def base(self) -> Base:
        """The solved base image, as the step of that kind wrote it."""
        if self._base is None:
            solved = SolvedBase.read(self.base_folder, self.projectors)
            self._base = prepare_base(self.transport, solved.image, self.calibration.black, solved.solution)
        return self._base

    @property
    def drive(self) -> DriveLevels:
        if self._drive is None:
            self._drive = DriveLevels(self.transport)
        return self._drive

    def keep_base(self, base: Base) -> None:
        self._base = base
