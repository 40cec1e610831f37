"""How near a photographed result is to its target: colour difference, error, sharpness.

A result is judged by three sets of pixels (``evaluation``), so that no error is hidden by the choice of pixels:

- in reach: the projectors can make what was asked for there
- lit: at least one projector lights it, and the target says something there
- visible: the whole object as the camera sees it, also where no projector lights it
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any, Final

import cv2
import numba
import numpy as np
import numpy.typing as npt

from controller.core.arrays import Float64, FloatImage, Mask
from controller.core.blur import nearest_known
from controller.core.channels import mean
from controller.core.errors import UsageError
from controller.core.jit import compiled

TURN: Final = 2 * math.pi
POWER_25: Final = 25.0**7


@compiled(parallel=True)
def ciede2000(first: Float64, second: Float64, to_relative: Float64, out: Float64) -> None:
    """Write the difference of each pair to ``out`` (N,); ``first``, ``second`` (N, 3) are linear.

    ``to_relative`` (3, 3): of them to XYZ, where white is 1
    """
    for n in numba.prange(len(out)):
        out[n] = _difference(_lab(first, n, to_relative), _lab(second, n, to_relative))


@compiled()
def _lab(colours: Float64, n: int, to_relative: Float64) -> tuple[float, float, float]:
    x, y, z = _root(colours, n, to_relative[0]), _root(colours, n, to_relative[1]), _root(colours, n, to_relative[2])
    return 116.0 * y - 16.0, 500.0 * (x - y), 200.0 * (y - z)


@compiled()
def _root(colours: Float64, n: int, row: Float64) -> float:
    t = max(colours[n, 0] * row[0] + colours[n, 1] * row[1] + colours[n, 2] * row[2], 0.0)
    return float(np.cbrt(t)) if t > (6.0 / 29.0) ** 3 else t / (3.0 * (6.0 / 29.0) ** 2) + 4.0 / 29.0


@compiled()
def _saturation(chroma: float) -> float:
    power = chroma**7
    return math.sqrt(power / (power + POWER_25))


@compiled()
def _difference(one: tuple[float, float, float], other: tuple[float, float, float]) -> float:
    stretch = 1.5 - 0.5 * _saturation(0.5 * (math.hypot(one[1], one[2]) + math.hypot(other[1], other[2])))
    a1, a2 = stretch * one[1], stretch * other[1]
    c1, c2 = math.hypot(a1, one[2]), math.hypot(a2, other[2])
    h1, h2 = math.atan2(one[2], a1) % TURN, math.atan2(other[2], a2) % TURN
    apart, hue = h2 - h1, h1 + h2
    if c1 * c2 == 0.0:
        apart = 0.0
    else:
        if abs(apart) > math.pi:
            hue += TURN if hue < TURN else -TURN
            apart -= TURN if apart > 0.0 else -TURN
        hue *= 0.5
    lightness, chroma = 0.5 * (one[0] + other[0]) - 50.0, 0.5 * (c1 + c2)
    weight = (
        1.0
        - 0.17 * math.cos(hue - math.radians(30.0))
        + 0.24 * math.cos(2.0 * hue)
        + 0.32 * math.cos(3.0 * hue + math.radians(6.0))
        - 0.20 * math.cos(4.0 * hue - math.radians(63.0))
    )
    bend = math.radians(60.0) * math.exp(-(((math.degrees(hue) - 275.0) / 25.0) ** 2))
    by_lightness = (other[0] - one[0]) / (1.0 + 0.015 * lightness**2 / math.sqrt(20.0 + lightness**2))
    by_chroma = (c2 - c1) / (1.0 + 0.045 * chroma)
    by_hue = 2.0 * math.sqrt(c1 * c2) * math.sin(0.5 * apart) / (1.0 + 0.015 * chroma * weight)
    turned = -2.0 * math.sin(bend) * _saturation(chroma) * by_chroma * by_hue
    return math.sqrt(max(by_lightness**2 + by_chroma**2 + by_hue**2 + turned, 0.0))


BAND_PIXELS: Final = 1 << 18
"""Pixels compared at a time, so that memory stays bounded at any size."""
SHARE_OF_MEDIAN: Final = 0.5
"""Canny's high threshold is this share of the median gradient along the target's own edges, so that a result with less
contrast still has them (docs/decisions/0033). The low threshold is ``WEAK`` of the high one."""
WEAK: Final = 0.4
EDGE_SIGMA_PX: Final = 1.4
GRADIENT_SCALE: Final = 2000.0
"""Gradients as 16-bit integers: a step from black to white stays in range, and a thousandth of it is seen."""
FAINTEST_EDGE: Final = 40.0
"""No threshold below this: two hundredths of the way from black to white, as a step."""


@dataclass(frozen=True, slots=True)
class Comparison:
    """Figures over the pixels of a mask; ``error_map`` (rows, columns) float32 CIEDE2000, 0 outside the mask."""

    delta_e00_median: float
    delta_e00_p95: float
    rmse: float
    sharpness_lambda: float
    error_map: FloatImage


def colour_difference(
    achieved: FloatImage, target: FloatImage, camera_to_xyz: Float64, white: float, mask: Mask
) -> FloatImage:
    """CIEDE2000 at each pixel of ``mask``, 0 elsewhere; images (rows, columns, 3) in linear camera units.

    ``white`` is the camera value of a perfect white at the target's exposure.
    """
    difference = np.zeros(mask.shape, np.float32)
    ys, xs = np.nonzero(mask)
    to_relative = np.ascontiguousarray(camera_to_xyz / (camera_to_xyz @ np.full(3, white))[:, None], np.float64)
    for first in range(0, ys.size, BAND_PIXELS):
        at = ys[first : first + BAND_PIXELS], xs[first : first + BAND_PIXELS]
        a, b = (image[at].astype(np.float64) for image in (achieved, target))
        found = np.empty(len(a))
        ciede2000(a, b, to_relative, found)
        difference[at] = found
    return difference


def compare(achieved: FloatImage, target: FloatImage, camera_to_xyz: Float64, white: float, mask: Mask) -> Comparison:
    """All figures of one appearance. ``rmse`` is relative to ``white``.

    Raises UsageError("nothing-to-compare") when the mask is empty or the images are not finite or of different sizes.
    """
    if achieved.shape != target.shape or target.shape[:2] != mask.shape or not mask.any() or not white > 0:
        raise _incomparable("they differ in size, or the mask is empty")
    if not (np.isfinite(achieved[mask]).all() and np.isfinite(target[mask]).all()):
        raise _incomparable("some pixels are not finite")
    difference = colour_difference(achieved, target, camera_to_xyz, white, mask)
    inside = difference[mask]
    error = (achieved[mask].astype(np.float64) - target[mask]) / white
    return Comparison(
        delta_e00_median=float(np.median(inside)),
        delta_e00_p95=float(np.percentile(inside, 95)),
        rmse=float(np.sqrt((error**2).mean())),
        sharpness_lambda=sharpness(achieved, target, white, mask),
        error_map=difference,
    )


def sharpness(achieved: FloatImage, target: FloatImage, white: float, mask: Mask) -> float:
    """Local sharpness lambda: edges in common over the larger number of edges (paper 6, eq. 9); 1 without edges.

    Both edge images are cut at the target's own threshold, so a flat result does not find edges in its noise.
    """
    return _lambda(*edges_of_both(achieved, target, white, mask))


def sharpness_windows(
    achieved: FloatImage, target: FloatImage, white: float, mask: Mask, size_px: int, *, least_edges: int = 12
) -> tuple[FloatImage, float]:
    """lambda (paper 6, eq. 9) in each square window of ``size_px`` camera pixels, and over all of them.

    (window rows, window columns) float32, NaN where the target has fewer than ``least_edges`` edge pixels.
    """
    ours, theirs = edges_of_both(achieved, target, white, mask)

    def counted(picture: Mask) -> Float64:
        rows, columns = (-(-side // size_px) * size_px for side in mask.shape)
        whole = np.zeros((rows, columns))
        whole[: mask.shape[0], : mask.shape[1]] = picture
        return np.asarray(whole.reshape(rows // size_px, size_px, columns // size_px, size_px).sum(axis=(1, 3)))

    common, most = counted(ours & theirs), np.maximum(counted(ours), counted(theirs))
    enough = (counted(theirs) >= least_edges) & (most > 0)
    local = np.divide(common, most, out=np.full(most.shape, np.nan), where=enough)
    return local.astype(np.float32), _lambda(ours, theirs)


def _lambda(ours: Mask, theirs: Mask) -> float:
    most = max(int(ours.sum()), int(theirs.sum()))
    return float((ours & theirs).sum() / most) if most else 1.0


def edges_of_both(achieved: FloatImage, target: FloatImage, white: float, mask: Mask) -> tuple[Mask, Mask]:
    """Edges (rows, columns) of both pictures inside the mask, by Canny."""
    gradients = [_gradient(image, white) for image in (achieved, target)]
    of_target = _canny(gradients[1], FAINTEST_EDGE) & mask
    strength = np.hypot(*(part[of_target].astype(np.float32) for part in gradients[1]))
    median = float(np.median(strength)) if strength.size else 0.0
    threshold = max(SHARE_OF_MEDIAN * median, FAINTEST_EDGE)
    ours, theirs = (_canny(gradient, threshold) & mask for gradient in gradients)
    return ours, theirs


def _canny(gradient: tuple[npt.NDArray[np.int16], npt.NDArray[np.int16]], threshold: float) -> Mask:
    return np.asarray(cv2.Canny(*gradient, WEAK * threshold, threshold, L2gradient=True) > 0)


def _gradient(image: FloatImage, white: float) -> tuple[npt.NDArray[np.int16], npt.NDArray[np.int16]]:
    """Gradient of a picture's brightness after a display's gamma, so that edges in the dark count as they are seen."""
    grey = np.clip(mean(image) / white, 0, 1) ** np.float32(1 / 2.2)
    smooth = cv2.GaussianBlur(grey.astype(np.float32), (0, 0), EDGE_SIGMA_PX)
    dx, dy = (cv2.Sobel(smooth, cv2.CV_32F, 1 - i, i) * GRADIENT_SCALE for i in range(2))
    return np.round(dx).astype(np.int16), np.round(dy).astype(np.int16)


def _incomparable(why: str) -> UsageError:
    return UsageError(
        "nothing-to-compare",
        what=f"The result can't be compared with its target: {why}.",
        remedy="Compare camera images of one stage, on pixels of the object.",
    )


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
    seen = visible_object(lit)
    whole = asked
    if (valid & lit).any() and (seen & ~(valid & lit)).any():
        whole = asked[nearest_known(valid & lit)[1]]
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
