"""The shape of a run's object: ``geometry.json``, and ``geometry.npz`` where it is known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from controller.core.arrays import FloatImage, load_arrays, save_arrays
from controller.core.errors import UsageError
from controller.optics.calibrate.geometry.shape import FoundShape, Shape
from controller.optics.calibrate.mesh_alignment import Pose
from controller.optics.calibrate.values import Geometry, Pinhole
from controller.stage.artefacts.kinds import StepKind
from controller.stage.artefacts.mesh import RegisteredMesh
from controller.stage.artefacts.names import json_path, npz_path, read_json, write_json


@dataclass(frozen=True, slots=True)
class ShapeRecord:
    """Which shape a run has: "surface", "plane" or "unknown". ``code`` and ``reason``: why it is no surface, or ""."""

    shape: Shape = "surface"
    code: str = ""
    reason: str = ""
    remedy: str = ""


def read_shape(run: Path) -> ShapeRecord:
    """Of a run with finished geometry; one of an earlier version has a surface."""
    row = read_geometry_figures(run)
    return ShapeRecord(*(row.get(field.name, field.default) for field in fields(ShapeRecord)))


def write_geometry(run: Path, projectors: Sequence[str], shape: FoundShape) -> list[Path]:
    """Points and normals in the camera's frame, metres; poses and their uncertainty (docs/reference/report.md)."""
    why = () if shape.why is None else (shape.why.code, shape.why.what, shape.why.remedy)
    record = asdict(ShapeRecord(shape.shape, *why))
    found = shape.reconstruction
    if found is None:
        npz_path(run, StepKind.GEOMETRY).unlink(missing_ok=True)
        views = {"camera": {"size_px": list(shape.camera_size)}, "projectors": {name: {} for name in projectors}}
        return [write_json(json_path(run, StepKind.GEOMETRY), {**record, **views})]
    geometry = found.geometry
    arrays = npz_path(run, StepKind.GEOMETRY)
    save_arrays(arrays, {"points_m": geometry.points_m, "normals": geometry.normals, "sigma_m": found.sigma_m})
    poses = {
        **record,
        "camera": _pinhole(geometry.camera),
        "projectors": {name: _pinhole(pose) for name, pose in zip(projectors, geometry.projectors, strict=True)},
        "reprojection_rms_px": geometry.reprojection_rms_px,
        "scale_known": geometry.scale_known,
        "noise_px": found.noise_px,
        "shape_rel_sigma": found.shape_rel_sigma,
        "inlier_share": found.inlier_share,
        "scale_rel_sigma": found.scale_rel_sigma if geometry.scale_known else None,
        "parameters": list(found.parameter_names),
        "covariance": found.covariance.tolist(),
    }
    return [arrays, write_json(json_path(run, StepKind.GEOMETRY), poses)]


def has_geometry(run: Path) -> bool:
    """Whether ``read_geometry`` finds a shape; one that is unknown has no arrays."""
    return npz_path(run, StepKind.GEOMETRY).is_file() and json_path(run, StepKind.GEOMETRY).is_file()


def require_shape(run: Path, what: str) -> None:
    """``what`` needs the object's shape, and begins a sentence. Raises UsageError("shape-unknown")."""
    if has_geometry(run):
        return
    why = read_shape(run)
    raise UsageError(
        "shape-unknown",
        what=f"{what} needs the shape of the object, and the calibration {run.name} has none. {why.reason}".rstrip(),
        remedy=why.remedy or "Set shape under [object] in stage.toml to auto or plane, and calibrate again.",
    )


def known_geometry(run: Path, projectors: Sequence[str] | None = None) -> Geometry | None:
    """As ``read_geometry``; None where the shape is not known."""
    return read_geometry(run, projectors) if has_geometry(run) else None


def read_geometry(run: Path, projectors: Sequence[str] | None = None) -> Geometry:
    """The geometry of a finished run; ``projectors``: in this order, else as in the run.

    Raises UsageError("shape-unknown").
    """
    require_shape(run, "This")
    arrays = load_arrays(npz_path(run, StepKind.GEOMETRY))
    poses = read_geometry_figures(run)
    points_m, normals, mesh = arrays["points_m"], arrays["normals"], RegisteredMesh.read(run)
    if mesh is not None:
        points_m, normals = mesh.fill(points_m, normals)
    geometry = Geometry(
        camera=_read_pinhole(poses["camera"]),
        projectors=tuple(_read_pinhole(row) for row in poses["projectors"].values()),
        points_m=points_m,
        normals=normals,
        reprojection_rms_px=float(poses["reprojection_rms_px"]),
        scale_known=bool(poses["scale_known"]),
    )
    if projectors is None:
        return geometry
    by_name = dict(zip(poses["projectors"], geometry.projectors, strict=True))
    return replace(geometry, projectors=tuple(by_name[name] for name in projectors))


def read_camera(run: Path) -> Pinhole:
    """The camera of a finished run, without the arrays of its points. Raises UsageError("shape-unknown")."""
    require_shape(run, "This")
    return _read_pinhole(read_geometry_figures(run)["camera"])


def write_view_pose(run: Path, pose: Pose) -> Path:
    """From the first camera's frame to that of this view, whose geometry is in ``run``."""
    row = {"rotation": pose.rotation.tolist(), "translation_m": pose.shift_m.tolist()}
    return write_json(json_path(run, StepKind.GEOMETRY), read_geometry_figures(run) | {"from_first": row})


def read_view_pose(run: Path) -> Pose | None:
    """The pose of ``write_view_pose``, of scale 1; None where the views of a run were not joined."""
    row = read_geometry_figures(run).get("from_first")
    return None if row is None else Pose(1.0, np.array(row["rotation"]), np.array(row["translation_m"]))


def known_points_m(run: Path) -> FloatImage | None:
    """(camera rows, columns, 3) float32: the object's points in the camera's frame, metres, NaN where unknown.

    None before the geometry is known, and where it stays unknown.
    """
    if not npz_path(run, StepKind.GEOMETRY).exists():
        return None
    points: FloatImage = load_arrays(npz_path(run, StepKind.GEOMETRY))["points_m"]
    return points


def read_geometry_figures(run: Path) -> Any:
    """The content of ``geometry.json``; {} if it is missing."""
    path = json_path(run, StepKind.GEOMETRY)
    return read_json(path) if path.exists() else {}


def projectors_of(run: Path) -> list[str]:
    """The run's projectors, in its order. Raises KeyError for a run without geometry."""
    return list(read_geometry_figures(run)["projectors"])


def camera_px(run: Path) -> tuple[int, int] | None:
    """(width, height) of the camera's picture; None before the geometry is known."""
    figures = read_geometry_figures(run)
    if not figures:
        return None
    width, height = figures["camera"]["size_px"]
    return int(width), int(height)


def _pinhole(pinhole: Pinhole) -> dict[str, object]:
    return {
        "matrix": pinhole.matrix.tolist(),
        "distortion": pinhole.distortion.tolist(),
        "rotation": pinhole.rotation.tolist(),
        "translation_m": pinhole.translation_m.tolist(),
        "size_px": list(pinhole.size_px),
    }


def _read_pinhole(row: dict[str, Any]) -> Pinhole:
    keys = ("matrix", "distortion", "rotation", "translation_m")
    matrix, distortion, rotation, translation_m = (np.array(row[key], np.float64) for key in keys)
    width, height = row["size_px"]
    return Pinhole(matrix, distortion, rotation, translation_m, (int(width), int(height)))
