"""Patterns painted on the object in its own coordinates: checkerboard, dots, stripes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal, TypeAlias

import numpy as np

from controller.core.arrays import FloatImage, Mask
from controller.core.errors import UsageError
from controller.optics.calibrate.values import Geometry
from controller.optics.solve.targets.values import Target
from controller.optics.solve.targets.wrap import UPRIGHT, Mapping, ObjectSpace, object_space, painted

Colour: TypeAlias = tuple[float, float, float]
WHITE_GREY: Colour = (0.72, 0.72, 0.72)


@dataclass(frozen=True, slots=True)
class CheckerboardLook:
    """Settings of a checkerboard; those of stage.toml have the same names.

    ``square_m``: side in metres; None: ``squares_across`` of them fit the visible circumference
    """

    square_m: float | None = None
    squares_across: float = 8.0
    colours: tuple[Colour, Colour] = (WHITE_GREY, (0.08, 0.08, 0.08))
    mapping: Mapping = "cylinder"
    up: tuple[float, float, float] = UPRIGHT


@dataclass(frozen=True, slots=True)
class PatternLook:
    """Settings of a pattern; those of stage.toml have the same names, but for ``figure``.

    ``period_m``: distance of dots or stripes; None: ``periods_across`` of them fit the visible circumference (the
    width of an object that is mapped as a plane, where they are finer therefore)
    ``fill``: share of the surface that carries ``ink``, in (0, 0.5]
    """

    kind: Literal["dots", "stripes", "plain"] = "dots"
    period_m: float | None = None
    periods_across: float = 9.0
    body: Colour = WHITE_GREY
    ink: Colour = (0.55, 0.10, 0.08)
    fill: float = 0.3
    mapping: Mapping = "cylinder"
    up: tuple[float, float, float] = UPRIGHT


CHECKERBOARD: Final = CheckerboardLook()
DOTS: Final = PatternLook()


def checkerboard(geometry: Geometry, mask: Mask, look: CheckerboardLook = CHECKERBOARD) -> Target:
    """Squares along the circumference and the height; a corner of four lies at the object's middle."""
    space = object_space(geometry, mask, mapping=look.mapping, up=look.up)
    side = _period(space, look.square_m, look.squares_across)

    def pattern(across: FloatImage, above: FloatImage) -> FloatImage:
        odd = (np.floor(across / side) + np.floor(above / side)) % 2 != 0
        return _mixed(*look.colours, odd.astype(np.float32))

    return painted(space, pattern)


def replace_pattern(geometry: Geometry, mask: Mask, look: PatternLook = DOTS) -> Target:
    """A plain body in place of the object's own pattern, with another pattern on it."""
    if not 0.0 < look.fill <= 0.5:
        raise UsageError(
            "pattern-fill-invalid",
            what=f"A pattern can't cover {look.fill} of the object.",
            remedy="Choose a fill above 0 and at most 0.5.",
        )
    space = object_space(geometry, mask, mapping=look.mapping, up=look.up)
    period = _period(space, look.period_m, look.periods_across)
    # two dots a period squared, one at the corners and one in the middle
    radius = period * float(np.sqrt(look.fill / (2 * np.pi)))

    def pattern(across: FloatImage, above: FloatImage) -> FloatImage:
        if look.kind == "plain":
            inked = np.zeros(across.shape, dtype=np.float32)
        elif look.kind == "stripes":
            inked = (np.abs(_from_nearest(across, period)) < look.fill * period / 2).astype(np.float32)
        else:
            corner = np.hypot(_from_nearest(across, period), _from_nearest(above, period))
            half = np.float32(period / 2)
            centre = np.hypot(_from_nearest(across - half, period), _from_nearest(above - half, period))
            inked = (np.minimum(corner, centre) < radius).astype(np.float32)
        return _mixed(look.body, look.ink, inked)

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
