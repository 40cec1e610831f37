"""How strong effects are, as bench.toml says it. Zeros switch an effect off."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, TypeAlias

from plugins.emulated.tables import Between

Bands: TypeAlias = tuple[tuple[float, float], tuple[float, float], tuple[float, float]]
"""Red, green and blue by wavelength: peak and standard deviation in nm."""
NO_BANDS: Bands = ((0.0, 0.0), (0.0, 0.0), (0.0, 0.0))


@dataclass(frozen=True, slots=True)
class Varnish:
    """A rough varnish on the object. ``strength``: 0 without one, 1 all over it; ``roughness``: alpha of GGX;

    ``index``: of refraction
    """

    strength: Annotated[float, Between(0.0, 1.0)] = 0.0
    roughness: Annotated[float, Between(0.02, 1.0)] = 0.3
    index: Annotated[float, Between(1.01, 3.0)] = 1.5


@dataclass(frozen=True, slots=True)
class Subsurface:
    """Light that spreads in the object's material. ``share``: of the light; ``spread_m``: diffusion length."""

    share: Annotated[float, Between(0.0, 1.0)] = 0.0
    spread_m: Annotated[float, Between(1e-5, 0.05)] = 0.0015


@dataclass(frozen=True, slots=True)
class Dithering:
    """A panel that makes levels by turns.

    ``levels``: in one frame, 0 without dithering; ``turns``: frames; ``frame_s``: of one
    """

    levels: Annotated[int, Between(0, 65536)] = 0
    turns: Annotated[int, Between(1, 64)] = 4
    frame_s: Annotated[float, Between(1e-4, 1.0)] = 1.0 / 60.0


BARE, OPAQUE, STEADY = Varnish(), Subsurface(), Dithering()
"""Without the effects."""
