"""The fit of three responses and a mixing to colour tiles, and what of the tiles' light depends on the paint.

Mixing and responses are fitted in turns, each with the other held, until neither changes; tiles that do not fit are
left out. A lamp is never equally strong in two photographs; the tiles that show full channels tell how strong it was.

How much of each colour of a projector the camera sees depends on the paint, because paint and lamps have spectra.
Reflectances of paint are nearly a sum of three (Maloney 1986). Then what a camera channel sees of a projector channel
is a sum of what the three camera channels see of white there: W_k r becomes the sum over j of W_j B_kj r. One B of 27
numbers holds for all paints of a stage, and the colour tiles tell it: each shows another colour on another paint.

What surfaces throw back depends on the tiles around. What is known of it is the share of white, which is as bright
everywhere as the picture is on the mean. The difference changes slowly from one tile to the next and a tile's levels
do not: so neighbours tell how much of a tile's residual it is (a Gaussian process).
"""

from __future__ import annotations

import dataclasses
import functools
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
import numpy.typing as npt

from controller.core.arrays import Float64
from controller.core.errors import CalibrationError
from controller.optics.calibrate.photometry.colour_tiles import DOUBT, TileMeasurements
from controller.optics.calibrate.values import Radiometry

UNEVEN: Final = 0.3
"""Standard deviation of a tile's indirect light from what is known of it, relative, as far as neighbours share it."""
ALIKE_TILES: Final = 1.5
"""Standard deviation of the Gaussian by which tiles are alike, in tiles."""
OWN: Final = 0.05
"""Standard deviation of a tile's own part, relative."""
LEAST_KEPT: Final = 1e-3
REACH: Final = 6.0
"""Standard deviations beyond which tiles are not alike."""
UNEVEN_CONVERGED: Final = 1e-7
MOST_TURNS: Final = 1000


def own_weight(tiles: TileMeasurements) -> Float64:
    """(tiles, 3) inverse variance of the measurements where neighbours tell the rest of the indirect light."""
    variance = 1 / tiles.weight + (OWN**2 - DOUBT**2) * tiles.indirect**2
    return np.asarray(1 / np.maximum(variance, 1e-12), np.float64)


def uneven_light(tiles: TileMeasurements, residual: Float64, weight: Float64) -> Float64:
    """(tiles, 3): the part of ``residual`` (tiles, 3) that is indirect light which neighbouring tiles share.

    ``weight`` (tiles, 3): inverse variance of each tile's own part; 0 for what does not count
    """
    shared_light = np.zeros_like(residual)
    for photograph in range(int(tiles.photograph.max(initial=-1)) + 1):
        rows = np.flatnonzero(tiles.photograph == photograph)
        variance = 1 / np.maximum(weight[rows], LEAST_KEPT * tiles.weight[rows])
        shared = _Shared(tiles.place[rows], UNEVEN * tiles.indirect[rows])
        shared_light[rows] = shared.times(_solved(shared, variance, residual[rows]))
    return shared_light


class _Shared:
    """The covariance (tiles, tiles) of each channel, as a filter of the tiles' grid: 8,100 tiles make a big matrix."""

    def __init__(self, place: npt.NDArray[np.int64], strength: Float64) -> None:
        self._place, self._strength = (place[:, 0], place[:, 1]), strength
        self._size = (*(place.max(axis=0, initial=0) + 1), 3)
        reach = np.arange(-int(REACH * ALIKE_TILES), int(REACH * ALIKE_TILES) + 1)
        self._alike = np.exp(-(reach**2) / (2 * ALIKE_TILES**2))
        self.variance = strength**2

    def times(self, values: Float64) -> Float64:
        """``values`` (tiles, 3) of each channel times its covariance."""
        grid = np.zeros(self._size)
        grid[self._place] = values * self._strength
        around = cv2.sepFilter2D(grid, cv2.CV_64F, self._alike, self._alike, borderType=cv2.BORDER_CONSTANT)
        return np.asarray(around[self._place] * self._strength, np.float64)


def _solved(shared: _Shared, variance: Float64, residual: Float64) -> Float64:
    """x of each channel in (shared + variance) x = residual, by conjugate gradients."""
    from scipy.sparse.linalg import LinearOperator, cg

    shape, size = residual.shape, residual.size
    scale = (1 / (variance + shared.variance)).ravel()

    def whole(x: Float64) -> Float64:
        values = x.reshape(shape)
        return (shared.times(values) + variance * values).ravel()

    solution, _ = cg(
        LinearOperator((size, size), matvec=whole, dtype=np.float64),
        residual.ravel(),
        rtol=UNEVEN_CONVERGED,
        maxiter=MOST_TURNS,
        M=LinearOperator((size, size), matvec=lambda x: scale * x, dtype=np.float64),
    )
    return np.asarray(solution.reshape(shape), np.float64)


LIKELY: Final = 0.3
"""Standard deviation of its numbers before tiles are looked at."""
LIKELY_NOISE: Final = 0.01
"""Of a tile of mean weight, beside that."""
FAINTEST: Final = 0.02
"""Of the brightest of a paint's colours: less is taken for so much, because the quotient would be noise."""


def colour_of(white: Float64) -> Float64:
    """(..., 3, 3): ``white`` (..., 3) of channel j over that of channel k, at [k, j]."""
    floor = FAINTEST * white.max(axis=-1, keepdims=True)
    safe = np.maximum(white, np.maximum(floor, 1e-30))
    return np.asarray(safe[..., None, :] / safe[..., :, None], np.float64)


def fit_paint_mixing(tiles: TileMeasurements, shown: Float64, weight: Float64, mixing: Float64) -> Float64:
    """B (3, 3, 3): camera channel, projector channel, camera channel of white.

    Parameters
    ----------
    tiles : ``ratio`` without stray light of other tiles
    shown : (tiles, 3) light of each projector channel
    weight : (tiles, 3) of each measurement
    mixing : (3, 3) of all paints together, which B is near to where nothing else is known
    """
    quotient = colour_of(tiles.white)
    paint = np.zeros((3, 3, 3))
    others = shown[:, :2] - shown[:, 2:]
    for channel in range(3):
        root = np.sqrt(weight[:, channel])
        parts = [others * quotient[:, channel, j, None] for j in range(3)]
        equations = np.concatenate(parts, axis=1) * root[:, None]
        before = np.zeros(6)
        before[2 * channel : 2 * channel + 2] = mixing[channel, :2]
        left = (tiles.ratio[:, channel] - shown[:, 2]) * root - equations @ before
        prior = np.eye(6) * np.sqrt(weight[:, channel].mean()) * LIKELY_NOISE / LIKELY
        solved = np.linalg.lstsq(np.concatenate([equations, prior]), np.concatenate([left, np.zeros(6)]), rcond=None)[0]
        two = (before + solved).reshape(3, 2).T  # projector channel, channel of white
        paint[channel, :2] = two
        paint[channel, 2] = (np.arange(3) == channel) - two.sum(axis=0)
    return paint


def paint_light(tiles: TileMeasurements, shown: Float64, paint: Float64) -> Float64:
    """(tiles, 3): light over white by B."""
    return np.asarray(np.einsum("tkj,kcj,tc->tk", colour_of(tiles.white), paint, shown))


KNOTS = 16
FIRST_GAMMA = 2.2
ROUNDS = 40
ROUGH_ROUNDS = 5
"""Rounds in which no tile is left out and no stray light is assumed yet."""
CONVERGED = 1e-5
UNEVEN_ROUNDS = 6
"""Turns of fit and uneven indirect light. More change the response at value 64 by a few tenths of a per cent."""
OUTLIER = 3.0
WORST_SCATTER = 0.05
WORST_ADDITIVITY = 0.08
LEAST_INDEPENDENCE = 0.01
MOST_STRAY = 0.3
MOST_FLICKER = 0.05
"""A lamp that differs more from one photograph to the next is not stable; then it is not the lamp. One that flickers by
1 % and drifts by 2 % differs by 3.4 % now and then."""
FEWEST_FULL = 8
"""Tiles with a full channel that tell the lamp's strength."""
STIFFNESS = 1e-3
WORST_FALL = 0.03
MOST_SEGMENT = 0.7
PAINT_ROUNDS = 2
"""A third changes the scatter by less than a hundredth."""
PROMISING = 0.95
"""Scatter with paint over that without, before responses are fitted again; above it, that is not worth its time."""
BETTER_BY_PAINT = 0.85
"""Scatter of the tiles with paint over that without, from which on paint makes a difference."""


@dataclass(slots=True)
class RadiometryFit:
    """``response`` (3, 256), ``mixing`` (3, 3), ``stray`` (3,), ``residual`` (tiles, 3); ``fall``: how far r fell.

    ``strength`` (photographs,): the lamp's in each photograph of tiles, 1 at white; ``segment``: see ``Radiometry``
    """

    response: Float64
    mixing: Float64
    stray: Float64
    strength: Float64
    residual: Float64
    fall: float = 0.0
    additivity: float = 0.0
    segment: float = 0.0

    @property
    def scatter(self) -> float:
        """Standard deviation of the tiles from the fit, of full scale, by the median of the deviations."""
        return _scatter(self.residual)

    @property
    def good(self) -> bool:
        """Whether the tiles follow from it."""
        return self.scatter <= WORST_SCATTER and self.fall <= WORST_FALL and self.additivity <= WORST_ADDITIVITY


def with_paint(tiles: TileMeasurements, alone: RadiometryFit) -> tuple[TileMeasurements, RadiometryFit, Float64 | None]:
    """Tiles as if all were on one paint, their fit, and B; as they are, with None, where paint makes no difference.

    Paint and responses are found in turns: a colour that depends on the paint looks like another response.
    """
    left, fit, paint = tiles, alone, np.zeros((3, 3, 3))
    residual = _residual(tiles.at(fit.strength), fit)
    for _ in range(PAINT_ROUNDS):
        steady = tiles.at(fit.strength)
        shown = _shown(steady, fit)
        around = fit.stray * (fit.mixing @ shown.mean(axis=0))
        own = dataclasses.replace(steady, ratio=(steady.ratio - around) / (1 - fit.stray))
        paint = fit_paint_mixing(own, shown, tiles.weight * _kept(residual), fit.mixing)
        residual = own.ratio - paint_light(own, shown, paint)
        if _scatter(residual) > PROMISING * alone.scatter:
            return tiles, alone, None
        more = (1 - fit.stray) * (own.ratio - residual - shown @ fit.mixing.T)
        left = dataclasses.replace(tiles, ratio=tiles.ratio - more * fit.strength[tiles.photograph][:, None])
        fit = fit_tiles(left, with_segment=alone.segment > 0)
    if fit.scatter >= BETTER_BY_PAINT * alone.scatter:
        return tiles, alone, None
    return left, fit, paint


def evened(tiles: TileMeasurements, fit: RadiometryFit) -> RadiometryFit:
    """The fit, and what is uneven in the known indirect light, found in turns."""
    # as if the lamp were steady, so that a flicker is nothing that neighbours share
    first, additivity, steady = fit.strength, fit.additivity, tiles.at(fit.strength)
    weight = own_weight(tiles)
    uneven, change = np.zeros_like(tiles.ratio), np.ones_like(first)
    for _ in range(UNEVEN_ROUNDS):
        residual = _residual(steady.at(change), fit)
        uneven = uneven_light(tiles, residual, weight * _kept(residual - uneven))
        left = dataclasses.replace(steady, ratio=steady.ratio - uneven, weight=weight)
        fit = fit_tiles(left, with_segment=fit.segment > 0)
        change = fit.strength
    fit.strength, fit.additivity = first * change, additivity
    return fit


def fit_tiles(tiles: TileMeasurements, *, with_segment: bool = False) -> RadiometryFit:
    """Mixing with the responses held, responses with the mixing held, new weights, until nothing changes."""
    x = np.arange(256) / 255
    gamma = np.full(3, FIRST_GAMMA)
    even = np.ones(int(tiles.photograph.max()) + 1)
    first = np.stack([x**FIRST_GAMMA] * 3)
    fit = RadiometryFit(first, np.eye(3), np.zeros(3), even, np.zeros_like(tiles.ratio))
    weight, steady = tiles.weight.copy(), tiles
    for number in range(ROUNDS):
        before = fit.response.copy()
        rough = number < ROUGH_ROUNDS
        if with_segment:
            _fit_segment(steady, weight, fit)
        _fit_mixing(steady, weight, fit, with_stray=not rough)
        _fit_responses(steady, weight, gamma, fit)
        if rough:
            gamma = _gamma_of(fit.response)
            continue
        # while indirect light is not known, tiles with much of it are not worse than others
        _fit_strength(steady, weight if tiles.indirect.any() else tiles.weight, fit, with_segment=with_segment)
        steady = tiles.at(fit.strength)
        weight = tiles.weight * _kept(_residual(steady, fit))
        if np.max(np.abs(fit.response - before)) < CONVERGED:
            break
    fit.residual = _residual(steady, fit)
    # white itself takes no part in this: what the tiles say that white should be
    white = fit.mixing @ _solve(steady, weight, gamma, fit, white_known=False)[:, -1]
    fit.additivity = float(np.max(np.abs(fit.strength.mean() * white - 1)))
    return fit


def _fit_strength(tiles: TileMeasurements, weight: Float64, fit: RadiometryFit, *, with_segment: bool) -> None:
    """The lamp's strength in each photograph: against the others by all tiles, against white by full channels.

    Where a channel is full its light is known, whatever the response is; below, a stronger lamp looks like another
    response. Tiles of no ``weight`` (tiles, 3) do not fit, and would tell another lamp.

    A white segment takes light from full channels, too, so ``with_segment`` their light is not known: a weaker lamp
    looks like a smaller segment. Then the photographs are as strong as white on the mean.
    """
    fitted = tiles.ratio - _residual(tiles, fit)
    against = np.sum(weight * fitted * tiles.ratio, axis=1), np.sum(weight * fitted**2, axis=1)
    light, known = (np.bincount(tiles.photograph, one, len(fit.strength)) for one in against)
    each = np.divide(light, known, out=np.ones_like(light), where=known > 0)
    strength = fit.strength * (each / each.mean())
    if with_segment:
        fit.strength = np.clip(strength / strength.mean(), 1 - MOST_FLICKER, 1 + MOST_FLICKER)
        return
    full = (tiles.levels == 255) @ fit.mixing.T * (1 - fit.stray)
    some = np.flatnonzero((weight * full).sum(axis=1) > 0)
    if some.size < FEWEST_FULL:
        return
    each_full = weight[some] * full[some]
    found = 1 + np.sum(each_full * (tiles.ratio - fitted)[some], axis=1) / np.sum(each_full * full[some], axis=1)
    fit.strength = np.clip(strength * np.median(found), 1 - MOST_FLICKER, 1 + MOST_FLICKER)


def _channels(tiles: TileMeasurements, response: Float64) -> Float64:
    """(tiles, 3) each projector channel's own light of each tile's levels."""
    return np.stack([response[channel][tiles.levels[:, channel]] for channel in range(3)], axis=1)


def _shown(tiles: TileMeasurements, fit: RadiometryFit) -> Float64:
    """(tiles, 3) light of each tile per projector channel, with what a white segment adds."""
    return Radiometry(fit.response, fit.mixing, fit.segment).emitted(_channels(tiles, fit.response))


def _fit_segment(tiles: TileMeasurements, weight: Float64, fit: RadiometryFit) -> None:
    """The share of white that is not the sum of three colours: of what a tile's channels have in common."""
    own = _channels(tiles, fit.response)
    common = own.min(axis=1, keepdims=True) - own @ fit.mixing.T
    around = (fit.mixing @ _shown(tiles, fit).mean(axis=0)) * fit.stray
    off = (tiles.ratio - around) / (1 - fit.stray) - own @ fit.mixing.T
    segment = float(np.sum(weight * common * off) / np.sum(weight * common**2))
    fit.segment = float(np.clip(segment, 0.0, MOST_SEGMENT))


def _fit_mixing(tiles: TileMeasurements, weight: Float64, fit: RadiometryFit, *, with_stray: bool) -> None:
    """Per camera channel: ratio = (1 - e) m . r + e mean(m . r), the three of m adding up to 1."""
    shown = _shown(tiles, fit)
    mean = shown.mean(axis=0)
    for channel in range(3):
        root = np.sqrt(weight[:, channel])
        seen = tiles.ratio[:, channel]
        around = float(fit.mixing[channel] @ mean)
        direct = (seen - fit.stray[channel] * around) / (1 - fit.stray[channel])
        # the third share is what the two others leave
        equations = (shown[:, :2] - shown[:, 2:]) * root[:, None]
        shares = np.linalg.lstsq(equations, (direct - shown[:, 2]) * root, rcond=None)[0]
        fit.mixing[channel] = [*shares, 1 - shares.sum()]
        own = shown @ fit.mixing[channel]
        towards = around - own
        stray = np.sum(weight[:, channel] * towards * (seen - own)) / np.sum(weight[:, channel] * towards**2)
        fit.stray[channel] = np.clip(stray, 0.0, MOST_STRAY) if with_stray else 0.0
    if not np.all(np.isfinite(fit.mixing)) or abs(np.linalg.det(fit.mixing)) < LEAST_INDEPENDENCE:
        raise CalibrationError(
            "colours-alike",
            what="The camera can't separate the projector's red, green and blue.",
            remedy="Check the colour modes of camera and projector, and that the picture of every colour was shown.",
        )


def _fit_responses(tiles: TileMeasurements, weight: Float64, gamma: Float64, fit: RadiometryFit) -> None:
    curves = _solve(tiles, weight, gamma, fit, white_known=True)
    fit.fall = float(np.max(np.maximum.accumulate(curves, axis=1) - curves))
    fit.response = np.stack([rising(curve) for curve in curves])


def _residual(tiles: TileMeasurements, fit: RadiometryFit) -> Float64:
    shown = _shown(tiles, fit)
    own = shown @ fit.mixing.T
    return np.asarray(tiles.ratio - (own + fit.stray * (fit.mixing @ shown.mean(axis=0) - own)), np.float64)


def _solve(
    tiles: TileMeasurements, weight: Float64, gamma: Float64, fit: RadiometryFit, *, white_known: bool
) -> Float64:
    """(3, 256): all three curves at once, splines over a power of the device value.

    They are 0 at black, and 1 at white if ``white_known``.
    """
    bases = [_basis(power) for power in gamma]
    at_levels = [basis[tiles.levels[:, primary]] for primary, basis in enumerate(bases)]
    last = KNOTS - 1 if white_known else KNOTS
    fixed = np.zeros(KNOTS)
    fixed[-1] = float(white_known)
    around = fit.mixing @ _shown(tiles, fit).mean(axis=0)
    equations, values = [], []
    least = _channels(tiles, fit.response).argmin(axis=1)
    for channel in range(3):
        root = np.sqrt(weight[:, channel])
        direct = (tiles.ratio[:, channel] - fit.stray[channel] * around[channel]) / (1 - fit.stray[channel])
        parts = []
        for primary, rows in enumerate(at_levels):
            share = (1 - fit.segment) * fit.mixing[channel, primary] + fit.segment * (least == primary)
            direct = direct - share * rows[:, -1] * fixed[-1]
            parts.append(rows[:, 1:last] * (share * root)[:, None])
        equations.append(np.concatenate(parts, axis=1))
        values.append(direct * root)
    # where no tile shows a level, the curve is as straight as it can be over that power
    bend = np.diff(np.eye(KNOTS), 2, axis=0) * np.sqrt(STIFFNESS * weight.sum())
    for primary in range(3):
        rows = np.zeros((len(bend), 3 * (last - 1)))
        rows[:, primary * (last - 1) : (primary + 1) * (last - 1)] = bend[:, 1:last]
        equations.append(rows)
        values.append(-bend @ fixed)
    every, wanted = np.concatenate(equations), np.concatenate(values)
    solved = np.linalg.solve(every.T @ every, every.T @ wanted).reshape(3, last - 1)
    knots = np.tile(fixed, (3, 1))
    knots[:, 1:last] = solved
    return np.stack([basis @ own for basis, own in zip(bases, knots, strict=True)])


@functools.lru_cache(maxsize=16)
def _basis(power: float) -> Float64:
    """(256, KNOTS), not to be changed: the natural cubic spline through knots equally far apart in x^power."""
    from scipy.interpolate import CubicSpline

    at = (np.arange(256) / 255) ** power
    return np.asarray(CubicSpline(np.linspace(0, 1, KNOTS), np.eye(KNOTS), bc_type="natural")(at), np.float64)


def _gamma_of(response: Float64) -> Float64:
    """The power that each response is nearest to."""
    x = np.arange(256) / 255
    gamma = np.full(3, FIRST_GAMMA)
    for channel, curve in enumerate(response):
        middle = (curve > 0.02) & (curve < 0.98)
        if middle.any():
            gamma[channel] = np.clip(np.median(np.log(curve[middle]) / np.log(x[middle])), 0.5, 4)
    return gamma


def _scatter(residual: Float64) -> float:
    """Standard deviation, by the median of the deviations."""
    return float(1.4826 * np.median(np.abs(residual)))


def _kept(residual: Float64) -> Float64:
    """Tukey's weights: 1 where a tile fits, 0 where it is off by several times the usual."""
    scale = OUTLIER * 1.4826 * np.median(np.abs(residual), axis=0) + 1e-6
    return np.asarray(np.clip(1 - (residual / (1.6 * scale)) ** 2, 0, None) ** 2)


def rising(values: Float64) -> Float64:
    """The closest sequence that never falls, from 0 to 1."""
    from scipy.optimize import isotonic_regression

    pooled = np.asarray(isotonic_regression(np.clip(values, 0, 1)).x, np.float64)
    pooled[0], pooled[-1] = 0.0, 1.0
    return np.round(pooled, 12)
