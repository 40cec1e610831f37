"""Veiling glare of a projector: stray light in its lens that lies over its whole picture.

It is seen where the projector's picture is dark beside bright stripes. So is light by way of other surfaces; but a veil
comes from the lens, so the edge of the projector's own shadow has it on one side alone. Light of other surfaces, and a
veil of the camera's lens, hardly differ between both sides of such an edge. What the paint is there, the white of
another projector tells, which throws no shadow there.
"""

from __future__ import annotations

from collections import defaultdict
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
"""Of a projector's brightest white: below it a pixel is in the shadow, whose place in the picture is not known."""
EDGE_PERCENT: Final = (5, 95)
WIDEST_EDGE: Final = 0.3
"""Of a block: pixels between a quarter and three quarters of the edge's light. Where a surface turns away from the
projector, light falls more slowly, and light of other surfaces with it."""
WHOLE: Final = 0.9
LEAST_DARK: Final = 0.15
"""Of a block: pixels that the projector lights, and where its picture is dark."""
LEAST_VEIL: Final = 0.1
"""Of white's light: less would be spread by no veil that counts."""
AGREED: Final = 0.5
"""Standard deviation of what one block says by picture and colour, of its share: a veil is the same in all of them.
Light that spreads under the surface or falls back from near things, and gloss, are not."""
AGREED_LIGHT: Final = 0.02, 0.03
"""The same, of the projector's light: at least for noise, and at most, as no lens spreads much more than this."""
FEWEST: Final = 6, 2
"""Blocks, and groups of them."""
ENOUGH: Final = 4
"""Groups: fewer, which are near each other, do not show how far they err. What their blocks are apart does."""
GROUP_PX: Final = 3 * BLOCK_PX
"""Blocks overlap by half, and neighbours err alike: each group, so large, has one share, the median of its blocks."""
APART: Final = 0.003
"""Blocks of two groups differ by so much even where pictures and colours agree."""
DRAWS: Final = 200
SURE: Final = 4.0
"""Standard errors from which it is believed."""
NAMED: Final = 0.008
"""Of the projector's light; stages without such glare had 0.004 at most, which was not believed."""


@dataclass(frozen=True, slots=True, eq=False)
class DarkPart:
    """A picture of the projector, (rows, columns, ...) of the camera.

    ``light``: what is seen of it, NaN where not known; ``dark``: pixels on which the projector shines, but shows black
    around; ``veil``: of white's light, what a lens spreads there of the picture if all light is stray
    """

    light: FloatImage
    dark: Mask
    veil: FloatImage


@dataclass(frozen=True, slots=True)
class Glare:
    """``share`` of the projector's light that is stray, with its standard error; ``blocks`` that show it, in so many
    ``groups``.
    """

    share: float
    error: float
    blocks: int
    groups: int

    @property
    def sure(self) -> float:
        """The share; 0 where it is not beyond doubt."""
        enough = self.blocks >= FEWEST[0] and self.groups >= FEWEST[1]
        return self.share if enough and self.share > SURE * self.error else 0.0


def projector_glare(whites: Sequence[FloatImage], n: int, parts: Sequence[DarkPart], depth_m: FloatImage) -> Glare:
    """The veil of projector ``n``, from pictures of about ``reflectance.ENOUGH_PIXELS``.

    Parameters
    ----------
    whites : (rows, columns, 3) of each projector alone, less black, in the unit of ``parts``; NaN where not known
    depth_m : (rows, columns), NaN where not known
    """
    groups = _groups(whites, n, parts, depth_m)
    if not groups:
        return Glare(0.0, 0.0, 0, 0)
    shares, apart = np.array([np.median(group, axis=0) for group in groups]).T
    counts = np.array([len(group) for group in groups])
    weights = np.sqrt(counts) / np.hypot(apart, APART)
    share, error = _median(shares, weights)
    if len(groups) < ENOUGH:
        error = float(np.hypot(error, np.average(apart, weights=weights)))
    return Glare(share, error, int(counts.sum()), len(groups))


def _groups(
    whites: Sequence[FloatImage], n: int, parts: Sequence[DarkPart], depth_m: FloatImage
) -> Sequence[Sequence[tuple[float, float]]]:
    """What the blocks of each group say, as ``_agreed``."""
    brightness = [_brightness(white) for white in whites]
    groups = defaultdict[tuple[int, int], list[tuple[float, float]]](list)
    for here in _on_one_surface(depth_m):
        own = brightness[n][here]
        if not _may_be_an_edge(own):
            continue
        low, high = _ends(own)
        if low > SHADOW * high:
            continue
        others = [m for m in range(len(whites)) if m != n and _shows_an_edge(own, brightness[m][here])]
        sums = [each for m in others for each in _sums(whites[n][here], whites[m][here], own > UNLIT, parts, here)]
        if len(sums) > 1 and (agreed := _agreed(sums)) is not None:
            groups[here[0].start // GROUP_PX, here[1].start // GROUP_PX].append(agreed)
    return list(groups.values())


def _agreed(sums: Sequence[tuple[Float64, Float64]]) -> tuple[float, float] | None:
    """The share by a block, and how far pictures and colours are apart in it; None where they do not agree, or where
    shadows are lighter by more than noise: near things light them.
    """
    seen, of_all = np.swapaxes(sums, 0, 1)
    total = float(of_all.sum())
    share = float(seen.sum()) / max(total, 1e-30)
    each = np.divide(seen, of_all, out=np.full_like(seen, share), where=of_all > 0)
    apart = float(np.sqrt(np.sum(of_all * (each - share) ** 2) / max(total, 1e-30)))
    is_veil = share > -AGREED_LIGHT[0] and apart <= np.clip(AGREED * share, *AGREED_LIGHT)
    return (share, apart) if is_veil else None


def _median(shares: Float64, weights: Float64) -> tuple[float, float]:
    """The weighted median, and its standard error: half of what 68 % of the draws with replacement span (bootstrap)."""
    drawn = np.random.default_rng(0).integers(shares.size, size=(DRAWS, shares.size))
    everyone = np.vstack([np.arange(shares.size), drawn])
    everyone = np.take_along_axis(everyone, np.argsort(shares[everyone], axis=1, kind="stable"), axis=1)
    below = np.cumsum(weights[everyone], axis=1)
    at = np.argmax(below >= below[:, -1:] / 2, axis=1)
    medians = shares[everyone[np.arange(at.size), at]]
    low, high = np.percentile(medians[1:], (16, 84))
    return float(medians[0]), float(high - low) / 2


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
) -> Iterator[tuple[Float64, Float64]]:
    """What least squares need of a block, for each picture that tells something: of each colour, (3,), the product of
    the veil with what is seen, and with itself.

    What is seen is the veil on this projector's white; light of other surfaces on the paint, which changes along a
    slope; and light that no paint changes.
    """
    for part in parts:
        dark, light = part.dark[here], part.light[here]
        known = (dark | ~lit) & channels.finite(light)
        if np.count_nonzero(known) < WHOLE * known.size or np.count_nonzero(dark) < LEAST_DARK * dark.size:
            continue
        veil = float(part.veil[here][dark].mean())
        if veil < LEAST_VEIL:
            continue
        paint, own, seen = (picture[known].T.astype(np.float64) for picture in (other, white, light))
        rest = np.stack([paint, paint * DOWN[known], paint * ACROSS[known], np.ones_like(paint)], axis=2)
        span = np.linalg.qr(rest)[0]
        own = veil * own[..., None]
        own -= span @ (span.transpose(0, 2, 1) @ own)
        yield np.sum(own[..., 0] * seen, axis=1), np.sum(own[..., 0] ** 2, axis=1)
