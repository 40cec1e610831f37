"""The stage as one file of OpenCV's FileStorage, which `cv2.FileStorage` reads."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from controller.core.storage import write_atomically
from controller.optics.calibrate.values import Pinhole
from controller.stage.exchange.content import Content


def write_storage(content: Content, path: Path) -> dict[str, int]:
    """Write ``camera``, the list ``projectors``, ``points_m`` and ``camera_px``.

    A camera or projector has ``image_width``, ``image_height``, ``camera_matrix``, ``distortion_coefficients`` (k1, k2,
    p1, p2), ``rvec`` and ``tvec``: the arguments of ``cv2.projectPoints``. ``points_m`` (points, 3) float32, metres, in
    the camera's frame; ``camera_px`` (points, 2) float32, where the camera sees them.

    Raises WorkError("no-space", "cannot-write").
    """
    storage = cv2.FileStorage(".yml", cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    storage.startWriteStruct("camera", cv2.FILE_NODE_MAP)
    _write_view(storage, content.geometry.camera)
    storage.endWriteStruct()
    storage.startWriteStruct("projectors", cv2.FILE_NODE_SEQ)
    for name, own in zip(content.names, content.geometry.projectors, strict=True):
        storage.startWriteStruct("", cv2.FILE_NODE_MAP)
        storage.write("name", name)
        _write_view(storage, own)
        storage.endWriteStruct()
    storage.endWriteStruct()
    storage.write("points_m", np.ascontiguousarray(content.mesh.vertices_m))
    storage.write("camera_px", np.ascontiguousarray(content.mesh.camera_px))
    write_atomically(path, storage.releaseAndGetString().encode())
    return {"points": len(content.mesh.vertices_m)}


def _write_view(storage: cv2.FileStorage, own: Pinhole) -> None:
    width, height = own.size_px
    storage.write("image_width", width)
    storage.write("image_height", height)
    storage.write("camera_matrix", own.matrix)
    storage.write("distortion_coefficients", np.array([[*own.distortion[:2], 0.0, 0.0]]))
    storage.write("rvec", np.asarray(cv2.Rodrigues(own.rotation)[0]))
    storage.write("tvec", own.translation_m.reshape(3, 1))
