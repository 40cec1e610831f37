"""Whether a projector's red, green and blue pictures lie on each other: by the phases of the fine sinusoids.

The camera's channels see mixtures of the three, so they are separated first. Distortion and colour fringes of the
camera move all three alike, or outwards in all directions, and do not change a median. How far medians of parts of the
picture differ says how sure the whole picture's is.

A colour that lies farther out the farther from the middle has a larger picture (lateral chromatic aberration). The
lens of the projector does that, and the lens of the camera just so, because it sees red light as red: which of the two
it is, these photographs do not tell.

The camera sees a grey sinusoid as the sum of three, one of each colour of the projector, as strong as the paint throws
it back. Where the colours lie apart, its place is a mean of theirs, and they cancel each other in part. Both follow
from the white image and are taken back, so that places are those of green everywhere (docs/decisions/0006).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final, Self

import numpy as np
import numpy.typing as npt

from controller.core import channels
from controller.core.arrays import Float64, FloatImage, strips
from controller.core.channels import every, finite, smallest
from controller.optics.calibrate.correspondence.captures import Captures, coloured
from controller.optics.calibrate.correspondence.phase_shift import FRINGE_PX
from controller.optics.capture.patterns import PatternPlan


@dataclass(frozen=True, slots=True, eq=False)
class ColourPlaces:
    """A projector's colours in the pictures of a camera whose channels were added up.

    ``shifts_px`` (3, 2): see ``colour_alignment.ColourShifts``; ``mixing`` (3, 3): see ``Radiometry``
    ``white`` (camera rows, columns, 3), less black, NaN where not known
    ``typical`` (3,): part of the whole white image's light that is the projector's red, green and blue
    """

    shifts_px: Float64
    white: FloatImage
    mixing: FloatImage
    typical: FloatImage

    @classmethod
    def of(cls, shifts_px: Float64, white: FloatImage, mixing: Float64) -> Self:
        """From a white image (rows, columns, 3), less black, NaN where not known, and (3, 3) colour mixing."""
        plain = mixing.astype(np.float32)
        parts = (np.nansum(white[rows], axis=(0, 1), dtype=np.float64) for rows in strips(len(white)))
        light = np.sum(list(parts), axis=0) @ mixing
        typical = light / light.sum() if light.sum() > 0 else np.full(3, 1 / 3)
        return cls(np.asarray(shifts_px, np.float64), white, plain, typical.astype(np.float32))

    def shares(self) -> Iterator[tuple[slice, FloatImage]]:
        """Rows, and (those rows, columns, 3) the parts of white's light that are red, green and blue there.

        Where white is not known or dark, they are ``typical``. They are worked out again where they are needed: kept,
        those of a large camera would fill its memory.
        """
        for rows in strips(len(self.white)):
            light = np.asarray(self.white[rows] @ self.mixing, np.float32)
            total = channels.total(light)
            known = np.isfinite(total) & (total > 0)
            with np.errstate(invalid="ignore", divide="ignore"):
                light /= total[..., None]
            light[~known] = self.typical
            yield rows, light

    def to_green_px(self) -> FloatImage:
        """(rows, columns, 2): what the place of a fine grey sinusoid lacks to be that of green."""
        offset_px = np.empty((*self.white.shape[:2], 2), np.float32)
        waves = np.exp(2j * np.pi / FRINGE_PX * self.shifts_px).astype(np.complex64)
        for rows, share in self.shares():
            offset_px[rows] = np.angle(share @ waves) * np.float32(FRINGE_PX / (2 * np.pi))
        return offset_px

    def contrast(self, frequency: tuple[float, float]) -> FloatImage:
        """(rows, columns): what is left of a grey sinusoid's contrast at green's phase; cycles a projector pixel."""
        contrasts = np.empty(self.white.shape[:2], np.float32)
        waves = np.cos(2 * np.pi * self.shifts_px @ np.array(frequency)).astype(np.float32)
        for rows, share in self.shares():
            contrasts[rows] = share @ waves
        return contrasts


FINE: Final = ("blur-x", "blur-y")
LEAST_CONTRAST: Final = 0.25
FAINTEST: Final = 0.02
"""Of the 99th percentile of white."""
FEWEST_PIXELS: Final = 500
SOME_PIXELS: Final = 200_000
NAMED_PX: Final = 0.1
"""A colour that lies so many pixels beside green, also at the picture's edge alone, is named; it is measured to a
hundredth."""
COLOURS: Final = ("red", "green", "blue")
PARTS: Final = 16
LEAST_PX: Final = 0.02
"""Smaller shifts are not corrected: a place is not known better."""
MOST_PX: Final = 1.5
"""Phases repeat after 5 px: a larger shift might as well be one of 3.5 px the other way."""
SURE: Final = 4.0
"""Standard errors that a shift needs to be corrected, and a size to be named."""
OUTLIER: Final = 3.0
ROUNDS: Final = 6


@dataclass(frozen=True, slots=True, eq=False)
class ColourShifts:
    """``px`` (3, 2): by how many projector pixels red, green and blue lie to the right of green, and below it.

    ``error_px`` (3, 2): the standard error of each; both NaN where too little was seen
    """

    px: Float64
    error_px: Float64

    @property
    def sure_px(self) -> Float64 | None:
        """(3, 2): what to correct, 0 where nothing was seen; None where nothing is beyond doubt, or too much."""
        if np.nanmax(np.abs(self.px), initial=0) > MOST_PX:
            return None
        sure = np.abs(self.px) > np.maximum(SURE * self.error_px, LEAST_PX)
        return np.nan_to_num(self.px) if sure.any() else None


@dataclass(frozen=True, slots=True, eq=False)
class ColoursApart:
    """How far the colours lie apart at some camera pixels.

    ``at`` (some,) their flat numbers; ``px`` (2, some, 3): by how many projector pixels each colour lies beside green,
    along x and y; NaN where a colour shows too little contrast
    """

    at: npt.NDArray[np.int64]
    px: Float64


def colours_apart(captures: Captures, plan: PatternPlan, white: FloatImage, mixing: Float64) -> ColoursApart:
    """Measure where the colours of a projector lie.

    Parameters
    ----------
    captures : linear photographs in one unit; needs ``black``, ``blur-x-*`` and ``blur-y-*``
    white : (rows, columns, 3) less the black image, NaN where not known
    mixing : (3, 3) camera channel by projector channel, rows adding up to 1

    Raises CalibrationError as ``coloured``.
    """
    light = smallest(white)
    at = np.flatnonzero(light > FAINTEST * np.nanpercentile(light, 99))
    at = at[:: max(1, at.size // SOME_PIXELS)]
    black, own_white = (image.reshape(-1, 3)[at] for image in (coloured(captures, "black", white.shape[:2]), white))
    apart_px = np.full((2, at.size, 3), np.nan)
    for axis, prefix in enumerate(FINE):
        steps = plan.sinusoids(prefix)
        seen = np.zeros((at.size, 3), np.complex128)
        for step in steps:
            image = coloured(captures, step.name, white.shape[:2]).reshape(-1, 3)[at] - black
            seen += (2 / len(steps)) * np.exp(-1j * step.phase_rad) * image
        by_colour = np.linalg.solve(mixing, (2 * seen / own_white).T).T
        # what is not a number in one of the steps is left out, too
        use = every(np.abs(by_colour) > LEAST_CONTRAST)
        by_colour = by_colour[use]
        apart_px[axis, use] = np.angle(by_colour * np.conj(by_colour[:, 1:2])) * FRINGE_PX / (2 * np.pi)
    return ColoursApart(at, apart_px)


def colour_shifts(apart: ColoursApart) -> ColourShifts:
    """How far the colours of a projector lie apart."""
    shifts, errors = np.full((3, 2), np.nan), np.full((3, 2), np.nan)
    for axis in range(2):
        seen = apart.px[axis][finite(apart.px[axis])]
        if len(seen) >= FEWEST_PIXELS:
            shifts[:, axis] = np.median(seen, axis=0)
            parts = [np.median(part, axis=0) for part in np.array_split(seen, PARTS)]
            errors[:, axis] = np.std(parts, axis=0, ddof=1) / np.sqrt(PARTS)
    return ColourShifts(shifts, errors)


@dataclass(frozen=True, slots=True, eq=False)
class ColourSizes:
    """``larger`` (3,): by how much the pictures of red, green and blue are larger than green's, relative.

    ``error`` (3,): the standard error of each; both NaN where too little was seen
    """

    larger: Float64
    error: Float64


def colour_sizes(apart: ColoursApart, position_px: FloatImage) -> ColourSizes:
    """Whether the pictures of a projector's colours are of one size.

    ``position_px`` (rows, columns, 2): where camera pixels look in the projector's image, NaN where not known
    """
    place_px = position_px.reshape(-1, 2)[apart.at].astype(np.float64)
    slopes: list[Float64] = []
    for axis in range(2):
        use = finite(place_px) & finite(apart.px[axis])
        if np.count_nonzero(use) < FEWEST_PIXELS:
            return ColourSizes(np.full(3, np.nan), np.full(3, np.nan))
        seen = apart.px[axis][use]
        slopes.append(np.stack([_slopes(place_px[use], seen[:, colour], axis) for colour in range(3)]))
    # of each part of the picture, over both axes
    each = np.mean(slopes, axis=0)
    return ColourSizes(each.mean(axis=1), np.std(each, axis=1, ddof=1) / np.sqrt(PARTS))


def _slopes(place_px: Float64, apart_px: Float64, axis: int) -> Float64:
    """(PARTS,): change of ``apart_px`` (some,) along an axis of the projector's image, of every so many-th pixel."""
    equations = np.stack([np.ones(len(place_px)), *(place_px - place_px.mean(axis=0)).T])
    used = np.ones(len(place_px))
    for _ in range(ROUNDS):
        # of least squares: places on one line fix no plane
        normal = (equations * used) @ equations.T
        plane = np.linalg.lstsq(normal, equations @ (used * apart_px), rcond=None)[0]
        off = np.abs(apart_px - plane @ equations)
        used = (off <= OUTLIER * 1.4826 * np.median(off) + 1e-9).astype(np.float64)
    kept, seen = equations[:, used > 0].T, apart_px[used > 0]
    parts = [np.linalg.lstsq(kept[n::PARTS], seen[n::PARTS], rcond=None)[0][1 + axis] for n in range(PARTS)]
    return np.array(parts)


def misaligned(name: str, shifts: ColourShifts) -> str | None:
    """What a technician should know; None where the colours lie on each other."""
    parts = [
        f"{colour} by {x:+.1f} pixels across and {y:+.1f} down"
        for colour, (x, y) in zip(COLOURS, np.nan_to_num(shifts.px), strict=True)
        if np.hypot(x, y) > NAMED_PX
    ]
    if not parts:
        return None
    return (
        f"The colours of projector {name} do not lie on each other: {' and '.join(parts)} from green. What is solved "
        "takes that into account, but detail of single pixels keeps coloured edges. To avoid them, align its panels in "
        "its menu (often called panel alignment, convergence or registration), and calibrate again."
    )


def fringed(name: str, sizes: ColourSizes, size_px: tuple[int, int]) -> str | None:
    """What a technician should know of ``colour_sizes`` of a projector of ``size_px``; None where they are alike."""
    reach_px = max(size_px) / 2
    sure = np.abs(sizes.larger) > np.maximum(SURE * sizes.error, NAMED_PX / reach_px)
    if not sure.any():
        return None
    parts = [
        f"{colour}'s picture is {100 * abs(by):.2f} % {'larger' if by > 0 else 'smaller'} than green's"
        for colour, by, named in zip(COLOURS, sizes.larger, sure, strict=True)
        if named
    ]
    edge_px = float(np.max(np.abs(sizes.larger[sure]))) * reach_px
    return (
        f"Colours of projector {name} lie apart towards the edges of its picture, by up to {edge_px:.2f} pixels: "
        f"{' and '.join(parts)} (lateral chromatic aberration of its lens or of the camera's). Nothing has to be done "
        "unless fine detail has coloured edges there. Then keep the object in the middle of both pictures, with less "
        "lens shift, and calibrate again."
    )
