"""The object on the stage, and the room's flat surfaces: triangles for the rays, and the albedo where a ray hits."""

from __future__ import annotations

import functools
import io
import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Protocol

import cv2
import numpy as np
import numpy.typing as npt

from hal.errors import DeviceError
from hal.runtime.compute import digest_of
from hal.runtime.files import require_regular
from hal.runtime.mesh_file import MeshUnreadable, read_mesh
from plugins.emulated.core.truth import SurfaceTruth
from plugins.emulated.optics.light_cache import read_arrays, users_folder, write_arrays
from plugins.emulated.optics.shapes import Floats, Rgb, bust, dot, length, paint_bust, paint_solid, paint_vase, vase

KIND: Final = "object"
VASE_AND_BUST: Final = "vase-and-bust"
HEIGHT_M: Final = 0.30
WIDTH_M: Final = 0.36
SHARPEST_CREASE: Final = 0.6
"""Cosine; where a face leans farther than this from its corner's mean normal, it is shaded flat."""
DARKEST, BRIGHTEST = 0.05, 0.85
SMALLEST, LARGEST = 1e-9, 1e9
"""Of a mesh, in whatever unit its file has."""


@dataclass(frozen=True, slots=True)
class StageObject:
    """Triangles in the world's frame, in metres, with what is needed to look up their colour.

    ``vertices`` (V, 3) float32; ``faces`` (F, 3) int32; ``normals`` (F, 3, 3) float32: unit, one a face's corner;
    ``paint``: ``vase-and-bust``, ``solid``, ``corners`` (colours at the corners) or ``texture``;
    ``corner_values``: (F, 3, 3) linear RGB for ``corners``, (F, 3, 2) texture coordinates for ``texture``, else empty;
    ``texture``: (rows, columns, 3) linear RGB for ``texture``, else empty; ``parts``: first face of each part that has
    a paint, or with ``texture`` projectors, of its own
    """

    vertices: npt.NDArray[np.float32]
    faces: npt.NDArray[np.int32]
    normals: npt.NDArray[np.float32]
    paint: str
    corner_values: npt.NDArray[np.float32]
    texture: npt.NDArray[np.float32]
    parts: npt.NDArray[np.int32]

    @property
    def object_faces(self) -> int:
        """All of them (``scene_of.Scene``)."""
        return len(self.faces)

    def fingerprint(self) -> list[npt.NDArray[Any]]:
        """Arrays that differ where the object does."""
        paint = np.frombuffer(self.paint.encode(), dtype=np.uint8)
        names = ("vertices", "faces", "normals", "corner_values", "texture", "parts")
        return [paint, *(getattr(self, name) for name in names)]

    def albedo(self, points: Floats, faces: npt.NDArray[np.int32], weights: npt.NDArray[np.float32]) -> Rgb:
        """Linear RGB (N, 3) float32 at points (N, 3) on ``faces`` (N,), with corner weights (N, 3) that sum to 1."""
        if self.paint == "vase-and-bust":
            local = points * (1.0, -1.0, -1.0) + (0.0, 0.5 * HEIGHT_M, 0.0)
            on_vase = faces < self.parts[1]
            colours = np.empty((len(points), 3), dtype=np.float32)
            colours[on_vase] = paint_vase(local[on_vase])
            colours[~on_vase] = paint_bust(local[~on_vase])
            return colours
        if self.paint == "solid":
            return paint_solid(points)
        at = np.einsum("nk,nkc->nc", weights, self.corner_values[faces])
        if self.paint == "texture":
            rows, columns = self.texture.shape[:2]
            x = (at[:, 0] % 1.0) * columns - 0.5
            y = (1.0 - at[:, 1] % 1.0) * rows - 0.5
            at = _sampled(self.texture, x, y)
        return np.asarray(np.clip(at, DARKEST, BRIGHTEST), dtype=np.float32)

    def save(self, path: Path) -> None:
        """Write as a NumPy archive, in one step."""
        data = io.BytesIO()
        np.savez(data, **{name: np.asarray(getattr(self, name)) for name in self.__slots__})  # type: ignore[arg-type]
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary = path.with_name(path.name + ".part")
        temporary.write_bytes(data.getvalue())
        temporary.replace(path)

    @classmethod
    def read(cls, path: Path) -> StageObject:
        """Read what ``save`` wrote. Raises DeviceError ``object-unreadable``."""
        try:
            require_regular(path)
            with np.load(path, allow_pickle=False) as archive:
                values = {name: archive[name] for name in cls.__slots__}
        # A damaged archive may be taken for any of numpy's formats, each of which has errors of its own.
        except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile, zlib.error) as error:
            raise _unreadable(path, getattr(error, "strerror", None) or str(error)) from error
        return cls(**(values | {"paint": str(values["paint"])}))


@functools.cache
def default_object() -> StageObject:
    """The vase and the bust side by side as one mesh.

    Shaping them takes seconds, so they are kept in the user's cache folder until their source changes.
    """
    folder, key = users_folder(), digest_of(Path(__file__))
    arrays = None if folder is None else read_arrays(folder, KIND, key)
    if arrays is not None and {*arrays, "paint"} == set(StageObject.__slots__):
        return StageObject(paint=VASE_AND_BUST, **arrays)
    made = _vase_and_bust()
    if folder is not None:
        names = set(StageObject.__slots__) - {"paint"}
        write_arrays(folder, KIND, key, {name: getattr(made, name) for name in names})
    return made


def _vase_and_bust() -> StageObject:
    (vase_points, vase_faces), (bust_points, bust_faces) = vase(), bust()
    points = np.concatenate([vase_points, bust_points])
    faces = np.concatenate([vase_faces, bust_faces + len(vase_points)]).astype(np.int32)
    world = (points - (0.0, 0.5 * HEIGHT_M, 0.0)) * (1.0, -1.0, -1.0)
    return assembled(world, faces, VASE_AND_BUST, parts=np.array([0, len(vase_faces)], dtype=np.int32))


def load_object(path: Path) -> StageObject:
    """Read a mesh (.obj, .ply and whatever trimesh reads), upright along +y and facing +z, and fit it to the stage.

    Its texture or vertex colours (taken as sRGB) become its albedo; without either it is painted procedurally.
    Raises DeviceError ``object-unreadable``, ``object-no-faces`` or ``object-no-size``.
    """
    try:
        mesh = read_mesh(path)
    except MeshUnreadable as error:
        raise _unreadable(path, str(error)) from error
    vertices, faces = mesh.vertices, mesh.faces
    if len(faces) == 0:
        raise DeviceError(
            "object-no-faces",
            what=f"{path} contains no faces, so there is no surface to light.",
            remedy="Export the object as a triangle mesh (.obj or .ply), not as a point cloud.",
        )
    vertices = _fitted(_with_size(path, vertices, faces), faces)
    if mesh.texture is not None:
        return assembled(vertices, faces, "texture", corner_values=mesh.uv, texture=_linear(mesh.texture))
    if mesh.colours is not None:
        light = mesh.colours if mesh.linear else _linear(np.rint(255 * mesh.colours).astype(np.uint8))
        return assembled(vertices, faces, "corners", corner_values=light)
    return assembled(vertices, faces, "solid")


def _with_size(path: Path, vertices: Floats, faces: npt.NDArray[np.int32]) -> Floats:
    """The vertices, if their faces have an area, and one that numbers of 32 bits can tell from nothing."""
    corners = vertices[faces]
    with np.errstate(over="ignore", invalid="ignore"):
        size = np.ptp(corners.reshape(-1, 3), axis=0).max()
        area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum()
    if not (np.isfinite(area) and SMALLEST < size < LARGEST and area > 1e-9 * size**2):
        raise DeviceError(
            "object-no-size",
            what=f"The faces of {path} have no area, or are too small or too large to calculate with.",
            remedy="Export the object as a surface, in metres, centimetres or millimetres.",
        )
    return vertices


def _fitted(vertices: Floats, faces: npt.NDArray[np.int32]) -> Floats:
    """Scaled to the stage's room and centred; y up becomes y down."""
    used = vertices[np.unique(faces)]
    low, high = used.min(axis=0), used.max(axis=0)
    extent = np.maximum(high - low, 1e-12)
    scale = min(HEIGHT_M / extent[1], WIDTH_M / extent[0], HEIGHT_M / extent[2])
    return np.asarray((vertices - 0.5 * (low + high)) * scale * (1.0, -1.0, -1.0))


def assembled(
    vertices: Floats,
    faces: npt.NDArray[np.int32],
    paint: str,
    *,
    corner_values: npt.NDArray[np.float32] | None = None,
    texture: npt.NDArray[np.float32] | None = None,
    parts: npt.NDArray[np.int32] | None = None,
) -> StageObject:
    """The object of these arrays (see ``StageObject``), with its normals."""
    empty = np.zeros(0, dtype=np.float32)
    return StageObject(
        vertices=vertices.astype(np.float32),
        faces=faces,
        normals=corner_normals(vertices, faces),
        paint=paint,
        corner_values=empty if corner_values is None else corner_values,
        texture=empty if texture is None else texture,
        parts=np.zeros(1, dtype=np.int32) if parts is None else parts,
    )


def corner_normals(vertices: Floats, faces: npt.NDArray[np.int32]) -> npt.NDArray[np.float32]:
    """Unit normals (F, 3, 3): the mean of the faces that meet at a point by their angles, or flat at sharp creases."""
    corners = vertices[faces]
    flat = _unit(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))
    # Files split vertices along texture seams; the surface is smooth there all the same.
    _, place = np.unique(np.round(vertices, 7), axis=0, return_inverse=True)
    place = place.reshape(-1)
    total = np.zeros((int(place.max()) + 1, 3))
    for corner in range(3):
        sides = [_unit(corners[:, (corner + step) % 3] - corners[:, corner]) for step in (1, 2)]
        angle = np.arccos(np.clip(dot(*sides), -1.0, 1.0))
        for axis in range(3):
            total[:, axis] += np.bincount(place[faces[:, corner]], weights=angle * flat[:, axis], minlength=len(total))
    smooth = _unit(total)[place][faces]
    creased = np.einsum("fkc,fc->fk", smooth, flat) < SHARPEST_CREASE
    return np.where(creased[..., None], flat[:, None], smooth).astype(np.float32)


def _unit(vectors: Floats) -> Floats:
    return np.asarray(vectors / np.maximum(length(vectors), 1e-30)[..., None])


def _linear(srgb: npt.NDArray[np.uint8]) -> npt.NDArray[np.float32]:
    """sRGB bytes to linear light in 0..1 (IEC 61966-2-1)."""
    value = np.arange(256) / 255.0
    table = np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4).astype(np.float32)
    return np.asarray(table[srgb])


def srgb_bytes(light: npt.NDArray[np.float32]) -> npt.NDArray[np.uint8]:
    """The inverse of ``_linear``, rounded."""
    value = np.where(light <= 0.0031308, 12.92 * light, 1.055 * np.maximum(light, 1e-9) ** (1 / 2.4) - 0.055)
    return np.rint(255.0 * np.clip(value, 0.0, 1.0)).astype(np.uint8)


def _sampled(image: npt.NDArray[np.float32], x: Floats, y: Floats) -> Rgb:
    """Bilinear samples (N, 3); wraps round."""
    chunk = 16384  # cv2.remap takes maps of at most 32767 columns
    out = np.empty((len(x), 3), dtype=np.float32)
    for start in range(0, len(x), chunk):
        part = slice(start, start + chunk)
        maps = x[None, part].astype(np.float32), y[None, part].astype(np.float32)
        out[part] = cv2.remap(image, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)[0]
    return out


def _unreadable(path: Path, why: str) -> DeviceError:
    return DeviceError(
        "object-unreadable",
        what=f"The object {path} can't be read as a mesh ({why}).",
        remedy="Check the file, or export it again as .obj or .ply.",
    )


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
class ObjectInRoom:
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
        colours = np.empty((len(points), 3), dtype=np.float32)
        colours[on_object] = self.thing.albedo(points[on_object], faces[on_object], weights[on_object])
        colours[~on_object] = self.colours[(faces[~on_object] - self.object_faces) // 2]
        return colours

    def fingerprint(self) -> list[npt.NDArray[Any]]:
        """Arrays that differ where the scene does."""
        return [*self.thing.fingerprint(), self.vertices[len(self.thing.vertices) :], self.colours]


def scene_of(thing: StageObject, surfaces: tuple[SurfaceTruth, ...]) -> Scene:
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
    return ObjectInRoom(
        thing=thing,
        vertices=np.concatenate([thing.vertices, corners.reshape(-1, 3).astype(np.float32)]),
        faces=np.concatenate([thing.faces, faces.astype(np.int32)]),
        normals=np.concatenate([thing.normals, normals.astype(np.float32)]),
        colours=np.array([surface.albedo for surface in surfaces], dtype=np.float32),
    )


def _corners(surface: SurfaceTruth) -> Floats:
    corner, across, along = (np.asarray(part) for part in (surface.corner_m, surface.across_m, surface.along_m))
    return np.stack((corner, corner + across, corner + across + along, corner + along))
