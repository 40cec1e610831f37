"""What can be exported of a calibrated stage."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from controller.core.arrays import ByteImage, Float64, FloatImage
from controller.optics.calibrate.mesh import Mesh, grid_mesh
from controller.optics.calibrate.metapixels.from_dots import project
from controller.optics.calibrate.values import Geometry, Metapixels, Pinhole
from controller.optics.transport import LightTransport
from controller.optics.transport.planes import CameraBox


@dataclass(frozen=True)
class Content:
    """One calibrated stage; the large parts are made when a format asks for them.

    ``folder`` of the run
    ``shape``: poses, and points in the camera's frame, metres; None for formats that need none
    ``names`` of the projectors, in the geometry's order
    ``step``: every n-th camera pixel becomes a point or a vertex
    ``picture`` (camera rows, columns, 3) uint8 sRGB: the object in white light; None if it is unknown
    ``seen_px``: for each projector (camera rows, columns, 2) float32, measured x and y in its picture, NaN where
    unknown; None if the run has none
    ``metapixels``, ``transport``: functions that read them
    ``black`` (camera rows, columns, 3) float32: a function that reads the light with all projectors at black
    ``crop``: the camera pixels of a transport; None: all
    """

    folder: Path
    shape: Geometry | None
    names: tuple[str, ...]
    step: int
    picture: ByteImage | None
    seen_px: tuple[FloatImage | None, ...]
    metapixels: Callable[[], tuple[Metapixels, ...]]
    transport: Callable[[], LightTransport]
    black: Callable[[], FloatImage]
    crop: CameraBox | None = None

    @property
    def geometry(self) -> Geometry:
        assert self.shape is not None, "the format says that it needs no shape"
        return self.shape

    @cached_property
    def sizes_px(self) -> tuple[tuple[int, int], ...]:
        """(width, height) of each projector's picture."""
        return tuple((own.valid.shape[1], own.valid.shape[0]) for own in self.metapixels())

    @cached_property
    def camera_px(self) -> tuple[int, int]:
        """(width, height) of the camera's picture."""
        rows, columns = self.black().shape[:2]
        return columns, rows

    @cached_property
    def mesh(self) -> Mesh:
        return grid_mesh(self.geometry, step=self.step)

    @cached_property
    def colours(self) -> ByteImage | None:
        """(vertices, 3) uint8: the picture at each vertex of the mesh."""
        if self.picture is None:
            return None
        x, y = self.mesh.camera_px.astype(np.int64).T
        return np.asarray(self.picture[y, x])

    @property
    def views(self) -> tuple[tuple[str, Pinhole], ...]:
        """The camera and all projectors, by name."""
        projectors = zip(self.names, self.geometry.projectors, strict=True)
        return (("camera", self.geometry.camera), *((f"projector {name}", own) for name, own in projectors))

    def measured_px(self, view: int) -> Float64:
        """(vertices, 2) float64: where view 0 (the camera) or view n (projector n) sees each vertex; NaN if unknown."""
        if view == 0:
            return self.mesh.camera_px.astype(np.float64)
        seen = self.seen_px[view - 1]
        if seen is None:
            return np.full((len(self.mesh.vertices_m), 2), np.nan)
        x, y = self.mesh.camera_px.astype(np.int64).T
        return np.asarray(seen[y, x], np.float64)


def projected(pinhole: Pinhole, points_m: FloatImage) -> Float64:
    """(points, 2) float64: places of (points, 3) in the picture of a camera or projector; (0, 0) the first pixel."""
    px, _ = project(pinhole, points_m.astype(np.float64))
    return px
