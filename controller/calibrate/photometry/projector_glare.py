"""Veiling glare of a projector: light that goes astray in its lens and lies over its whole picture.

It is seen where the projector's picture is dark beside bright stripes. So is light by way of other surfaces; but a veil
comes from the lens, so the edge of the projector's own shadow has it on one side alone. Light of other surfaces, and a
veil of the camera's lens, hardly differ between both sides of such an edge. What the paint is there, the white of
another projector tells, which throws no shadow there.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from controller.core import channels
from controller.core.arrays import Float64, FloatImage, Mask

BLOCK_PX: Final = 14
"""Of the thinned picture: so small that light of other surfaces changes little in it, apart from a slope."""
DOWN, ACROSS = (np.mgrid[0:BLOCK_PX, 0:BLOCK_PX] + 0.5) / BLOCK_PX - 0.5
"""Of each of its pixels, from its middle, of the block."""
STEEPEST: Final = 0.0035
"""Change of depth from a pixel to the next, of the distance; more is another surface."""
KNOWN_DEPTH: Final = 0.95
SHADOW: Final = 0.25
"""A block has a shadow's edge where its darkest light is less than this share of its brightest."""
LEAST_LIT: Final = 0.15
"""Of a projector's brightest white: the other projector lights the whole block."""
UNLIT: Final = 0.02
"""Of a projector's brightest white: below it a pixel is in the shadow, whose place in the picture nobody knows."""
EDGE_PERCENT: Final = (5, 95)
WIDEST_EDGE: Final = 0.3
"""Of a block: pixels between a quarter and three quarters of the edge's light. Where a surface turns away from the
projector, light falls more slowly, and light of other surfaces with it."""
WHOLE: Final = 0.9
LEAST_DARK: Final = 0.15
"""Of a block: pixels that the projector lights, and where its picture is dark."""
LEAST_VEIL: Final = 0.1
"""Of white's light: less would be spread by no veil that counts."""
FEWEST: Final = 12
"""Blocks."""
GROUP_PX: Final = 3 * BLOCK_PX
"""Blocks overlap by half, and neighbours err alike: the median's error is found by draws of groups, so large."""
DRAWS: Final = 200
SURE: Final = 4.0
"""Standard errors from which it is believed."""
NAMED: Final = 0.008
"""Of the projector's light; stages without such glare had 0.005 at most, which was not believed."""


@dataclass(frozen=True, slots=True, eq=False)
class DarkPart:
    """A picture of the projector, (rows, columns, ...) of the camera.

    ``light``: what is seen of it, NaN where not known; ``dark``: pixels on which the projector shines, but shows black
    around; ``veil``: of white's light, what a lens spreads there of the picture if all light goes astray
    """

    light: FloatImage
    dark: Mask
    veil: FloatImage


@dataclass(frozen=True, slots=True)
class Glare:
    """``share`` of the projector's light that goes astray, with its standard error; ``blocks`` that tell it."""

    share: float
    error: float
    blocks: int

    @property
    def sure(self) -> float:
        """The share; 0 where it is not beyond doubt."""
        return self.share if self.blocks >= FEWEST and self.share > SURE * self.error else 0.0


def projector_glare(whites: Sequence[FloatImage], n: int, parts: Sequence[DarkPart], depth_m: FloatImage) -> Glare:
    """The veil of projector ``n``, from pictures of about ``reflectance.ENOUGH_PIXELS``.

    Parameters
    ----------
    whites : (rows, columns, 3) of each projector alone, less black, in the unit of ``parts``; NaN where not known
    depth_m : (rows, columns), NaN where not known
    """
    brightness = [_brightness(white) for white in whites]
    found, groups = [], []
    for here in _on_one_surface(depth_m):
        own = brightness[n][here]
        if not _may_be_an_edge(own):
            continue
        low, high = _ends(own)
        if low > SHADOW * high:
            continue
        others = [m for m in range(len(whites)) if m != n and _shows_an_edge(own, brightness[m][here])]
        sums = [_sums(whites[n][here], whites[m][here], own > UNLIT, parts, here) for m in others]
        veil, of_all = np.sum(sums, axis=0) if sums else (0.0, 0.0)
        if of_all > 0:
            found.append(veil / of_all)
            groups.append((here[0].start // GROUP_PX, here[1].start // GROUP_PX))
    if not found:
        return Glare(0.0, 0.0, 0)
    return Glare(float(np.median(found)), _error(np.array(found), groups), len(found))


def _error(shares: Float64, groups: Sequence[tuple[int, int]]) -> float:
    """Standard error of the median: half of what 68 % of the draws of groups with replacement span (bootstrap)."""
    number = np.unique(np.array(groups), axis=0, return_inverse=True)[1].ravel()
    members = [shares[number == group] for group in range(int(number.max()) + 1)]
    rng = np.random.default_rng(0)
    drawn = rng.integers(len(members), size=(DRAWS, len(members)))
    medians = [np.median(np.concatenate([members[group] for group in one])) for one in drawn]
    low, high = np.percentile(medians, (16, 84))
    return float(high - low) / 2


def lens_veils(name: str, share: float) -> str | None:
    """What a technician should know of a projector's glare; None where its lens is clear."""
    if share < NAMED:
        return None
    return (
        f"{100 * share:.1f} % of the light of projector {name} lies as a veil over its whole picture (glare in its "
        "lens), so dark parts of a picture are grey. Clean the lens and the window before it. Then calibrate again."
    )


Place = tuple[slice, slice]


def _brightness(white: FloatImage) -> FloatImage:
    """(rows, columns) of the brightest channel, relative to the brightest pixels; NaN where not known."""
    known = channels.finite(white)
    if not known.any():
        return np.full(known.shape, np.nan, np.float32)
    full = np.percentile(white[known], 99, axis=0)
    return np.where(known, channels.largest(white / np.maximum(full, 1e-30)), np.nan).astype(np.float32)


def _on_one_surface(depth_m: FloatImage) -> Iterator[Place]:
    """Blocks without an edge in depth."""
    if not np.isfinite(depth_m).any():
        return
    steep = STEEPEST * float(np.nanmedian(depth_m))
    with np.errstate(invalid="ignore"):
        edges = np.zeros(depth_m.shape, np.bool_)
        edges[:-1] |= np.abs(np.diff(depth_m, axis=0)) > steep
        edges[:, :-1] |= np.abs(np.diff(depth_m, axis=1)) > steep
    known, half = np.isfinite(depth_m), BLOCK_PX // 2
    for row in range(0, depth_m.shape[0] - BLOCK_PX + 1, half):
        for column in range(0, depth_m.shape[1] - BLOCK_PX + 1, half):
            inner = np.s_[row : row + BLOCK_PX - 1, column : column + BLOCK_PX - 1]
            here = np.s_[row : row + BLOCK_PX, column : column + BLOCK_PX]
            if not edges[inner].any() and known[here].mean() >= KNOWN_DEPTH:
                yield here


def _may_be_an_edge(block: FloatImage) -> bool:
    """False where its percentiles can't tell an edge, or a pixel is not known: most blocks, much sooner known."""
    return bool(block.min() <= SHADOW * block.max())


def _ends(block: FloatImage) -> tuple[float, float]:
    """Its EDGE_PERCENT, as ``np.percentile`` finds them, whose preparations take far longer than so few pixels."""
    values = np.sort(block, axis=None)
    places = np.array(EDGE_PERCENT) / 100 * (values.size - 1)
    low, high = np.interp(places, np.arange(values.size), values)
    return float(low), float(high)


def _shows_an_edge(own: FloatImage, other: FloatImage) -> bool:
    """Whether a block has a sharp edge of ``own`` light, and the ``other`` projector lights all of it."""
    if not np.isfinite(other).all() or other.min() < LEAST_LIT:
        return False
    ratio = own / other
    if not _may_be_an_edge(ratio):
        return False
    low, high = _ends(ratio)
    quarter = (high - low) / 4
    between = (ratio > low + quarter) & (ratio < high - quarter)
    return bool(low <= SHADOW * high and between.mean() <= WIDEST_EDGE)


def _sums(
    white: FloatImage, other: FloatImage, lit: Mask, parts: Sequence[DarkPart], here: Place
) -> tuple[float, float]:
    """What least squares need of a block: products of the veil with what is seen, and with itself.

    What is seen is the veil on this projector's white; light of other surfaces on the paint, which changes along a
    slope; and light that no paint changes.
    """
    seen = of_all = 0.0
    for part in parts:
        dark, light = part.dark[here], part.light[here]
        known = (dark | ~lit) & channels.finite(light)
        if np.count_nonzero(known) < WHOLE * known.size or np.count_nonzero(dark) < LEAST_DARK * dark.size:
            continue
        veil = float(part.veil[here][dark].mean())
        if veil < LEAST_VEIL:
            continue
        paint, own, here_seen = (picture[known].T.astype(np.float64) for picture in (other, white, light))
        rest = np.stack([paint, paint * DOWN[known], paint * ACROSS[known], np.ones_like(paint)], axis=2)
        span = np.linalg.qr(rest)[0]
        own = veil * own[..., None]
        own -= span @ (span.transpose(0, 2, 1) @ own)
        seen += float(np.sum(own[..., 0] * here_seen))
        of_all += float(np.sum(own * own))
    return seen, of_all


__all__ = ["DarkPart", "Glare", "lens_veils", "projector_glare"]
