"""The calibration of a run with its transport and base image, read when needed."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from controller.core.arrays import FloatImage
from controller.optics.calibrate.photometry.reflectance import own_reflectance
from controller.optics.calibrate.values import Calibration
from controller.optics.solve.appearance import Base, StageLight, prepare_base
from controller.optics.solve.bounded.engine import Engine, Processor
from controller.optics.solve.reach.drive_levels import DriveLevels
from controller.optics.transport import LightTransport, build_transport
from controller.optics.transport.indirect.fit import beside, fit_indirect
from controller.optics.transport.indirect.indirect_light import IndirectLight
from controller.stage.artefacts.calibration import read_calibration
from controller.stage.artefacts.geometry import camera_px, known_geometry
from controller.stage.artefacts.solved import SolvedBase


class Calibrated:
    """The calibration of a run and its transport, read at the first use and kept.

    ``engine``: what does the heavy loops of its solves
    """

    def __init__(self, folder: Path, projectors: Sequence[str], engine: Engine | None = None) -> None:
        self.folder = folder
        self.projectors = tuple(projectors)
        self.engine: Engine = Processor() if engine is None else engine
        self._calibration: Calibration | None = None
        self._transport: LightTransport | None = None
        self._indirect: IndirectLight | None = None
        self._indirect_known = False
        self._base: Base | None = None
        self._drive: DriveLevels | None = None
        self._reflectance: FloatImage | None = None

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
            self._transport = build_transport(self.calibration)
        return self._transport

    @property
    def indirect(self) -> IndirectLight | None:
        """Light by way of other surfaces; None where the run measured none that counts."""
        if not self._indirect_known:
            geometry = known_geometry(self.folder)
            points_m, normals = (None, None) if geometry is None else (geometry.points_m, geometry.normals)
            found = fit_indirect(self.calibration, self.transport.object_mask, points_m, normals)
            self._indirect = None if found is None else found.in_files(self.folder)
            self._indirect_known = True
        return self._indirect

    def read_all(self) -> None:
        """Read what is read at its first use, so that threads may use it at the same time."""
        _ = self.transport, self.indirect

    def indirect_of(self, n: int, frame: FloatImage) -> FloatImage | None:
        """What other surfaces throw back of projector ``n``'s linear frame, on table and walls, too; None without G."""
        if self.indirect is None:
            return None
        direct = self.transport.forward_part(n, frame)
        room = beside(self.calibration.projectors[n], frame, self.transport.object_mask)
        return self.indirect.forward(direct, room)

    def predicted_light(self, frames: Sequence[FloatImage]) -> FloatImage:
        """What the camera sees of linear frames (rows, columns, 3), one a projector, without the black image."""
        direct = self.transport.forward(frames)
        return direct if self.indirect is None else direct + self.indirect.forward(direct)

    @property
    def base(self) -> Base:
        """The solved base image, as the step of that kind wrote it."""
        if self._base is None:
            solved = SolvedBase.read(self.base_folder, self.projectors)
            base = prepare_base(self.transport, solved.image, self.calibration.black, solved.solution)
            self._base = base.in_files(self.folder)
        return self._base

    @property
    def drive(self) -> DriveLevels:
        if self._drive is None:
            self._drive = DriveLevels(self.transport, self.folder)
        return self._drive

    @property
    def light(self) -> StageLight:
        """All that is known of the stage's light."""
        return StageLight(self.transport, self.calibration.black, self.indirect, self.drive)

    @property
    def reflectance(self) -> FloatImage:
        """The object's own pattern (rows, columns, 3), NaN where it is not known."""
        if self._reflectance is None:
            geometry = known_geometry(self.folder, self.projectors)
            self._reflectance = own_reflectance(self.calibration, geometry)
        return self._reflectance

    def keep_base(self, base: Base) -> None:
        self._base = base.in_files(self.folder)
