"""The response of a camera that delivers JPEG only: one monotone curve a channel, all three from one system.

After Debevec and Malik (1997), with four differences: every pixel takes part, through a table of how often two values
meet at one pixel; the curve's steps are the unknowns and are kept from falling; the channels are pulled towards each
other, since a camera has one tone curve, so that their scales agree where one of them saw no light; and the value that
stands for no light (lifted blacks, the fog of a scanned film) is measured, since no logarithm explains a value that
stays the same however long the exposure.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from controller.core.arrays import Float64
from controller.core.errors import CalibrationError, UsageError

VALUES = 256
DARKEST, BRIGHTEST = 3, 252
"""Range of the values that are used: below it, noise and rounding dominate; above it, clipping."""
UNLIT_RATIO = 8.0
UNLIT_STEPS = 2
UNLIT_BELOW = 64
"""A pixel that differs by no more than these steps at this ratio of exposures saw no light: any tone curve would have
doubled its height above black. Bright values are no black, even where a curve ends flat."""
UNLIT_PERCENTILE = 98
"""Of the values of unlit pixels: up to this percentile they are noise."""
SMOOTHNESS = 0.1
CHANNEL_COUPLING = 0.02
SMALLEST_STEP = 1e-4
"""Of the logarithm of light between neighbouring values."""
MIN_PAIRS = 2000
FEWEST_VALUES = 48
WORST_MISFIT = 0.25

Bytes = npt.NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class JpegResponse:
    """``table`` (3, 256): linear light of each value, 0 up to the channel's black, then rising, 1 at 255.

    ``misfit`` weighted rms of the logarithm of exposure ratios, after the fit; ``seen`` share of the values that met;
    ``black`` (red, green, blue): the value that stands for no light, 0 where none above the noise was seen
    """

    table: Float64
    misfit: float
    seen: float
    black: tuple[int, int, int]


@dataclass(frozen=True, slots=True)
class _BlackLevel:
    """``value`` that stands for no light; from ``first`` on, values are above its noise."""

    value: int = 0
    first: int = DARKEST


def nominal_response() -> Float64:
    """(3, 256) of a JPEG that follows IEC 61966-2-1 (sRGB) to the letter: for choosing exposures before measuring."""
    value = np.arange(VALUES) / (VALUES - 1)
    light = np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)
    return np.tile(light, (3, 1))


def measure_response(images: Sequence[Bytes], exposures_s: Sequence[float]) -> JpegResponse:
    """The response from a bracket series of one still scene.

    Parameters
    ----------
    images : (rows, columns, 3) uint8, two at least, a stop or two apart, together dark to clipped
    exposures_s : of each, > 0

    Raises
    ------
    UsageError("bracket-mismatch")
    CalibrationError("response-unseen")  too few values of some channel occur unclipped in two exposures
    CalibrationError("response-inconsistent")  no curve explains the photographs: something moved or flickered
    """
    if len(images) < 2 or len(images) != len(exposures_s) or min(exposures_s, default=0) <= 0:
        raise UsageError(
            "bracket-mismatch",
            what="A camera's response needs at least two photographs, each with its exposure time.",
            remedy="Give one exposure time in seconds for each photograph.",
        )
    order = np.argsort(exposures_s)
    pairs = [(images[a], images[b], exposures_s[b] / exposures_s[a]) for a, b in itertools.pairwise(order)]
    blacks = _blacks([images[k] for k in order], [exposures_s[k] for k in order])
    meetings = [
        [(_joint_histogram(x[..., c], y[..., c], black.first), float(np.log(r))) for x, y, r in pairs]
        for c, black in enumerate(blacks)
    ]
    seen = [_coverage(of_channel) for of_channel in meetings]
    if min(seen) * VALUES < FEWEST_VALUES:
        raise CalibrationError(
            "response-unseen",
            what="The bracket series shows too few brightness levels to measure the camera's response.",
            remedy="Photograph bright and dark parts at exposures one stop apart, or set the camera to RAW.",
        )
    curves = _solve(meetings, [_base(black.value) for black in blacks])
    misfit = _misfit(curves, meetings)
    if misfit > WORST_MISFIT:
        raise CalibrationError(
            "response-inconsistent",
            what="No camera response explains the bracket series.",
            remedy="Set the camera to manual exposure and white balance, keep the scene still, and repeat the series.",
        )
    table = np.stack([_table(curve, black) for curve, black in zip(curves, blacks, strict=True)])
    return JpegResponse(table, misfit, min(seen), (blacks[0].value, blacks[1].value, blacks[2].value))


def _blacks(images: Sequence[Bytes], exposures_s: Sequence[float]) -> list[_BlackLevel]:
    """Of each channel, from the pixels whose value stays the same at ``UNLIT_RATIO`` times the exposure.

    ``images`` from the shortest exposure to the longest. Black is 0 where too few pixels are without light, and where
    their values come close to 0 and the camera has cut off its noise there.
    """
    counts = np.zeros((3, UNLIT_BELOW + UNLIT_STEPS), np.int64)
    for a, shorter in enumerate(images):
        b = next((b for b, s in enumerate(exposures_s) if s >= UNLIT_RATIO * exposures_s[a] * 0.999), None)
        if b is None:
            break
        for c in range(3):
            short, long = shorter[..., c].astype(np.int16), images[b][..., c].astype(np.int16)
            unlit = (short < UNLIT_BELOW) & (np.abs(long - short) <= UNLIT_STEPS)
            for values in (short[unlit], long[unlit]):
                counts[c] += np.bincount(values, minlength=counts.shape[1])
    return [_black(of_channel) for of_channel in counts]


def _black(counts: npt.NDArray[np.int64]) -> _BlackLevel:
    share = np.cumsum(counts) / max(int(counts.sum()), 1)
    if counts.sum() < 2 * MIN_PAIRS or share[DARKEST] > 1 - UNLIT_PERCENTILE / 100:
        return _BlackLevel()
    noisy = int(np.searchsorted(share, UNLIT_PERCENTILE / 100))
    value = int(np.searchsorted(share, 0.5))
    return _BlackLevel(value, max(noisy, value + UNLIT_STEPS) + 1)


def _joint_histogram(shorter: Bytes, longer: Bytes, first: int) -> Float64:
    """(256, 256): how often a value of the shorter exposure meets one of the longer at a pixel; clipped ones out.

    Values below ``first`` are out too: they say more of noise than of light.

    A value far from the typical partner of its row was moved there by an edge or by the compression; the count of each
    row is capped, so that a large background does not outweigh everything else.
    """
    both = shorter.astype(np.int64) * VALUES + longer
    table = np.bincount(both.ravel(), minlength=VALUES * VALUES).reshape(VALUES, VALUES).astype(np.float64)
    inside = np.zeros((VALUES, VALUES), np.bool_)
    inside[first : BRIGHTEST + 1, first : BRIGHTEST + 1] = True
    table *= inside
    cap = max(4 * float(table.sum()) / VALUES, 1.0)
    for axis in (0, 1):
        table *= np.minimum(1.0, cap / np.maximum(table.sum(axis=axis, keepdims=True), 1.0))
    return table


def _coverage(meetings: Sequence[tuple[Float64, float]]) -> float:
    total = np.sum([table for table, _ in meetings], axis=0)
    met = total.sum(axis=0) + total.sum(axis=1) >= MIN_PAIRS / VALUES
    return float(np.count_nonzero(met)) / VALUES


def _base(black: int) -> Float64:
    """Logarithm of the light that sRGB gives each value above black: what the true curve differs from smoothly."""
    height = np.maximum(np.arange(VALUES) - black, 0) * (VALUES - 1) / (VALUES - 1 - black)
    light = np.interp(height, np.arange(VALUES), nominal_response()[0])
    light[: black + 1] = light[black + 1] / 2 * np.exp(SMALLEST_STEP * (np.arange(black + 1) - black))
    return np.asarray(np.log(light), np.float64)


def _weight() -> Float64:
    """Trust in a value (Debevec's hat, broadened): least near black and near clipping."""
    value = np.arange(VALUES)
    return np.minimum(1.0, np.minimum(value + 1, VALUES - value) / 64.0)


def _solve(meetings: Sequence[Sequence[tuple[Float64, float]]], bases: Sequence[Float64]) -> list[Float64]:
    """Logarithm of light at each value, one curve a channel, 0 at 255: non-negative least squares on the steps."""
    from scipy.linalg import solve_triangular
    from scipy.optimize import nnls

    steps = VALUES - 1
    # g = -(sum of the steps above a value), so that g(255) = 0
    to_curve = -np.triu(np.ones((VALUES, steps)))
    bend = np.diff(np.eye(VALUES), 2, axis=0) * (VALUES / 4)
    normal, right = np.zeros((3 * steps, 3 * steps)), np.zeros(3 * steps)
    for channel, of_channel in enumerate(meetings):
        total = sum(float(table.sum()) for table, _ in of_channel)
        laplacian, wanted = np.zeros((VALUES, VALUES)), np.zeros(VALUES)
        for table, log_ratio in of_channel:
            weights = table * _weight()[:, None] * _weight()[None, :] / total * VALUES
            laplacian += np.diag(weights.sum(axis=0) + weights.sum(axis=1)) - weights - weights.T
            # g(longer) - g(shorter) = log of the ratio of exposures
            wanted += log_ratio * (weights.sum(axis=0) - weights.sum(axis=1))
        smooth = SMOOTHNESS * bend.T @ bend
        laplacian += smooth
        wanted += smooth @ bases[channel]
        part = slice(channel * steps, (channel + 1) * steps)
        normal[part, part] += to_curve.T @ laplacian @ to_curve
        right[part] += to_curve.T @ wanted
    _couple_channels(normal, right, np.diff(bases, axis=1))
    factor = np.linalg.cholesky(normal + 1e-9 * np.trace(normal) / len(normal) * np.eye(len(normal)))
    shifted = right - normal @ np.full(3 * steps, SMALLEST_STEP)
    solution, _ = nnls(factor.T, solve_triangular(factor, shifted, lower=True), maxiter=30 * steps)
    return [to_curve @ (solution[c * steps : (c + 1) * steps] + SMALLEST_STEP) for c in range(3)]


def _couple_channels(normal: Float64, right: Float64, base_steps: Float64) -> None:
    """Steps that differ equally from their bases, softly: what one channel did not see, it takes from the others."""
    # A step near black is large; its weight falls accordingly, or black would decide over everything. Below black the
    # base hardly rises; there the weight is that of black.
    size, steps = np.maximum.accumulate(base_steps.max(axis=0)[::-1])[::-1], base_steps.shape[1]
    pull = CHANNEL_COUPLING * (1 / size) ** 2 / np.mean((1 / size) ** 2) * VALUES
    for a, b in itertools.combinations(range(3), 2):
        for c, d, sign in ((a, a, 1.0), (b, b, 1.0), (a, b, -1.0), (b, a, -1.0)):
            rows, columns = np.arange(steps) + c * steps, np.arange(steps) + d * steps
            normal[rows, columns] += sign * pull
            right[rows] += sign * pull * base_steps[d]


def _misfit(curves: Sequence[Float64], meetings: Sequence[Sequence[tuple[Float64, float]]]) -> float:
    squares, weights = 0.0, 0.0
    trust = _weight()[:, None] * _weight()[None, :]
    for curve, of_channel in zip(curves, meetings, strict=True):
        for table, log_ratio in of_channel:
            left = curve[None, :] - curve[:, None] - log_ratio
            squares += float(np.sum(table * trust * left**2))
            weights += float(np.sum(table * trust))
    return float(np.sqrt(squares / weights))


def _table(curve: Float64, black: _BlackLevel) -> Float64:
    """Light of each value; towards black, where values are rounded to nothing, in a straight line."""
    light = np.exp(curve)
    height = np.maximum(np.arange(black.first + 1) - black.value, 0)
    light[: black.first + 1] = light[black.first] * height / (black.first - black.value)
    return np.asarray(light / light[-1], np.float64)
