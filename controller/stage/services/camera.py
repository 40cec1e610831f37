"""``velatura camera``: the printed board, and the lens calibration from photographs of it."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from controller.core.arrays import ByteImage
from controller.core.colour import Unsuitable
from controller.core.errors import CalibrationError, UsageError, WorkError
from controller.core.pictures import read_picture_file
from controller.core.storage import write_atomically
from controller.optics.calibrate.geometry.intrinsics import OTHER_KEYS, CameraIntrinsics, write_intrinsics
from controller.optics.calibrate.geometry.lenses import (
    board_picture,
    calibrate_views,
    find_corners,
    intrinsics_from_exif,
)
from controller.optics.capture.raw import read_photograph
from controller.run.progress import Reporter
from hal.notices import Level

PICTURES = (".jpg", ".jpeg", ".png", ".tif", ".tiff")


def board(*, out: Path) -> dict[str, Any]:
    """Write the board as a PNG to print. Raises WorkError("no-space", "cannot-write")."""
    picture = board_picture()
    write_atomically(out, cv2.imencode(".png", picture)[1].tobytes())
    return {"file": out, "width_px": picture.shape[1], "height_px": picture.shape[0]}


def calibrate(*, photographs: Sequence[Path], out: Path, reporter: Reporter, cancel: threading.Event) -> dict[str, Any]:
    """Compute the lens from board photographs; write it to ``out``; raises as ``calibrate_views``, ``read_grey``."""
    views, size = [], None
    for path in photographs:
        if cancel.is_set():
            raise WorkError("cancelled", what="The camera calibration was stopped.", remedy="Start it again.")
        grey = read_grey(path)
        if size is not None and size != grey.shape:
            raise UsageError(
                "camera-photographs-differ",
                what=f"{path.name} has {grey.shape[1]} x {grey.shape[0]} pixels, the others {size[1]} x {size[0]}.",
                remedy="Take all photographs with the same camera, orientation and format.",
            )
        size = grey.shape
        view = find_corners(grey)
        if view is None:
            reporter.say(f"{path.name} does not show the board well enough. It is not used.", Level.WARNING)
        else:
            reporter.say(f"{path.name}: {len(view.board)} corners")
            views.append(view)
    if size is None or not views:
        raise CalibrationError(
            "camera-board-not-found",
            what=f"The board was found in none of {len(photographs)} photographs.",
            remedy="Print the board from `velatura camera board`, fill half of the picture with it, light it evenly.",
        )
    return _kept(calibrate_views(views, (size[1], size[0])), out)


def from_exif(*, photograph: Path, out: Path) -> dict[str, Any]:
    """Read the lens from a photograph's EXIF data and write it to ``out``. Raises as ``intrinsics_from_exif``."""
    return _kept(intrinsics_from_exif(photograph), out)


def read_grey(path: Path) -> ByteImage:
    """A photograph with display gamma, (rows, columns) uint8. Raises WorkError("photograph-unreadable")."""
    if path.suffix.lower() in PICTURES:
        try:
            # as it lies on the sensor: the stage's pictures are not rotated either
            shown = read_picture_file(path, upright=False).bytes_shown()
        except Unsuitable as error:
            raise WorkError(
                "photograph-unreadable",
                what=f"The photograph {path} can't be read: {error}.",
                remedy="Give unedited JPEG, PNG, TIFF or RAW files from the camera.",
            ) from error
        return np.asarray(cv2.cvtColor(shown, cv2.COLOR_RGB2GRAY), np.uint8)
    light = read_photograph(path).image.mean(axis=2)
    bright = max(float(np.quantile(light, 0.98)), 1e-6)
    return np.asarray(np.clip(255.0 * np.sqrt(np.clip(light / bright, 0, 1)), 0, 255), dtype=np.uint8)


def _kept(found: CameraIntrinsics, out: Path) -> dict[str, Any]:
    write_intrinsics(out, found)
    focal, cx, cy, k1, *more = found.sigmas
    others = zip(OTHER_KEYS, found.other_terms, more, strict=False)
    return {
        "file": out,
        "focal_length_px": f"{found.focal_px:.1f} +- {100 * focal:.2g} %",
        "principal_point_px": f"{found.centre_px[0]:.1f} +- {cx:.1f}, {found.centre_px[1]:.1f} +- {cy:.1f}",
        "distortion_k1": f"{found.k1:.4f} +- {k1:.2g}",
        **{key: f"{value:.5f} +- {sigma:.2g}" for key, value, sigma in others},
        "rms_px": round(found.rms_px, 3),
        "views": found.views,
    }
