"""The calibration of a run with its transport and base image, read when needed."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from controller.core import channels
from controller.core.arrays import FloatImage, Mask, array_in_file
from controller.core.errors import UsageError
from controller.optics.calibrate.mesh import seen_at
from controller.optics.calibrate.photometry.reflectance import own_reflectance
from controller.optics.calibrate.photometry.view_colours import in_common_units, view_gains
from controller.optics.calibrate.values import Calibration, Geometry, ProjectorCalibration
from controller.optics.solve.appearance import Base, StageLight, prepare_base
from controller.optics.solve.bounded.engine import Engine, Processor
from controller.optics.solve.reach.drive_levels import DriveLevels
from controller.optics.solve.result.metrics import colour_difference
from controller.optics.solve.targets.sheets import Places, mesh_places, on_sheet
from controller.optics.solve.targets.values import connected, pieces
from controller.optics.transport import LightTransport, build_transport
from controller.optics.transport.indirect.fit import beside, fit_indirect
from controller.optics.transport.indirect.indirect_light import IndirectLight, ReflectedLight
from controller.optics.transport.views import Sheet, ViewsIndirect, ViewsTransport
from controller.stage.artefacts.calibration import read_calibration
from controller.stage.artefacts.geometry import (
    camera_px,
    known_geometry,
    read_camera,
    read_geometry,
    read_view_pose,
)
from controller.stage.artefacts.mesh import RegisteredMesh
from controller.stage.artefacts.solved import SolvedBase
from controller.stage.artefacts.views import first_view, newest_view, view_folders

_IMAGES: Final = ("points_m", "normals")
"""Of a geometry."""
MATT: Final = 0.03
"""By so much less another view may see a place without highlights: no paint looks quite the same from all sides."""
HIGHLIGHT_PX: Final = 1
"""Projector pixels over which the light of two views is compared for highlights, which are narrow."""
CLEARLY: Final = 3.0
"""CIEDE2000 above which a difference between views is easily seen."""


class View(NamedTuple):
    """A view of a run.

    ``folder`` of its solutions; ``part`` takes its part of a camera image (rows, columns, ...); ``gain`` (3,): as of
    ``view_gains``, None for the only view
    """

    folder: Path
    part: Callable[[Any], Any]
    gain: FloatImage | None

    def own_light(self, image: FloatImage) -> FloatImage:
        """Its part of light (rows, columns, 3), in its own units."""
        part: FloatImage = self.part(image)
        return part if self.gain is None else part / self.gain


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
    def names(self) -> tuple[str, ...]:
        """Of its views."""
        return (first_view(self.folder),)

    @property
    def base_folder(self) -> Path:
        """The folder of the base image."""
        return self.folder

    @property
    def camera_px(self) -> tuple[int, int] | None:
        """(width, height) of the camera's picture; None before the geometry is known."""
        return camera_px(self.folder)

    @property
    def lamps(self) -> FloatImage:
        """(views, projectors): by what each projector's light changed, compared with the others', since a view was
        photographed."""
        return np.ones((1, len(self.projectors)), np.float32)

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
    def geometry(self) -> Geometry:
        """Points and poses in the camera's frame. Raises UsageError("shape-unknown")."""
        return read_geometry(self.folder, self.projectors)

    def geometries(self) -> list[Geometry]:
        """Of each view, all in the first camera's frame. Raises as ``geometry``."""
        return [self.geometry]

    def places(self, mesh: RegisteredMesh) -> Places:
        """Where the camera's pixels lie on a mesh's sheet."""
        return mesh.places(read_camera(self.folder))

    def objects(self, mask: Mask) -> list[Mask]:
        """``mask`` (rows, columns) split into objects that stand apart."""
        return pieces(mask)

    def views(self) -> list[View]:
        """The first one first."""
        return [View(self.base_folder, lambda image: image, None)]

    @property
    def folders(self) -> tuple[Path, ...]:
        """Of the views."""
        return (self.folder,)

    def joined(self, images: Sequence[Any]) -> Any:
        """One camera image (rows, columns, ...) of each view's."""
        (image,) = images
        return image

    @property
    def first(self) -> Calibrated:
        """The first view alone."""
        return self

    def each(self) -> list[Calibrated]:
        """The views, each alone, in the units of the first one."""
        return [self]

    def places_in(self, of: int, to: int) -> FloatImage | None:
        """Where the pixels of one view lie in the picture of another one, by the shape: (rows, columns, 2) x, y in px,
        NaN where that one sees something else. ``of``, ``to``: numbers of views. None where the shape does not tell.
        """
        return None

    @functools.cached_property
    def known_geometry(self) -> Geometry | None:
        """``geometry``; None where it is not known."""
        return known_geometry(self.folder, self.projectors)

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

    @property
    def reflected(self) -> ReflectedLight | None:
        """``indirect`` of all views."""
        return self.indirect

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
        return direct if self.reflected is None else direct + self.reflected.forward(direct)

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
            self._drive = DriveLevels.of_transport(self.transport, self.folder)
        return self._drive

    @property
    def light(self) -> StageLight:
        """All that is known of the stage's light."""
        return StageLight(self.transport, self.calibration.black, self.reflected, self.drive)

    @property
    def matt(self) -> FloatImage | None:
        """(rows, columns, 1): the share of the object's light that is no highlight: another camera sees it, too. None
        for the only view."""
        return None

    @property
    def reflectance(self) -> FloatImage:
        """The object's own pattern (rows, columns, 3), NaN where it is not known."""
        if self._reflectance is None:
            self._reflectance = own_reflectance(self.calibration, self.known_geometry, self.matt)
        return self._reflectance

    def differences(self, image: FloatImage, mask: Mask, white: float) -> FloatImage | None:
        """By how much the views differ in light (rows, columns, 3) known in ``mask``, CIEDE2000; ``white``: its white.

        (rows, columns), NaN where no other view sees the place; None for the only view.
        """
        return None

    def keep_base(self, base: Base) -> None:
        self._base = base.in_files(self.folder)


def share_above(differs: FloatImage) -> float:
    """Where views differ clearly, as a share of what several see; ``differs``: of ``Calibrated.differences``."""
    several = int(np.isfinite(differs).sum())
    return float((differs > CLEARLY).sum()) / several if several else 0.0


def all_views(run: Path, projectors: Sequence[str], engine: Engine | None = None) -> Calibrated:
    """The calibration of a run with all of its whole views; of one view it is that view's own."""
    kind = AllViews if len(view_folders(run)) > 1 else Calibrated
    return kind(run, projectors, engine)


class AllViews(Calibrated):
    """Several views of a run as one: their camera images lie on one sheet, in the units of the first view.

    Those count that are whole at its first use.
    """

    _gains: list[FloatImage] | None = None
    _lamps: FloatImage

    @property
    def lamps(self) -> FloatImage:
        _ = self.gains
        return self._lamps

    @functools.cached_property
    def _views(self) -> list[Calibrated]:
        folders = view_folders(self.folder).values()
        return [Calibrated(folder, self.projectors, self.engine) for folder in folders]

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(view_folders(self.folder))

    @property
    def first(self) -> Calibrated:
        """The first view alone, which is in its own units anyway."""
        return self._views[0]

    def each(self) -> list[Calibrated]:
        _ = self.gains
        return list(self._views)

    def places_in(self, of: int, to: int) -> FloatImage | None:
        if self.known_geometry is None:
            return None
        each, points = self.geometries(), self.sheet.parts(self.known_geometry.points_m)[of]
        px, seen = seen_at(each[to].camera, self._views[to].geometry.points_m, points.reshape(-1, 3))
        return np.asarray(np.where(seen[:, None], px, np.nan).reshape(*points.shape[:2], 2), np.float32)

    @functools.cached_property
    def known_geometry(self) -> Geometry | None:
        try:
            return self.geometry
        except UsageError:
            return None

    @property
    def gains(self) -> list[FloatImage]:
        """As of ``view_gains``; the views' calibrations are in common units from then on."""
        if self._gains is None:
            each = [view.calibration for view in self._views]
            self._gains, self._lamps = view_gains(each, newest_view(self.folder))
            for view, gain, lamps in zip(self._views, self._gains, self._lamps, strict=True):
                view._calibration = in_common_units(view.calibration, gain, lamps, self.folder)
        return self._gains

    @property
    def sheet(self) -> Sheet:
        """Where the views' pictures lie."""
        sizes = (view.calibration.object_mask.shape for view in self._views)
        return Sheet(tuple((rows, columns) for rows, columns in sizes))

    def views(self) -> list[View]:
        parts = [(lambda image, box=box: image[box.window]) for box in self.sheet.boxes()]
        return [View(*one) for one in zip(self.folders, parts, self.gains, strict=True)]

    @property
    def folders(self) -> tuple[Path, ...]:
        return tuple(view_folders(self.folder).values())

    def joined(self, images: Sequence[Any]) -> Any:
        return self.sheet.joined(images)

    @property
    def calibration(self) -> Calibration:
        """As of one camera whose picture is the sheet; where it looks is known to the views alone."""
        if self._calibration is None:
            _ = self.gains
            own = [view.calibration for view in self._views]
            parts = tuple(self._projector([one.projectors[n] for one in own]) for n in range(len(self.projectors)))
            black, mask = (self.sheet.joined([getattr(one, name) for one in own]) for name in ("black", "object_mask"))
            self._calibration = dataclasses.replace(own[0], projectors=parts, black=black, object_mask=mask)
        return self._calibration

    def _projector(self, seen: Sequence[ProjectorCalibration]) -> ProjectorCalibration:
        """One projector by all views; its response is that of the view that sees most of its light."""
        best = max(seen, key=lambda part: int(np.count_nonzero(part.metapixels.valid)))
        white = array_in_file(self.folder, (*self.sheet.shape, 3))
        white[:] = 0
        for part, box in zip(seen, self.sheet.boxes(), strict=True):
            white[box.window] = part.white
        return dataclasses.replace(best, white=white, phase_map=None, indirect=None, stripes=None, spread=None)

    @property
    def transport(self) -> LightTransport:
        if self._transport is None:
            _ = self.gains
            self._transport = ViewsTransport.of([view.transport for view in self._views])
        return self._transport

    @functools.cached_property
    def matt(self) -> FloatImage:
        transport = self.transport
        assert isinstance(transport, ViewsTransport)
        own, others, seen = transport.by_places(transport.reach(), transport.object_mask, HIGHLIGHT_PX)
        share = channels.mean(others) / np.maximum(channels.mean(own), np.finfo(np.float32).tiny)
        return np.where(seen, np.minimum(share / (1 - MATT), 1), 1).astype(np.float32)[..., None]

    def differences(self, image: FloatImage, mask: Mask, white: float) -> FloatImage | None:
        transport = self.transport
        assert isinstance(transport, ViewsTransport)
        own, others, seen = transport.by_places(image, mask)
        difference = colour_difference(own, others, self.calibration.camera_to_xyz, white, seen)
        return np.where(seen, difference, np.float32(np.nan))

    @property
    def reflected(self) -> ReflectedLight | None:
        _ = self.gains
        own = tuple(view.indirect for view in self._views)
        return None if all(one is None for one in own) else ViewsIndirect(own, self.sheet)

    @property
    def base(self) -> Base:
        if self._base is None:
            solved = [SolvedBase.read(view.folder, self.projectors) for view in self._views]
            image = self.sheet.joined([one.image * gain for one, gain in zip(solved, self.gains, strict=True)])
            self.keep_base(prepare_base(self.transport, image, self.calibration.black, solved[0].solution))
        assert self._base is not None
        return self._base

    @property
    def geometry(self) -> Geometry:
        """All views' points on the sheet, in the first camera's frame.

        Raises UsageError("shape-unknown", "views-apart").
        """
        each = self.geometries()
        points_m, normals = (self.sheet.joined([getattr(one, key) for one in each], np.nan) for key in _IMAGES)
        return dataclasses.replace(each[0], points_m=points_m, normals=normals)

    def geometries(self) -> list[Geometry]:
        return [self._in_first_frame(name, view) for name, view in zip(self.names, self._views, strict=True)]

    def _in_first_frame(self, name: str, view: Calibrated) -> Geometry:
        own, pose = view.geometry, read_view_pose(view.folder)
        if pose is None:
            raise UsageError(
                "views-apart",
                what=f"It is not known where the view {name} stands, and this needs the shape from all sides.",
                remedy="Let it see two projectors that another view sees, too, and calibrate again; or use an"
                " appearance that needs no shape.",
            )
        turn = pose.rotation.astype(np.float32)
        return Geometry(
            dataclasses.replace(own.camera, rotation=pose.rotation, translation_m=pose.shift_m),
            self._views[0].geometry.projectors,
            (own.points_m - pose.shift_m.astype(np.float32)) @ turn,
            own.normals @ turn,
            own.reprojection_rms_px,
            own.scale_known,
        )

    def places(self, mesh: RegisteredMesh) -> Places:
        _ = self.geometry  # refuses views that stand apart
        poses = [read_view_pose(view.folder) for view in self._views]
        seen = [
            mesh_places(mesh.solid, mesh.arrays["uv"], mesh.pose.then(pose), read_camera(view.folder))
            for view, pose in zip(self._views, poses, strict=True)
            if pose is not None
        ]
        return on_sheet(seen, [box.top for box in self.sheet.boxes()])

    def objects(self, mask: Mask) -> list[Mask]:
        parts = [(box, piece) for box in self.sheet.boxes() for piece in pieces(mask[box.window])]
        whole = [np.zeros(mask.shape, np.bool_) for _ in parts]
        for one, (box, piece) in zip(whole, parts, strict=True):
            one[box.window] = piece
        return connected(whole, self.geometry.points_m)
