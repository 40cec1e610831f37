"""A photographed result by three sets of pixels, so that nothing is hidden by what is left out.

- in reach: the projectors can make what was asked for there
- lit: at least one projector lights it, and the target says something there
- visible: the whole object as the camera sees it, also where no projector lights it
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, Final

import cv2
import numpy as np

from controller.core.arrays import Float64, FloatImage, Mask
from controller.optics.solve.result.metrics import colour_difference

GAP: Final = 0.01
"""Half the width of the gaps between lit pixels that belong to the object, relative to the picture's longer side."""
TITLES: Final = {"in_reach": "in reach", "lit": "all lit pixels", "visible": "whole visible object"}


@dataclass(frozen=True, slots=True)
class PixelSet:
    """CIEDE2000 over a set of pixels, and ``left_out_share``: those of the visible object that are not in it.

    ``delta_e00_median`` and ``delta_e00_p95`` are None where the set is empty.
    """

    delta_e00_median: float | None
    delta_e00_p95: float | None
    left_out_share: float


def by_pixels(
    photograph: FloatImage,
    asked: FloatImage,
    camera_to_xyz: Float64,
    white: float,
    *,
    reachable: Mask,
    valid: Mask,
    lit: Mask,
) -> dict[str, PixelSet]:
    """Each of ``TITLES``' sets; images (rows, columns, 3) radiance, masks (rows, columns).

    ``reachable``: where ``asked`` is in reach; ``valid``: where it says something. Beyond that, a pixel is compared
    with the nearest one where it does. ``white``: radiance of the target's white.
    """
    from scipy.ndimage import distance_transform_edt

    seen = visible_object(lit)
    whole = asked
    if (valid & lit).any() and (seen & ~(valid & lit)).any():
        nearest = distance_transform_edt(~(valid & lit), return_distances=False, return_indices=True)
        whole = asked[tuple(nearest)]
    sets = {"in_reach": reachable & valid & lit, "lit": valid & lit, "visible": seen}
    error = colour_difference(np.nan_to_num(photograph), whole, camera_to_xyz, white, seen)
    return {name: _figures(error, pixels, int(seen.sum())) for name, pixels in sets.items()}


def visible_object(lit: Mask) -> Mask:
    """The object (rows, columns) from its lit pixels: with holes, and gaps of up to two ``GAP`` between them."""
    from scipy.ndimage import binary_fill_holes

    radius = round(GAP * max(lit.shape))
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    padded = np.pad(lit.astype(np.uint8), radius + 1, mode="edge")
    closed = cv2.morphologyEx(padded, cv2.MORPH_CLOSE, disc)[radius + 1 : -radius - 1, radius + 1 : -radius - 1]
    return np.asarray(binary_fill_holes(closed > 0), np.bool_)


def as_table(sets: dict[str, PixelSet]) -> dict[str, Any]:
    """For report.json."""
    return {name: asdict(one) for name, one in sets.items()}


def as_rows(table: dict[str, Any]) -> list[tuple[str, str]]:
    """``as_table`` in words, one row a set: median / 95 %, and what it leaves out."""
    rows = []
    for name, title in TITLES.items():
        one = table[name]
        left_out = f"{100 * one['left_out_share']:.1f} % left out"
        known = one["delta_e00_median"] is not None
        values = f"{one['delta_e00_median']:.2f} / {one['delta_e00_p95']:.2f}; " if known else ""
        rows.append((f"{title}, median / 95 %", values + left_out))
    return rows


def _figures(error: FloatImage, pixels: Mask, visible: int) -> PixelSet:
    left_out = 1 - float(pixels.sum()) / max(visible, 1)
    if not pixels.any():
        return PixelSet(None, None, left_out)
    median, p95 = np.percentile(error[pixels], (50, 95))
    return PixelSet(float(median), float(p95), left_out)
