"""What can be exported of a calibrated stage."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from controller.core.arrays import ByteImage, Float64, FloatImage
from controller.optics.calibrate.mesh import Mesh, grid_mesh, seen_at
from controller.optics.calibrate.mesh_alignment import Pose
from controller.optics.calibrate.metapixels.from_dots import project
from controller.optics.calibrate.values import Geometry, Metapixels, Pinhole
from controller.optics.solve.targets.sheets import Places
from controller.optics.transport import LightTransport
from controller.optics.transport.planes import CameraBox
from controller.optics.transport.views import Sheet
from controller.stage.artefacts.mesh import RegisteredMesh


@dataclass(frozen=True, slots=True)
class OtherView:
    """A view that is not the first; ``pose`` from the first camera's frame to its own, in which ``shape`` is.

    ``picture``, ``seen_px``: as of ``Content``
    """

    name: str
    shape: Geometry
    pose: Pose
    picture: ByteImage | None
    seen_px: tuple[FloatImage | None, ...]

    @property
    def camera(self) -> Pinhole:
        """In the first camera's frame."""
        return replace(self.shape.camera, rotation=self.pose.rotation, translation_m=self.pose.shift_m)


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
    ``others``: the views that were joined with the first one, to which all above belongs
    ``places``: of the transport's pixels on a mesh's sheet; None for the first view alone
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
    others: tuple[OtherView, ...] = ()
    places: Callable[[RegisteredMesh], Places] | None = None

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
    def sheet(self) -> Sheet:
        """Where the pictures of all views lie below each other; of one view it is its picture."""
        width, height = self.geometry.camera.size_px
        sizes = [one.shape.camera.size_px for one in self.others]
        return Sheet(((height, width), *((rows, columns) for columns, rows in sizes)))

    @cached_property
    def all_pictures(self) -> ByteImage | None:
        """The pictures of all views, as ``sheet`` says; None if one is unknown."""
        pictures = [self.picture, *(one.picture for one in self.others)]
        if not self.others or any(one is None for one in pictures):
            return self.picture if not self.others else None
        return np.asarray(self.sheet.joined([one for one in pictures if one is not None]), np.uint8)

    @property
    def pictures_px(self) -> tuple[int, int]:
        """(width, height) of ``all_pictures``."""
        rows, columns = self.sheet.shape
        return (columns, rows) if self.others else self.geometry.camera.size_px

    @cached_property
    def mesh(self) -> Mesh:
        """All views' surfaces in the first camera's frame; ``camera_px`` in ``all_pictures``.

        Of what several views see, the first one's triangles stay.
        """
        meshes = [grid_mesh(self.geometry, step=self.step)]
        for n, (one, box) in enumerate(zip(self.others, self.sheet.boxes()[1:], strict=True)):
            own = grid_mesh(one.shape, step=self.step)
            vertices = (own.vertices_m - one.pose.shift_m.astype(np.float32)) @ one.pose.rotation.astype(np.float32)
            before = [(self.geometry.camera, self.geometry.points_m)]
            before += [(other.camera, other.shape.points_m) for other in self.others[:n]]
            new = ~np.any([seen_at(camera, points, vertices)[1] for camera, points in before], axis=0)
            triangles = own.triangles[new[own.triangles].any(axis=1)]
            used, renumbered = np.unique(triangles, return_inverse=True)
            normals = own.normals[used] @ one.pose.rotation.astype(np.float32)
            camera_px = own.camera_px[used] + np.array([box.left, box.top], np.float32)
            meshes.append(Mesh(vertices[used], normals, renumbered.reshape(-1, 3).astype(np.int32), camera_px))
        starts = np.cumsum([0, *(len(one.vertices_m) for one in meshes)])
        return Mesh(
            np.concatenate([one.vertices_m for one in meshes]),
            np.concatenate([one.normals for one in meshes]),
            np.concatenate([one.triangles + np.int32(start) for one, start in zip(meshes, starts, strict=False)]),
            np.concatenate([one.camera_px for one in meshes]),
        )

    @cached_property
    def colours(self) -> ByteImage | None:
        """(vertices, 3) uint8: the picture at each vertex of the mesh."""
        if self.all_pictures is None:
            return None
        x, y = self.mesh.camera_px.astype(np.int64).T
        return np.asarray(self.all_pictures[y, x])

    @property
    def cameras(self) -> tuple[tuple[str, Pinhole], ...]:
        """The camera of each view by name, the first one first."""
        return (("camera", self.geometry.camera), *((f"camera {one.name}", one.camera) for one in self.others))

    @property
    def views(self) -> tuple[tuple[str, Pinhole], ...]:
        """The cameras and all projectors, by name."""
        projectors = zip(self.names, self.geometry.projectors, strict=True)
        return (*self.cameras, *((f"projector {name}", own) for name, own in projectors))

    def measured_px(self, view: int) -> Float64:
        """(vertices, 2) float64: where each vertex is seen by a camera or projector, by number in ``views``; NaN if
        unknown."""
        place = self.mesh.camera_px.astype(np.float64)
        found = np.full(place.shape, np.nan)
        projector = view - len(self.cameras)
        for n, box in enumerate(self.sheet.boxes() if self.others else [CameraBox(0, 0, *self.sheet.sizes[0])]):
            mine = (place[:, 1] >= box.top) & (place[:, 1] < box.bottom)
            own = place[mine] - (box.left, box.top)
            if projector < 0:
                if n == view:
                    found[mine] = own
                continue
            seen = (self.seen_px if n == 0 else self.others[n - 1].seen_px)[projector]
            if seen is not None:
                x, y = own.astype(np.int64).T
                found[mine] = seen[y, x]
        return found


def projected(pinhole: Pinhole, points_m: FloatImage) -> Float64:
    """(points, 2) float64: places of (points, 3) in the picture of a camera or projector; (0, 0) the first pixel."""
    px, _ = project(pinhole, points_m.astype(np.float64))
    return px
