"""Views and points in the formats of COLMAP and of OpenCV.

A sparse model of COLMAP has cameras, images and points3D, as text or binary files. Its camera model OPENCV has our
lens; its first pixel's centre is (0.5, 0.5). Projectors are images like any other.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import cv2
import numpy as np
import numpy.typing as npt

from controller.core.arrays import Float64
from controller.core.storage import write_atomically
from controller.optics.calibrate.values import Pinhole
from controller.stage.exchange.content import Content, projected

OPENCV: Final = 4
"""The number of the camera model fx, fy, cx, cy, k1, k2, p1, p2."""
HALF: Final = 0.5
"""COLMAP's pixels lie this far from ours."""
GREY: Final = 128


@dataclass(frozen=True, slots=True)
class _View:
    """A camera with its one image; ``px`` (observations, 2), ``points`` (observations,) the vertices they belong to."""

    name: str
    pinhole: Pinhole
    px: Float64
    points: npt.NDArray[np.int64]

    @property
    def parameters(self) -> list[float]:
        matrix, lens = self.pinhole.matrix, self.pinhole.distortion
        middle = matrix[:2, 2] + HALF
        return [float(one) for one in (matrix[0, 0], matrix[1, 1], *middle, *lens)]

    @property
    def pose(self) -> list[float]:
        """Quaternion w, x, y, z, and translation, from the world to the view."""
        from scipy.spatial.transform import Rotation

        x, y, z, w = Rotation.from_matrix(self.pinhole.rotation).as_quat()
        return [float(one) for one in (w, x, y, z, *self.pinhole.translation_m)]


@dataclass(frozen=True, slots=True)
class _Model:
    """``tracks``: for each point, rows (image number from 1, observation number from 0)."""

    views: list[_View]
    points: Float64
    colours: npt.NDArray[np.uint8]
    errors: Float64
    tracks: list[list[tuple[int, int]]]


def write_text(content: Content, folder: Path) -> dict[str, int]:
    """Write cameras.txt, images.txt and points3D.txt. Raises WorkError("no-space", "cannot-write")."""
    model = _model(content)
    cameras = [
        f"{n} OPENCV {view.pinhole.size_px[0]} {view.pinhole.size_px[1]} {_numbers(view.parameters)}"
        for n, view in enumerate(model.views, 1)
    ]
    images = []
    for n, view in enumerate(model.views, 1):
        images.append(f"{n} {_numbers(view.pose)} {n} {view.name}")
        images.append(" ".join(f"{x:.17g} {y:.17g} {p + 1}" for (x, y), p in zip(view.px, view.points, strict=True)))
    points = [
        f"{n} {_numbers(xyz)} {r} {g} {b} {error:.9g} " + " ".join(f"{image} {at}" for image, at in track)
        for n, (xyz, (r, g, b), error, track) in enumerate(
            zip(model.points.tolist(), model.colours.tolist(), model.errors.tolist(), model.tracks, strict=True), 1
        )
    ]
    for name, lines in (("cameras", cameras), ("images", images), ("points3D", points)):
        write_atomically(folder / f"{name}.txt", ("\n".join(lines) + "\n").encode())
    return _figures(model)


def write_binary(content: Content, folder: Path) -> dict[str, int]:
    """Write cameras.bin, images.bin and points3D.bin. Raises WorkError("no-space", "cannot-write")."""
    model = _model(content)
    cameras = [struct.pack("<Q", len(model.views))]
    images = [struct.pack("<Q", len(model.views))]
    for n, view in enumerate(model.views, 1):
        cameras.append(struct.pack("<iiQQ8d", n, OPENCV, *view.pinhole.size_px, *view.parameters))
        images.append(struct.pack("<i7di", n, *view.pose, n) + view.name.encode() + b"\0")
        seen = np.empty(len(view.px), np.dtype([("px", "<f8", 2), ("point", "<i8")]))
        seen["px"], seen["point"] = view.px, view.points + 1
        images.append(struct.pack("<Q", len(seen)) + seen.tobytes())
    points = [struct.pack("<Q", len(model.points))]
    for n, (xyz, colour, error, track) in enumerate(
        zip(model.points.tolist(), model.colours.tolist(), model.errors.tolist(), model.tracks, strict=True), 1
    ):
        flat = [one for pair in track for one in pair]
        points.append(struct.pack(f"<Q3d3BdQ{len(flat)}i", n, *xyz, *colour, error, len(track), *flat))
    for name, parts in (("cameras", cameras), ("images", images), ("points3D", points)):
        write_atomically(folder / f"{name}.bin", b"".join(parts))
    return _figures(model)


def _model(content: Content) -> _Model:
    vertices = content.mesh.vertices_m
    tracks: list[list[tuple[int, int]]] = [[] for _ in vertices]
    views, total, count = [], np.zeros(len(vertices)), np.zeros(len(vertices))
    for n, (name, pinhole) in enumerate(content.views):
        measured = content.measured_px(n)
        known = np.flatnonzero(np.isfinite(measured).all(axis=1))
        off = np.linalg.norm(projected(pinhole, vertices[known]) - measured[known], axis=1)
        total[known] += off
        count[known] += 1
        for at, vertex in enumerate(known.tolist()):
            tracks[vertex].append((n + 1, at))
        views.append(_View(_file_name(n, name), pinhole, measured[known] + HALF, known))
    colours = np.full((len(vertices), 3), GREY, np.uint8) if content.colours is None else content.colours
    return _Model(views, vertices.astype(np.float64), colours, total / np.maximum(count, 1), tracks)


def _file_name(number: int, name: str) -> str:
    """COLMAP's text files end a name at the first space; the number keeps the names different."""
    plain = "".join(one if one.isprintable() and not one.isspace() else "-" for one in name)
    return f"{number}-{plain}.png"


def _numbers(values: Sequence[float]) -> str:
    return " ".join(f"{value:.17g}" for value in values)


def _figures(model: _Model) -> dict[str, int]:
    return {"points": len(model.points), "observations": sum(len(view.px) for view in model.views)}


def write_storage(content: Content, path: Path) -> dict[str, int]:
    """Write ``camera``, the lists ``cameras`` of other views and ``projectors``, ``points_m`` and ``camera_px``.

    A camera or projector has ``image_width``, ``image_height``, ``camera_matrix``, ``distortion_coefficients`` (k1, k2,
    p1, p2), ``rvec`` and ``tvec``: the arguments of ``cv2.projectPoints``. ``points_m`` (points, 3) float32, metres, in
    the camera's frame; ``camera_px`` (points, 2) float32, where the first camera sees them, or NaN.

    Raises WorkError("no-space", "cannot-write").
    """
    storage = cv2.FileStorage(".yml", cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    storage.startWriteStruct("camera", cv2.FILE_NODE_MAP)
    _write_view(storage, content.geometry.camera)
    storage.endWriteStruct()
    others = [(one.name, one.camera) for one in content.others]
    projectors = list(zip(content.names, content.geometry.projectors, strict=True))
    for key, listed in (("cameras", others), ("projectors", projectors)):
        storage.startWriteStruct(key, cv2.FILE_NODE_SEQ)
        for name, own in listed:
            storage.startWriteStruct("", cv2.FILE_NODE_MAP)
            storage.write("name", name)
            _write_view(storage, own)
            storage.endWriteStruct()
        storage.endWriteStruct()
    storage.write("points_m", np.ascontiguousarray(content.mesh.vertices_m))
    storage.write("camera_px", np.ascontiguousarray(content.measured_px(0).astype(np.float32)))
    write_atomically(path, storage.releaseAndGetString().encode())
    return {"points": len(content.mesh.vertices_m)}


def _write_view(storage: cv2.FileStorage, own: Pinhole) -> None:
    width, height = own.size_px
    storage.write("image_width", width)
    storage.write("image_height", height)
    storage.write("camera_matrix", own.matrix)
    storage.write("distortion_coefficients", own.distortion[None])
    storage.write("rvec", np.asarray(cv2.Rodrigues(own.rotation)[0]))
    storage.write("tvec", own.translation_m.reshape(3, 1))
