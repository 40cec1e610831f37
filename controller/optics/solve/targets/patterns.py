"""Patterns painted on the object in its own coordinates: checkerboard, dots, stripes."""

from __future__ import annotations

from typing import Literal, TypeAlias

import numpy as np

from controller.core.arrays import FloatImage, Mask
from controller.core.errors import UsageError
from controller.optics.calibrate.values import Geometry
from controller.optics.solve.targets.values import Target
from controller.optics.solve.targets.wrap import UPRIGHT, Mapping, ObjectSpace, object_space, painted

Colour: TypeAlias = tuple[float, float, float]
WHITE_GREY: Colour = (0.72, 0.72, 0.72)


def checkerboard(
    geometry: Geometry,
    mask: Mask,
    *,
    square_m: float | None = None,
    squares_across: float = 8.0,
    colours: tuple[Colour, Colour] = (WHITE_GREY, (0.08, 0.08, 0.08)),
    mapping: Mapping = "cylinder",
    up: tuple[float, float, float] = UPRIGHT,
) -> Target:
    """Squares along the circumference and the height; a corner of four lies at the object's middle.

    ``square_m``: side in metres; without it, ``squares_across`` of them fit the visible circumference.
    """
    space = object_space(geometry, mask, mapping=mapping, up=up)
    side = _period(space, square_m, squares_across)

    def pattern(across: FloatImage, above: FloatImage) -> FloatImage:
        odd = (np.floor(across / side) + np.floor(above / side)) % 2 != 0
        return _mixed(colours[0], colours[1], odd.astype(np.float32))

    return painted(space, pattern)


def replace_pattern(
    geometry: Geometry,
    mask: Mask,
    *,
    kind: Literal["dots", "stripes", "plain"] = "dots",
    period_m: float | None = None,
    periods_across: float = 9.0,
    body: Colour = WHITE_GREY,
    ink: Colour = (0.55, 0.10, 0.08),
    fill: float = 0.3,
    mapping: Mapping = "cylinder",
    up: tuple[float, float, float] = UPRIGHT,
) -> Target:
    """A plain body in place of the object's own pattern, with another pattern on it.

    Parameters
    ----------
    period_m : distance of dots or stripes; without it, ``periods_across`` of them fit the visible circumference (the
        width of an object that is mapped as a plane, where they are finer therefore)
    fill : share of the surface that carries ``ink``, in (0, 0.5]
    """
    if not 0.0 < fill <= 0.5:
        raise UsageError(
            "pattern-fill-invalid",
            what=f"A pattern can't cover {fill} of the object.",
            remedy="Choose a fill above 0 and at most 0.5.",
        )
    space = object_space(geometry, mask, mapping=mapping, up=up)
    period = _period(space, period_m, periods_across)
    # two dots a period squared, one at the corners and one in the middle
    radius = period * float(np.sqrt(fill / (2 * np.pi)))

    def pattern(across: FloatImage, above: FloatImage) -> FloatImage:
        if kind == "plain":
            inked = np.zeros(across.shape, dtype=np.float32)
        elif kind == "stripes":
            inked = (np.abs(_from_nearest(across, period)) < fill * period / 2).astype(np.float32)
        else:
            corner = np.hypot(_from_nearest(across, period), _from_nearest(above, period))
            half = np.float32(period / 2)
            centre = np.hypot(_from_nearest(across - half, period), _from_nearest(above - half, period))
            inked = (np.minimum(corner, centre) < radius).astype(np.float32)
        return _mixed(body, ink, inked)

    return painted(space, pattern)


def _period(space: ObjectSpace, given_m: float | None, count: float) -> float:
    if given_m is None:
        low, high = np.percentile(space.across_m[space.mask], [0.5, 99.5])
        given_m = float(high - low) / count if count > 0 else 0.0
    if not (np.isfinite(given_m) and given_m > 0):
        raise UsageError(
            "pattern-period-invalid",
            what=f"A pattern can't repeat every {given_m} m.",
            remedy="Give a size in metres above 0, or how many fit across.",
        )
    return given_m


def _from_nearest(values: FloatImage, period: float) -> FloatImage:
    """Signed distance to the nearest multiple of ``period``."""
    return np.asarray(values - np.float32(period) * np.round(values / np.float32(period)), dtype=np.float32)


def _mixed(first: Colour, second: Colour, share: FloatImage) -> FloatImage:
    """(pixels, 3): ``first`` where ``share`` is 0, ``second`` where it is 1."""
    a, b = (np.asarray(c, dtype=np.float32) for c in (first, second))
    return np.asarray(a + share[:, None] * (b - a), dtype=np.float32)
