"""Solids on the bench, which show what a calibration makes of an object's shape: two walls, a column, a ball, both."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Final

import cv2
import numpy as np

from plugins.emulated.optics.scenes import STONE, BuiltIn, Model, Part, facets, sheet
from plugins.emulated.optics.shapes import Floats, Rgb

OPENING: Final = np.deg2rad(110.0)
"""Between the walls of the corner."""


def corner() -> Model:
    """Two walls of a room that meet at 110 degrees."""
    deep = 0.18 / np.tan(0.5 * OPENING)
    walls = sheet(2, 3, lambda u, v: (0.18 * (2 * u - 1), 0.14 * (2 * v - 1), deep * np.abs(2 * u - 1)))
    return Model(facets(walls), _marble(0.15))


def cylinder(radius: float = 0.1, high: float = 0.28, x: float = 0.0) -> Model:
    """A column."""
    return Model((_round(x, lambda v: radius + 0 * v, lambda v: high * (v - 0.5)),), _marble(0.15))


def sphere(radius: float = 0.14, x: float = 0.0) -> Model:
    """A ball."""
    part = _round(x, lambda v: radius * np.sin(np.pi * v), lambda v: -radius * np.cos(np.pi * v))
    return Model((part,), _marble(0.15))


def two_objects() -> Model:
    """A ball and a column apart from each other."""
    parts = sphere(0.065, -0.115).parts + cylinder(0.065, 0.12, 0.115).parts
    return Model(parts, _marble(0.15))


def _round(x: float, radius: Callable[[Floats], Floats], height: Callable[[Floats], Floats]) -> Part:
    """A surface of revolution."""
    turn = 2.0 * np.pi
    return sheet(120, 241, lambda u, v: (x - radius(v) * np.sin(turn * u), height(v), -radius(v) * np.cos(turn * u)))


def _marble(strength: float) -> Rgb:
    """Pale stone with soft veins (rows, columns, 3), the same at the left and the right edge."""
    noise = np.random.default_rng(52).normal(0.0, 1.0, (512, 1024))
    soft = cv2.GaussianBlur(np.tile(noise, (1, 3)), (0, 0), 12.0)[:, 1024:2048]
    return np.asarray((1.0 - strength * np.abs(soft / soft.std()))[..., None].clip(0.3) * STONE, dtype=np.float32)


SOLIDS: Final[Mapping[str, BuiltIn]] = {
    "corner": BuiltIn(corner),
    "cylinder": BuiltIn(cylinder),
    "sphere": BuiltIn(sphere),
    "two-objects": BuiltIn(two_objects, ("left", "right", "far-left", "far-right"), apart=True),
}
