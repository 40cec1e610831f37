"""The object and the room's flat surfaces as one scene for rays."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final, Protocol

import numpy as np
import numpy.typing as npt

from hal.errors import DeviceError
from plugins.emulated.optics.objects import StageObject
from plugins.emulated.optics.shapes import Floats, Rgb
from plugins.emulated.optics.truth import SurfaceTruth

LEAST_M2: Final = 1e-8


class Scene(Protocol):
    """What rays need: triangles, their corner normals, and the albedo where they are hit."""

    @property
    def vertices(self) -> npt.NDArray[np.float32]: ...
    @property
    def faces(self) -> npt.NDArray[np.int32]: ...
    @property
    def normals(self) -> npt.NDArray[np.float32]: ...
    @property
    def object_faces(self) -> int:
        """The first so many faces are the object's; each surface has two after them."""

    def albedo(self, points: Floats, faces: npt.NDArray[np.int32], weights: npt.NDArray[np.float32]) -> Rgb: ...
    def fingerprint(self) -> list[npt.NDArray[Any]]: ...


@dataclass(frozen=True, slots=True)
class Furnished:
    """An object among surfaces."""

    thing: StageObject
    vertices: npt.NDArray[np.float32]
    faces: npt.NDArray[np.int32]
    normals: npt.NDArray[np.float32]
    colours: npt.NDArray[np.float32]

    @property
    def object_faces(self) -> int:
        return len(self.thing.faces)

    def albedo(self, points: Floats, faces: npt.NDArray[np.int32], weights: npt.NDArray[np.float32]) -> Rgb:
        """As ``StageObject.albedo``."""
        on_object = faces < self.object_faces
        found = np.empty((len(points), 3), dtype=np.float32)
        found[on_object] = self.thing.albedo(points[on_object], faces[on_object], weights[on_object])
        found[~on_object] = self.colours[(faces[~on_object] - self.object_faces) // 2]
        return found

    def fingerprint(self) -> list[npt.NDArray[Any]]:
        """Arrays that differ where the scene does."""
        return [*self.thing.fingerprint(), self.vertices[len(self.thing.vertices) :], self.colours]


def furnished(thing: StageObject, surfaces: tuple[SurfaceTruth, ...]) -> Scene:
    """The scene of an object; the object itself where there is no surface.

    Raises DeviceError ``surface-no-area``.
    """
    if not surfaces:
        return thing
    corners = np.array([_corners(surface) for surface in surfaces])
    first = len(thing.vertices) + 4 * np.arange(len(surfaces))[:, None, None]
    faces = (first + np.array([[0, 1, 2], [0, 2, 3]])).reshape(-1, 3)
    flat = np.cross(corners[:, 1] - corners[:, 0], corners[:, 3] - corners[:, 0])
    area = np.linalg.norm(flat, axis=1, keepdims=True)
    if area.min() < LEAST_M2:
        raise DeviceError(
            "surface-no-area",
            what=f"The surface {surfaces[int(area.argmin())].name!r} in bench.toml has no area.",
            remedy="Give across_m and along_m a length, in different directions.",
        )
    flat /= area
    normals = np.broadcast_to(flat[:, None, None, :], (len(surfaces), 2, 3, 3)).reshape(-1, 3, 3)
    return Furnished(
        thing=thing,
        vertices=np.concatenate([thing.vertices, corners.reshape(-1, 3).astype(np.float32)]),
        faces=np.concatenate([thing.faces, faces.astype(np.int32)]),
        normals=np.concatenate([thing.normals, normals.astype(np.float32)]),
        colours=np.array([surface.albedo for surface in surfaces], dtype=np.float32),
    )


def _corners(surface: SurfaceTruth) -> Floats:
    corner, across, along = (np.asarray(part) for part in (surface.corner_m, surface.across_m, surface.along_m))
    return np.stack((corner, corner + across, corner + across + along, corner + along))
