"""Compares a result with its target, and writes files for other programs."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from controller.bundle.describe import png
from controller.core.arrays import as_light, save_arrays
from controller.core.colour import linear_to_srgb
from controller.core.errors import UsageError
from controller.core.storage import write_atomically
from controller.optics.calibrate.mesh import grid_mesh, write_glb, write_ply
from controller.optics.calibrate.values import Geometry
from controller.optics.capture.linear_files import exr_bytes
from controller.optics.capture.raw import SRGB_TO_XYZ
from controller.optics.solve.result import metrics
from controller.optics.solve.result.metrics import Comparison

if TYPE_CHECKING:
    from controller.core.arrays import ByteImage, Float64


def compare(
    achieved: npt.ArrayLike,
    target: npt.ArrayLike,
    mask: npt.ArrayLike | None = None,
    *,
    white: float = 1.0,
    camera_to_xyz: Float64 | None = None,
) -> Comparison:
    """Compare ``achieved`` with ``target``: CIEDE2000, RMSE and sharpness (paper 6, eq. 9).

    Parameters
    ----------
    achieved, target : (rows, columns, 3) linear camera light, finite where ``mask``
    mask : (rows, columns) bool, the pixels to compare; without it all
    white : camera value of a perfect white, above 0; it becomes L* = 100
    camera_to_xyz : (3, 3) linear camera RGB to CIE XYZ (D65); without it that of linear sRGB

    Returns
    -------
    ``Comparison``: ``delta_e00_median``, ``delta_e00_p95``: CIEDE2000; ``rmse``, relative to ``white``;
    ``sharpness_lambda``, 0 to 1: edges in common over the larger number of edges; ``error_map`` (rows, columns) float32
    CIEDE2000, 0 outside the mask

    Errors: ``nothing-to-compare``.
    """
    ours, theirs = as_light(achieved), as_light(target)
    matrix = SRGB_TO_XYZ if camera_to_xyz is None else np.asarray(camera_to_xyz, np.float64)
    where = np.ones(theirs.shape[:2], np.bool_) if mask is None else np.asarray(mask, np.bool_)
    return metrics.compare(ours, theirs, matrix, white, where)


def export(
    path: Path | str,
    content: Mapping[str, npt.ArrayLike] | npt.ArrayLike | Geometry,
    *,
    picture: ByteImage | None = None,
    step: int = 1,
) -> Path:
    """Write a file for other programs; the end of its name gives the kind. It is written whole or not at all.

    ``.npz`` arrays by name; ``.exr`` an image as 32-bit linear light; ``.png`` an image of 8 bits; ``.ply`` and
    ``.glb`` (glTF) the surface of a geometry as a mesh.

    Parameters
    ----------
    path : the file; an existing one is replaced
    content : for ``.npz`` a mapping of arrays; for ``.exr`` (rows, columns, 3) linear light; for ``.png`` the same,
        clipped to 0 to 1 and encoded as sRGB, or uint8, which is written unchanged; for ``.ply`` and ``.glb`` a
        ``Geometry``, in metres
    picture : (camera rows, columns, 3) uint8 sRGB, the colours or the texture of a mesh
    step : every n-th camera pixel becomes a vertex of a mesh

    Returns the path.

    Errors: ``export-kind-unknown``, ``export-content-wrong``, ``mesh-empty``, ``no-space``, ``cannot-write``.
    """
    path = Path(path)
    kind = path.suffix.lower()
    if kind not in (".npz", ".exr", ".png", ".ply", ".glb"):
        raise UsageError(
            "export-kind-unknown",
            what=f"The file type of {path.name} is unknown.",
            remedy="Give a name that ends in .npz, .exr, .png, .ply or .glb.",
        )
    if kind == ".npz" and isinstance(content, Mapping):
        save_arrays(path, {name: np.asarray(array) for name, array in content.items()})
    elif kind in (".ply", ".glb") and isinstance(content, Geometry):
        _write_mesh(path, content, picture, step)
    elif kind in (".exr", ".png") and not isinstance(content, Mapping | Geometry):
        image = _checked(path, np.asarray(content))
        write_atomically(path, _png(image) if kind == ".png" else exr_bytes({"RGB": np.asarray(image)}))
    else:
        raise _wrong(path, type(content).__name__)
    return path


def _write_mesh(path: Path, geometry: Geometry, picture: ByteImage | None, step: int) -> None:
    mesh = grid_mesh(geometry, step=step)
    if path.suffix.lower() == ".glb":
        write_glb(path, mesh, geometry.camera.size_px, picture)
        return
    x, y = mesh.camera_px.astype(np.int64).T
    write_ply(path, mesh, None if picture is None else picture[y, x])


def _checked(path: Path, image: npt.NDArray[Any]) -> npt.NDArray[Any]:
    if image.ndim != 3 or image.shape[2] != 3 or image.dtype.kind not in "fu":
        raise _wrong(path, f"{image.dtype} array of shape {image.shape}")
    return image


def _png(image: npt.NDArray[Any]) -> bytes:
    if image.dtype == np.uint8:
        return png(image)
    return png(np.rint(255 * linear_to_srgb(as_light(np.nan_to_num(image)))).astype(np.uint8))


def _wrong(path: Path, what: str) -> UsageError:
    return UsageError(
        "export-content-wrong",
        what=f"A {what} can't be written to {path.name}.",
        remedy="Give arrays by name for .npz, an image (rows, columns, 3) for .exr and .png, a Geometry for a mesh.",
    )
