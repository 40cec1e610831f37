"""A projector's response and colour mixing from colour tiles (idea of Raij 2003), and whether the camera is linear.

Every tile of a mosaic shows a triple of device values of its own, so that two photographs hold some hundreds to
thousands of measurements: M r(levels), with M the mixing and r the three responses, divided by white. Both are fitted
together, each with the other held, until neither changes; tiles that do not fit are left out.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from controller.calibrate.correspondence.captures import Captures, coloured
from controller.calibrate.photometry.colour_tiles import KnownIndirect, TileMeasurements, measure_tiles
from controller.calibrate.values import Radiometry
from controller.capture.patterns import PatternPlan
from controller.core.arrays import Float64
from controller.core.errors import CalibrationError

FEWEST_TILES = 60
FEWEST_PIXELS = 50
KNOTS = 16
FIRST_GAMMA = 2.2
ROUNDS = 40
ROUGH_ROUNDS = 5
"""Rounds in which no tile is left out and no stray light is assumed yet."""
CONVERGED = 1e-5
OUTLIER = 3.0
WORST_SCATTER = 0.05
WORST_ADDITIVITY = 0.08
LEAST_INDEPENDENCE = 0.01
MOST_STRAY = 0.3
STIFFNESS = 1e-3
WORST_FALL = 0.03


@dataclass(frozen=True, slots=True)
class RadiometryReport:
    """What the measurement was worth.

    ``pixels`` camera pixels used; ``tiles`` that were measured, of all patterns together; ``scatter`` median absolute
    deviation of the tiles from the fit, of full scale; ``stray`` share of a tile's white that comes from other tiles;
    ``additivity`` largest relative difference between white and what the tiles say of it, over the camera's channels
    """

    pixels: int
    tiles: int
    scatter: float
    stray: float
    additivity: float


def measure_radiometry(
    captures: Captures, plan: PatternPlan, *, indirect: KnownIndirect | None = None
) -> tuple[Radiometry, RadiometryReport]:
    """Response and mixing of one projector.

    Parameters
    ----------
    captures : linear RGB photographs in one unit: ``black white``, ``gray-*`` and ``mosaic-*``; NaN where saturated
    indirect : what is known of it by an earlier measurement; the response is then fitted to direct light alone

    Returns
    -------
    the radiometry, and a report on the measurement

    Raises
    ------
    CalibrationError("capture-missing"), CalibrationError("capture-shape-wrong")
    CalibrationError("projector-dark")  too few colour tiles are seen
    CalibrationError("colours-do-not-add")  the tiles do not follow from three responses and a mixing
    CalibrationError("colours-alike")  the primaries can't be separated
    """
    black = coloured(captures, "black")
    white = coloured(captures, "white", black.shape[:2]) - black
    tiles = measure_tiles(captures, plan, black, white, indirect=indirect)
    if tiles.ratio.shape[0] < FEWEST_TILES:
        raise CalibrationError(
            "projector-dark",
            what=f"The camera sees only {tiles.ratio.shape[0]} lit colour tiles of this projector.",
            remedy="Check that its lamp is lit, its shutter open and its picture on the object, then calibrate again.",
        )
    fit = _fit(tiles)
    scatter = float(1.4826 * np.median(np.abs(fit.residual)))
    if scatter > WORST_SCATTER or fit.fall > WORST_FALL or fit.additivity > WORST_ADDITIVITY:
        raise CalibrationError(
            "colours-do-not-add",
            what=f"The projector's colours are not additive: tiles differ by {100 * scatter:.0f} % from the sum of "
            f"three responses, white by {100 * fit.additivity:.0f} %.",
            remedy="Switch off the projector's brilliant-colour, white-boost and dynamic modes. Then calibrate again.",
        )
    stray = float(fit.stray.mean())
    report = RadiometryReport(tiles.pixels, tiles.ratio.shape[0], scatter, stray, fit.additivity)
    return Radiometry(fit.response, fit.mixing), report


@dataclass(slots=True)
class _RadiometryFit:
    """``response`` (3, 256), ``mixing`` (3, 3), ``stray`` (3,), ``residual`` (tiles, 3); ``fall``: how far r fell."""

    response: Float64
    mixing: Float64
    stray: Float64
    residual: Float64
    fall: float = 0.0
    additivity: float = 0.0


def _fit(tiles: TileMeasurements) -> _RadiometryFit:
    """Mixing with the responses held, responses with the mixing held, new weights, until nothing changes."""
    x = np.arange(256) / 255
    gamma = np.full(3, FIRST_GAMMA)
    fit = _RadiometryFit(np.stack([x**FIRST_GAMMA] * 3), np.eye(3), np.zeros(3), np.zeros_like(tiles.ratio))
    weight = tiles.weight.copy()
    for number in range(ROUNDS):
        before = fit.response.copy()
        rough = number < ROUGH_ROUNDS
        _fit_mixing(tiles, weight, fit, with_stray=not rough)
        _fit_responses(tiles, weight, gamma, fit)
        if rough:
            gamma = _gamma_of(fit.response)
            continue
        weight = tiles.weight * _kept(fit.residual)
        if np.max(np.abs(fit.response - before)) < CONVERGED:
            break
    # white itself takes no part in this: what the tiles say that white should be
    white = _solve(tiles, weight, gamma, fit, white_known=False)[:, -1]
    fit.additivity = float(np.max(np.abs(fit.mixing @ white - 1)))
    return fit


def _shown(tiles: TileMeasurements, response: Float64) -> Float64:
    """(tiles, 3) light of each tile's levels per projector channel."""
    return np.stack([response[channel][tiles.levels[:, channel]] for channel in range(3)], axis=1)


def _fit_mixing(tiles: TileMeasurements, weight: Float64, fit: _RadiometryFit, *, with_stray: bool) -> None:
    """Per camera channel: ratio = (1 - e) m . r + e mean(m . r), the three of m adding up to 1."""
    shown = _shown(tiles, fit.response)
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


def _fit_responses(tiles: TileMeasurements, weight: Float64, gamma: Float64, fit: _RadiometryFit) -> None:
    around = fit.mixing @ _shown(tiles, fit.response).mean(axis=0)
    curves = _solve(tiles, weight, gamma, fit, white_known=True)
    fit.fall = float(np.max(np.maximum.accumulate(curves, axis=1) - curves))
    fit.response = np.stack([_rising(curve) for curve in curves])
    own = _shown(tiles, fit.response) @ fit.mixing.T
    fit.residual = tiles.ratio - (own + fit.stray * (around - own))


def _solve(
    tiles: TileMeasurements, weight: Float64, gamma: Float64, fit: _RadiometryFit, *, white_known: bool
) -> Float64:
    """(3, 256): all three curves at once, splines over a power of the device value.

    They are 0 at black, and 1 at white if ``white_known``.
    """
    bases = [_basis(power) for power in gamma]
    last = KNOTS - 1 if white_known else KNOTS
    fixed = np.zeros(KNOTS)
    fixed[-1] = float(white_known)
    around = fit.mixing @ _shown(tiles, fit.response).mean(axis=0)
    equations, values = [], []
    for channel in range(3):
        root = np.sqrt(weight[:, channel])
        direct = (tiles.ratio[:, channel] - fit.stray[channel] * around[channel]) / (1 - fit.stray[channel])
        parts = []
        for primary, basis in enumerate(bases):
            rows = basis[tiles.levels[:, primary]] * fit.mixing[channel, primary]
            direct = direct - rows @ fixed
            parts.append(rows[:, 1:last])
        equations.append(np.concatenate(parts, axis=1) * root[:, None])
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


def _basis(power: float) -> Float64:
    """(256, KNOTS): the natural cubic spline through values at knots equally far apart in x^power."""
    from scipy.interpolate import CubicSpline

    at = (np.arange(256) / 255) ** power
    return np.asarray(CubicSpline(np.linspace(0, 1, KNOTS), np.eye(KNOTS), bc_type="natural")(at), np.float64)


def _gamma_of(response: Float64) -> Float64:
    """The power that each response is nearest to."""
    x = np.arange(256) / 255
    found = np.full(3, FIRST_GAMMA)
    for channel, curve in enumerate(response):
        middle = (curve > 0.02) & (curve < 0.98)
        if middle.any():
            found[channel] = np.clip(np.median(np.log(curve[middle]) / np.log(x[middle])), 0.5, 4)
    return found


def _kept(residual: Float64) -> Float64:
    """Tukey's weights: 1 where a tile fits, 0 where it is off by several times the usual."""
    scale = OUTLIER * 1.4826 * np.median(np.abs(residual), axis=0) + 1e-6
    return np.asarray(np.clip(1 - (residual / (1.6 * scale)) ** 2, 0, None) ** 2)


def _rising(values: Float64) -> Float64:
    """Pool adjacent violators: the closest sequence that never falls, from 0 to 1."""
    groups: list[tuple[float, int]] = []
    for value in np.clip(values, 0, 1):
        mean, size = float(value), 1
        while groups and groups[-1][0] > mean:
            below, count = groups.pop()
            mean, size = (mean * size + below * count) / (size + count), size + count
        groups.append((mean, size))
    pooled = np.concatenate([np.full(size, mean) for mean, size in groups])
    pooled[0], pooled[-1] = 0.0, 1.0
    return np.round(pooled, 12)
