"""``velatura export``: a calibrated stage for other programs."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import numpy as np

from controller.core.arrays import ByteImage, FloatImage, summed
from controller.core.errors import UsageError
from controller.optics.calibrate.values import Geometry
from controller.optics.transport.planes import CameraBox
from controller.stage.artefacts.calibrated import Calibrated, all_views
from controller.stage.artefacts.geometry import (
    has_geometry,
    known_geometry,
    projectors_of,
    read_geometry_figures,
    read_view_pose,
    require_shape,
)
from controller.stage.artefacts.projectors import Light, Pixels
from controller.stage.artefacts.views import view_folders
from controller.stage.exchange.content import Content, OtherView
from controller.stage.exchange.formats import format_of
from controller.stage.exchange.pairs import is_pairs, write_pairs_transport
from controller.stage.sessions.calibrations import finished_calibration
from controller.stage.steps.mesh import carried_mesh

MOST_VERTICES: Final = 1_000_000


def export(*, run: Path, kind: str, out: Path | None, step: int | None, crop: str | None = None) -> dict[str, Any]:
    """Write a finished calibration run, or a stage's newest, in the format ``kind`` to ``out``, a file or a folder.

    ``step``: every n-th camera pixel becomes a vertex; None: at most ``MOST_VERTICES`` vertices
    ``run``: for a transport also a folder of pairs (``read_pairs``)
    ``crop``: "X,Y,WIDTH,HEIGHT" in camera pixels, for a transport

    Raises UsageError("export-format-unknown", "not-calibrated", "crop-wrong"), and as the writers and ``carried_mesh``.
    """
    chosen = format_of(kind)
    box = None if crop is None else _box(crop)
    if kind == "transport" and is_pairs(run):
        target = out or run / chosen.place
        return {"written": target, **write_pairs_transport(run, target, box)}
    if (run / "stage.toml").is_file():
        run = finished_calibration(run)
    if not read_geometry_figures(run):
        raise UsageError(
            "not-calibrated",
            what=f"{run} has no reconstructed geometry.",
            remedy="Give the folder of a finished calibration: STAGE/runs/...",
        )
    if chosen.shape:
        require_shape(run, f"The format {chosen.name}")
    if kind == "uv" and has_geometry(run):
        carried_mesh(run)
    target = run / chosen.place if out is None else out
    return {"written": target, **chosen.write(_content(run, step, box, all_sides=kind == "uv"), target)}


def _content(run: Path, step: int | None, crop: CameraBox | None, *, all_sides: bool) -> Content:
    """``all_sides``: the transport is that of all views."""
    shape = known_geometry(run)
    names = tuple(projectors_of(run))
    calibrated = all_views(run, names) if all_sides else Calibrated(run, names)
    return Content(
        folder=run,
        shape=shape,
        names=names,
        step=step or (1 if shape is None else _usual_step(shape)),
        picture=_picture(run, names),
        seen_px=tuple(_seen(run, name) for name in names),
        metapixels=lambda: tuple(part.metapixels for part in calibrated.calibration.projectors),
        transport=lambda: calibrated.transport,
        black=lambda: calibrated.calibration.black,
        crop=crop,
        others=() if shape is None else tuple(_others(run, names)),
        places=calibrated.places,
    )


def _others(run: Path, names: tuple[str, ...]) -> Iterator[OtherView]:
    """The views that were joined with the first one."""
    for name, folder in list(view_folders(run).items())[1:]:
        pose, own = read_view_pose(folder), known_geometry(folder, names)
        if pose is not None and own is not None:
            yield OtherView(name, own, pose, _picture(folder, names), tuple(_seen(folder, one) for one in names))


def _usual_step(geometry: Geometry) -> int:
    known = int(np.isfinite(geometry.points_m[..., 2]).sum())
    return max(1, math.ceil(math.sqrt(known / MOST_VERTICES)))


def _box(crop: str) -> CameraBox:
    try:
        left, top, width, height = (int(part) for part in crop.split(","))
    except ValueError:
        raise UsageError(
            "crop-wrong",
            what=f"{crop!r} is not an area of the picture.",
            remedy="Give --crop X,Y,WIDTH,HEIGHT in whole camera pixels.",
        ) from None
    return CameraBox(top, left, top + height, left + width)


def _seen(run: Path, name: str) -> FloatImage | None:
    """(camera rows, columns, 2) x and y in the projector's picture, NaN where unknown; None where not measured."""
    if not Pixels.path(run, name).is_file():
        return None
    found = Pixels.read(run, name).correspondence
    return np.where(found.valid[..., None], found.projector_px, np.float32(np.nan)).astype(np.float32)


def _picture(run: Path, names: tuple[str, ...]) -> ByteImage | None:
    """The object in all projectors' white light, sRGB (rows, columns, 3); None if the run has no white images."""
    if not all(Light.path(run, name).is_file() for name in names):
        return None
    white = summed([np.nan_to_num(Light.read(run, name).white) for name in names])
    linear = np.clip(white / max(float(np.quantile(white, 0.995)), 1e-12), 0.0, 1.0)
    curve = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    return np.asarray(np.rint(255.0 * curve), dtype=np.uint8)
