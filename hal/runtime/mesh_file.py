"""Reads meshes for the planner and for the emulated bench: what trimesh reads, and what it would read wrong.

Before trimesh: text in any encoding, relative indices, and faces with more than three corners, of OBJ; the names of
material files. Instead of it: faces and colours of PLY.
"""

from __future__ import annotations

import importlib
import io
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from hal.runtime.files import LARGEST_MESH, LARGEST_PICTURE, read_bytes

Floats = npt.NDArray[np.float64]
Faces = npt.NDArray[np.int32]


class MeshUnreadable(Exception):
    """A file that is no mesh or can't be read right; the text completes "It can't be read as a mesh (...)"."""


@dataclass(frozen=True, slots=True)
class MeshFile:
    """A mesh as its file has it, in the file's units; all triangles.

    ``vertices`` (V, 3), finite; ``faces`` (F, 3) indices of vertices, F may be 0; ``colours`` (F, 3, 3) float32 in
    [0, 1] of each face's corners, sRGB or, where ``linear``, light; ``uv`` (F, 3, 2) float32 places in ``texture``
    (rows, columns, 3) uint8 sRGB, (0, 0) its lower left corner. None where the file has none.
    """

    vertices: Floats
    faces: Faces
    colours: npt.NDArray[np.float32] | None = None
    linear: bool = False
    uv: npt.NDArray[np.float32] | None = None
    texture: npt.NDArray[np.uint8] | None = None


def read_mesh(path: Path, *, coloured: bool = True) -> MeshFile:
    """The mesh in a file of any format that trimesh reads. Raises MeshUnreadable.

    ``coloured``: with its colours; a texture that is missing is then an error. Else ``uv`` is given without a texture
    """
    try:
        data = read_bytes(path, LARGEST_MESH)
        suffix = path.suffix.lower().removeprefix(".")
        mesh = _of_ply(data) if suffix == "ply" else None
        mesh = mesh or _by_trimesh(path, suffix, data, coloured)
    except OSError as error:
        raise MeshUnreadable(error.strerror or str(error)) from error
    except MeshUnreadable:
        raise
    # Every format's reader has its own errors, and there are thirty of them: to its user they are one.
    except Exception as error:
        raise MeshUnreadable(f"{type(error).__name__}: {error}") from error
    faces = mesh.faces
    if len(faces) and (not np.isfinite(mesh.vertices).all() or faces.min() < 0 or faces.max() >= len(mesh.vertices)):
        raise MeshUnreadable("its coordinates or face indices are not valid numbers")
    return mesh


def _by_trimesh(path: Path, suffix: str, data: bytes, coloured: bool) -> MeshFile:
    trimesh: Any = importlib.import_module("trimesh")  # its functions carry no types
    files = _Files(path.parent)
    if suffix == "obj":
        data = plain_obj(_text(data)).encode()
    if not coloured:
        return _shape(trimesh.load_scene(io.BytesIO(data), file_type=suffix, resolver=files, process=False))
    scene = trimesh.load(io.BytesIO(data), file_type=suffix, resolver=files, force="mesh", process=False)
    vertices, faces = np.asarray(scene.vertices, np.float64), np.asarray(scene.faces, np.int32).reshape(-1, 3)
    if files.problem:
        raise MeshUnreadable(files.problem)
    visual = scene.visual
    if visual.kind == "texture" and visual.uv is not None:
        image = getattr(visual.material, "image", None) or getattr(visual.material, "baseColorTexture", None)
        if image is not None and min(image.size) > 2:  # trimesh makes up a few grey pixels where there is none
            uv = np.asarray(visual.uv, np.float32)[faces]
            return MeshFile(vertices, faces, uv=uv, texture=np.asarray(image.convert("RGB")))
    elif visual.kind in ("vertex", "face"):
        own = visual.vertex_colors[faces] if visual.kind == "vertex" else np.repeat(visual.face_colors[:, None], 3, 1)
        unit = np.asarray(own[..., :3] / 255, np.float32)
        return MeshFile(vertices, faces, unit, linear=suffix in ("glb", "gltf"))
    return MeshFile(vertices, faces)


def _shape(scene: Any) -> MeshFile:
    """Its parts as one mesh, each with its own places in its texture: trimesh would pack several textures into one."""
    parts = [part for part in scene.dump() if hasattr(part, "faces")]
    first = np.cumsum([0, *(len(part.vertices) for part in parts)])
    vertices = np.concatenate([np.zeros((0, 3)), *(part.vertices for part in parts)])
    faces = np.concatenate([np.zeros((0, 3), int), *(part.faces + at for part, at in zip(parts, first, strict=False))])
    own = [getattr(part.visual, "uv", None) for part in parts]
    if not own or any(uv is None for uv in own):
        return MeshFile(vertices, faces.astype(np.int32))
    uv = np.concatenate([np.asarray(uv, np.float32)[part.faces] for uv, part in zip(own, parts, strict=True)])
    return MeshFile(vertices, faces.astype(np.int32), uv=uv)


def _text(data: bytes) -> str:
    if data[:2] in (b"\xff\xfe", b"\xfe\xff"):
        return data.decode("utf-16").removeprefix("\ufeff")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        return data.decode("latin-1")  # names only: numbers and keywords are ASCII


def plain_obj(text: str) -> str:
    """A Wavefront OBJ file whose faces are triangles with absolute indices, and whose colours are in [0, 1]."""
    if re.search(r"(?m)^[ \t]*f[^\n#]*\s0(?=[/\s]|$)", text):
        raise MeshUnreadable("a face has the corner 0, and OBJ counts from 1")
    counts = {"v": 0, "vt": 0, "vn": 0}
    points: dict[int, list[str]] = {}
    polygons: dict[int, list[str]] = {}
    lines = re.sub(r"\\\r?\n", " ", text).splitlines()
    for at, line in enumerate(lines):
        key, *values = line.split("#", 1)[0].split() or [""]
        if key in (*counts, "f"):
            lines[at] = " ".join([key, *values])
        if key in counts:
            counts[key] += 1
            if key == "v":
                points[at] = values
        elif key in ("f", "fo") and (len(values) > 3 or "-" in line or key == "fo"):
            polygons[at] = [_absolute(corner, counts) for corner in values]
    if polygons:
        places = np.array([values[:3] for values in points.values()], np.float64)
        corners = [[int(corner.split("/")[0]) - 1 for corner in polygon] for polygon in polygons.values()]
        for (at, polygon), own in zip(polygons.items(), triangles(places, corners), strict=True):
            lines[at] = "\n".join("f " + " ".join(polygon[corner] for corner in triple) for triple in own)
    if max((float(value) for values in points.values() for value in values[3:6]), default=0.0) > 1:
        for at, values in points.items():
            lines[at] = " ".join(["v", *values[:3], *(f"{float(value) / 255:.9g}" for value in values[3:6])])
    return "\n".join(lines)


def _absolute(corner: str, counts: Mapping[str, int]) -> str:
    """An OBJ corner, "v/vt/vn", whose negative numbers count backwards from the latest line."""
    numbers = zip(corner.split("/"), counts.values(), strict=False)
    return "/".join(str(count + 1 + int(one)) if one.startswith("-") else one for one, count in numbers)


def triangles(points: Floats, polygons: Sequence[Sequence[int]]) -> list[list[tuple[int, int, int]]]:
    """Each polygon of ``points`` (n, 3) as triangles: places in the polygon, in its own order. Raises IndexError."""
    made: list[list[tuple[int, int, int]]] = [[] for _ in polygons]
    sizes = np.array([len(polygon) for polygon in polygons])
    for size in np.unique(sizes):
        of_size = np.flatnonzero(sizes == size)
        corners = points[np.array([polygons[int(at)] for at in of_size], np.int64)]
        fan = _fan(range(size))
        for at, polygon, is_concave in zip(of_size, corners, _are_concave(corners), strict=True):
            made[at] = _cut(polygon) if is_concave else fan
    return made


def _fan(corners: Sequence[int]) -> list[tuple[int, int, int]]:
    return [(corners[0], corners[n], corners[n + 1]) for n in range(1, len(corners) - 1)]


def _are_concave(polygons: Floats) -> npt.NDArray[np.bool_]:
    """Of polygons (n, corners, 3): whether a corner turns against the others."""
    place = polygons - polygons.mean(axis=1, keepdims=True)
    before, after = np.roll(place, 1, axis=1), np.roll(place, -1, axis=1)
    normal = np.cross(place, after).sum(axis=1, keepdims=True)  # Newell's
    turns = np.sum(np.cross(place - before, after - place) * normal, axis=2)
    return np.asarray((turns < 0).any(axis=1) & (polygons.shape[1] > 3))


def _cut(polygon: Floats) -> list[tuple[int, int, int]]:
    """By cutting off ears: convex corners whose triangle holds no other corner (Meisters 1975)."""
    place = polygon - polygon.mean(axis=0)
    normal = np.cross(place, np.roll(place, -1, axis=0)).sum(axis=0)
    axis = int(np.abs(normal).argmax())
    flat = np.delete(place, axis, axis=1)
    sign = np.sign(normal[axis]) * (-1.0 if axis == 1 else 1.0)

    def area(a: int, b: int, c: int) -> float:
        (ax, ay), (bx, by), (cx, cy) = flat[a], flat[b], flat[c]
        return float(sign * ((bx - ax) * (cy - ay) - (by - ay) * (cx - ax)))

    left, made = list(range(len(polygon))), []
    while len(left) > 3:
        for at in range(len(left)):
            a, b, c = left[at - 1], left[at], left[(at + 1) % len(left)]
            if area(a, b, c) > 0 and not any(
                min(area(a, b, p), area(b, c, p), area(c, a, p)) >= 0 for p in left if p not in (a, b, c)
            ):
                made.append((a, b, c))
                del left[at]
                break
        else:
            return made + _fan(left)  # it crosses itself
    return [*made, (left[0], left[1], left[2])]


_OPTION: Final = re.compile(r"\s*(-\w+)((?:\s+(?:on|off|[-+]?\d*\.?\d+(?:[eE][-+]?\d+)?|[rgbmlz])(?=\s))*)\s+")


class _Files:
    """The files that a mesh names, for trimesh (``trimesh.resolvers.Resolver``), in the folder of the mesh and below.

    ``problem``: what is wrong with a texture, because trimesh would leave it out without a word.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self.problem = ""

    def get(self, name: str) -> bytes:
        """The content of a file as written in an MTL or glTF file: with options, backslashes, in any case."""
        while option := _OPTION.match(name):
            values = [float(value) for value in option[2].split() if value not in ("on", "off", *"rgbmlz")]
            plain = {"-s": 1.0, "-o": 0.0, "-t": 0.0, "-mm": None}.get(option[1])
            if plain is not None and any(value != plain for value in values):
                self.problem = f"its texture is moved or scaled by {option[0].strip()}: bake this into the texture"
            name = name[option.end() :]
        path = next(self._candidates(name.strip().strip('"').replace("\\", "/")), None)
        if path is None:
            if not name.lower().endswith(".mtl"):  # without materials a mesh has no colours, and may be meant so
                self.problem = f"its texture {name} is missing"
            raise FileNotFoundError(name)
        data = read_bytes(path, LARGEST_PICTURE)
        return _text(data).encode() if path.suffix.lower() == ".mtl" else data

    __getitem__ = get

    def _candidates(self, name: str) -> Iterator[Path]:
        """As named, by its last part alone, and whatever the case of its letters."""
        for part in (name, PurePosixPath(name).name):
            path = self._folder / part
            if path.is_file() and path.resolve().is_relative_to(self._folder.resolve()):
                yield path
            with_case = [one for one in self._folder.glob("**/*" if "/" in part else "*") if one.is_file()]
            yield from (one for one in with_case if one.relative_to(self._folder).as_posix().lower() == part.lower())


_PLACES: Final = (("s", "t"), ("u", "v"), ("texture_u", "texture_v"))
_COLOURS: Final = (("red", "green", "blue"), ("diffuse_red", "diffuse_green", "diffuse_blue"), ("r", "g", "b"))


def _of_ply(data: bytes) -> MeshFile | None:
    """A PLY file without a texture: its polygons, and its colours of any type; None for one with a texture."""
    ply: Any = importlib.import_module("trimesh.exchange.ply")
    data = data.removeprefix(b"\xef\xbb\xbf")
    head, end, body = data.partition(b"end_header")
    if b"element tristrips" in head:
        raise MeshUnreadable("its faces are triangle strips: export triangles")
    if b"TextureFile" in head:
        return None
    read = ply.load_ply(io.BytesIO(head.decode("ascii", "replace").encode("ascii", "replace") + end + body))
    elements = read["metadata"]["_ply_raw"]
    vertex, face = elements.get("vertex"), elements.get("face")
    vertices = np.asarray(read.get("vertices", np.zeros((0, 3))), np.float64)
    if not face or not face["length"]:
        return MeshFile(vertices, np.zeros((0, 3), np.int32))
    name = next((name for name in ("vertex_indices", "vertex_index") if name in face["properties"]), None)
    lists = _column(face, name or next(iter(face["properties"])))
    if len(lists) < face["length"]:
        raise MeshUnreadable("its end is missing")
    faces, source = _triangulated(vertices, [np.asarray(one, np.int64) for one in lists])
    places = next((names for names in _PLACES if set(names) <= set(vertex["properties"])), ())
    columns = [np.asarray(_column(vertex, name), np.float32).reshape(-1) for name in places]
    uv = np.stack(columns, axis=1)[faces] if columns else None
    for element, index in ((vertex, faces), (face, source[:, None].repeat(3, 1))):
        for names in _COLOURS:
            if set(names) <= set(element["properties"]):
                return MeshFile(vertices, faces, _unit(element, names)[index], uv=uv)
    return MeshFile(vertices, faces, uv=uv)


def _column(element: Mapping[str, Any], name: str) -> Any:
    column = element["data"][name]
    names = getattr(getattr(column, "dtype", None), "names", None)
    return column if names is None else column["f1"]


def _unit(element: Mapping[str, Any], names: Sequence[str]) -> npt.NDArray[np.float32]:
    """(n, 3) in [0, 1]: of whole numbers by their type, of floats by 1 or, where one is above 1, by 255."""
    kind = np.dtype(element["properties"][names[0]])
    values = np.stack([np.asarray(_column(element, name), np.float64).reshape(-1) for name in names], axis=1)
    full = np.iinfo(kind).max if kind.kind in "iu" else 1.0 if values.max(initial=0) <= 1 else 255.0
    return np.asarray(np.clip(values / full, 0, 1), np.float32)


def _triangulated(vertices: Floats, polygons: Sequence[npt.NDArray[np.int64]]) -> tuple[Faces, npt.NDArray[np.int64]]:
    """(F, 3) triangles of polygons of vertices, and the polygon that each is of. Raises IndexError."""
    if all(len(polygon) == 3 for polygon in polygons):
        return np.stack(polygons).astype(np.int32), np.arange(len(polygons))
    own = triangles(vertices, [polygon.tolist() for polygon in polygons])
    source = np.repeat(np.arange(len(polygons)), [len(one) for one in own])
    made = [polygon[list(triple)] for polygon, triples in zip(polygons, own, strict=True) for triple in triples]
    return np.array(made, np.int32).reshape(-1, 3), source
