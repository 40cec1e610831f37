"""Fits pictures to the camera's view, because a target must have exactly its size, and cuts them to outlines."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from controller.core.errors import UsageError, VelaturaError
from controller.stage.sessions.calibrations import finished_calibration, finished_calibrations

Region = tuple[tuple[float, float], ...]
"""Corners of one part of a target, as shares of its width and height."""
MOST_REGIONS, MOST_CORNERS = 32, 400


def camera_view_px(stage: Path, names: tuple[str, ...]) -> tuple[int, int] | None:
    """(width, height) of the camera's picture in the newest finished calibration; None without one.

    ``names`` of the projectors.
    """
    from controller.stage.artefacts.calibrated import Calibrated

    try:
        run = next(iter(finished_calibrations(stage)), None)
        return None if run is None else Calibrated(run, names).camera_px
    except (VelaturaError, OSError, ValueError, KeyError, TypeError):
        return None


def png_size(png: bytes) -> tuple[int, int]:
    """(width, height) from a PNG's head."""
    return int.from_bytes(png[16:20], "big"), int.from_bytes(png[20:24], "big")


def fitted(picture: bytes, size_px: tuple[int, int], how: Literal["fit", "fill", "crop", "stretch"] = "fit") -> bytes:
    """``picture`` (PNG) as a PNG of the size of the camera's view; unchanged if it has that size already.

    "fit" shows the whole picture; "fill" fills the view and cuts the edges; "crop" keeps the original pixels in the
    middle of the view. Uncovered parts are transparent: they stay dark. "stretch" covers the view with all of it.
    Raises UsageError("target-unreadable").
    """
    whole = _decoded(picture)
    height, width = whole.shape[:2]
    if (width, height) == size_px:
        return picture
    across, down = size_px[0] / width, size_px[1] / height
    scale = 1.0 if how == "crop" else min(across, down) if how == "fit" else max(across, down)
    if scale != 1.0 or how == "stretch":
        wanted = size_px if how == "stretch" else (max(1, round(width * scale)), max(1, round(height * scale)))
        whole = _resized(whole, wanted, smaller=scale < 1)
    return _png(_in_the_middle(whole, size_px))


def _decoded(picture: bytes) -> npt.NDArray[Any]:
    """(rows, columns, 4) sRGB with alpha, uint8 or uint16. Raises UsageError("target-unreadable")."""
    from controller.core.colour import Unsuitable
    from controller.core.pictures import decode

    try:
        return decode(picture).with_alpha()
    except (Unsuitable, OSError) as error:
        raise UsageError(
            "target-unreadable", what=f"The target can't be used: {error}.", remedy="Save it as PNG."
        ) from error


def _resized(picture: npt.NDArray[Any], size_px: tuple[int, int], *, smaller: bool) -> npt.NDArray[Any]:
    """A transparent pixel's colour has no weight: it must not show at the edges."""
    import cv2

    full = np.iinfo(picture.dtype).max
    interpolation = cv2.INTER_AREA if smaller else cv2.INTER_CUBIC
    if (picture[..., 3] == full).all():
        return np.asarray(cv2.resize(picture, size_px, interpolation=interpolation), picture.dtype)
    colour, alpha = picture[..., :3].astype(np.float32), picture[..., 3:].astype(np.float32) / full
    weighted = np.concatenate([colour * alpha, full * alpha], axis=2)
    made = cv2.resize(weighted, size_px, interpolation=interpolation)
    plain = made[..., :3] * (full / np.maximum(made[..., 3:], full / 1000))
    return np.asarray(np.rint(np.clip(np.dstack([plain, made[..., 3]]), 0, full)), picture.dtype)


def _png(picture: npt.NDArray[Any]) -> bytes:
    import imagecodecs

    # Packed as OpenCV does: in a third of the time, to the same size.
    return bytes(imagecodecs.png_encode(np.ascontiguousarray(picture), level=1, strategy=3, filter=16))


def regions_of(text: str) -> tuple[Region, ...]:
    """The regions of an outline as JSON: lists of corners (x, y), each from 0 to 1 of the picture.

    Raises UsageError("outline-wrong").
    """
    try:
        regions = tuple(tuple((float(x), float(y)) for x, y in region) for region in json.loads(text or "[]"))
    except (ValueError, TypeError, RecursionError):
        raise _wrong_outline() from None
    if len(regions) > MOST_REGIONS or any(not _is_region(region) for region in regions):
        raise _wrong_outline()
    return regions


def _is_region(region: Region) -> bool:
    return 3 <= len(region) <= MOST_CORNERS and all(0 <= x <= 1 and 0 <= y <= 1 for x, y in region)


def _wrong_outline() -> UsageError:
    return UsageError(
        "outline-wrong", what="The outline is not a list of regions with at least three corners each.",
        remedy=f"Draw it again: at most {MOST_REGIONS} regions of {MOST_CORNERS} corners, all inside the picture.",
    )  # fmt: skip


def restricted(picture: bytes, regions: Sequence[Region]) -> bytes:
    """``picture`` (PNG), transparent outside all ``regions``; without any it stays as it is.

    A transparent part of a target is no part of it: it stays dark. Raises UsageError("target-unreadable").
    """
    import cv2

    if not regions:
        return picture
    whole = _decoded(picture)
    rows, columns = whole.shape[:2]
    inside = np.zeros((rows, columns), np.uint8)
    for region in regions:
        # Each on its own, because together their overlaps would count as outside.
        cv2.fillPoly(inside, [np.rint(np.array(region) * (columns - 1, rows - 1)).astype(np.int32)], 255)
    whole[..., 3] = np.minimum(whole[..., 3], inside.astype(whole.dtype) * (np.iinfo(whole.dtype).max // 255))
    return _png(whole)


def _in_the_middle(picture: npt.NDArray[Any], size_px: tuple[int, int]) -> npt.NDArray[Any]:

    height, width = picture.shape[:2]
    view = np.zeros((size_px[1], size_px[0], 4), picture.dtype)
    rows, columns = min(height, size_px[1]), min(width, size_px[0])
    top, left = (height - rows) // 2, (width - columns) // 2
    down, right = (size_px[1] - rows) // 2, (size_px[0] - columns) // 2
    view[down : down + rows, right : right + columns] = picture[top : top + rows, left : left + columns]
    return view


def on_object(stage: Path, names: tuple[str, ...], picture: Path, kind: str, points: str = "") -> bytes:
    """A PNG of the size of the camera's view, transparent beside the object, by the newest finished calibration.

    ``kind``: of an appearance; ``points``: of a restoration. Raises UsageError("restoration-points") and what
    ``make_target`` and ``finished_calibration`` raise.
    """
    from controller.core.colour import linear_to_srgb
    from controller.stage.artefacts.calibrated import Calibrated
    from controller.stage.steps.appearance.requests import make_target

    calibrated = Calibrated(finished_calibration(stage), names)
    options = {}
    if points and kind == "restoration":
        sides = np.array([*png_size(picture.read_bytes()), *calibrated.transport.camera_shape[::-1]])
        try:
            options["points"] = (np.array(json.loads(points), np.float64).reshape(-1, 4) * sides - 0.5).tolist()
        except (ValueError, TypeError, RecursionError):
            raise UsageError(
                "restoration-points",
                what="The points are not pairs of places.",
                remedy="Choose at least four places in the picture and on the object.",
            ) from None
    made = make_target(kind, picture, options, calibrated)
    seen = np.rint(255 * np.dstack([linear_to_srgb(made.image), made.mask])).astype(np.uint8)
    return _png(seen)
