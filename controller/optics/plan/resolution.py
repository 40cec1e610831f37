"""The finest wave that superimposed projectors can make, from the blur of their optics (paper 3.3, Fig. 12).

One projector with fine pixels could make every wave up to half a cycle a pixel. Beyond it, its pixels also show a
coarser wave. Projectors whose pixels lie between each other's cancel that one, so that blur is the limit: it has to be
made up for by light, which ends at full and at none, and smoothness takes a part. All of this is solved here for pixels
along one line, at random places between each other, by the objective of ``solve.bounded``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from controller.core.arrays import Float64
from controller.optics.solve.bounded.solver import SMOOTHNESS

MEAN: Final = 0.5
FAINT: Final = 0.1
"""Grey of the wave and its amplitude, of the target's white."""
KEPT: Final = 0.5
"""The finest wave is that which keeps this part of its contrast."""
LENGTH_PX: Final = 20.0
MARGIN_PX: Final = 4.0
SAMPLES: Final = 5
"""For each pixel."""
DRAWS: Final = 6
SEED: Final = 1
ITERATIONS: Final = 300
FREQUENCIES: Final = np.linspace(0.2, 1.2, 31)


@dataclass(frozen=True, slots=True)
class LineProjector:
    """A projector along the wave.

    ``pitch``: of its pixels, by that of the first projector; ``blur_px``: standard deviation in its own pixels, without
    the pixel's square, the camera's blur included; ``light``: its full light over that of the target's white
    """

    pitch: float
    blur_px: float
    light: float


def finest_wave(projectors: Sequence[LineProjector], *, smoothness: float = SMOOTHNESS) -> float:
    """Cycles a pixel of the first projector up to which a faint wave keeps half of its contrast."""
    return last_kept(FREQUENCIES, kept_contrast(projectors, FREQUENCIES, smoothness=smoothness))


def kept_contrast(
    projectors: Sequence[LineProjector],
    frequencies: Float64,
    *,
    smoothness: float = SMOOTHNESS,
    draws: int = DRAWS,
    seed: int = SEED,
) -> Float64:
    """(F,) amplitude in phase with the target's, over the target's; ``frequencies`` (F,) in cycles a pixel.

    ``draws``: random places of the pixels, over which it is averaged
    """
    rng = np.random.default_rng(seed)
    x = np.arange(0.0, LENGTH_PX, 1.0 / SAMPLES)
    kept = np.zeros(len(frequencies))
    for _ in range(draws):
        places = rng.uniform(0, 1, len(projectors))
        phase = 2 * np.pi * (frequencies[:, None] * x + rng.uniform(0, 1, len(frequencies))[:, None])
        lights = [_light_of(one, place, x) for one, place in zip(projectors, places, strict=True)]
        made = solved(lights, MEAN + FAINT * np.cos(phase), smoothness) @ np.hstack(lights).T
        kept += [_amplitude(*one, x) / FAINT for one in zip(made, phase, strict=True)]
    return kept / draws


def last_kept(frequencies: Float64, kept: Float64, *, share: float = KEPT) -> float:
    """The first frequency at which the contrast falls below ``share``, by a straight line; no NaN counts."""
    known = np.isfinite(kept)
    frequencies, kept = frequencies[known], kept[known]
    below = np.flatnonzero(kept < share)
    if not below.size:
        return float(frequencies[-1])
    i = int(below[0])
    if i == 0:
        return float(frequencies[0])
    part = (kept[i - 1] - share) / (kept[i - 1] - kept[i])
    return float(frequencies[i - 1] + part * (frequencies[i] - frequencies[i - 1]))


def solved(lights: Sequence[Float64], wanted: Float64, smoothness: float) -> Float64:
    """(F, pixels of all) levels in [0, 1] that minimise the squared residual of each row of ``wanted`` (F, X).

    ``lights``: (X, pixels) of each projector. By accelerated projected gradient, with a step for each pixel.
    """
    light = np.hstack(lights)
    own = np.concatenate([one.T @ one.sum(axis=1) for one in lights])
    strength = smoothness * float(own[own > 0].mean())
    normal = light.T @ light + strength * _roughness([one.shape[1] for one in lights])
    step = 1.0 / np.abs(normal).sum(axis=1)
    data = wanted @ light
    levels = np.full_like(data, 0.5)
    ahead, momentum = levels, 1.0
    for _ in range(ITERATIONS):
        following = np.clip(ahead - step * (ahead @ normal - data), 0, 1)
        grown = 0.5 * (1 + np.sqrt(1 + 4 * momentum**2))
        ahead = following + (momentum - 1) / grown * (following - levels)
        levels, momentum = following, grown
    return np.asarray(levels)


def _light_of(one: LineProjector, place: float, x: Float64) -> Float64:
    """(X, pixels): light at ``x`` of each pixel; the first one's middle lies ``place`` pixels off a whole one."""
    from scipy.special import erf

    count = int(np.ceil((LENGTH_PX + 2 * MARGIN_PX) / one.pitch)) + 1
    middle = one.pitch * (place + np.arange(count)) - MARGIN_PX
    distance = (x[:, None] - middle) / one.pitch
    wide = np.sqrt(2.0) * max(one.blur_px, 1e-3)
    return np.asarray(one.light * 0.5 * (erf((distance + 0.5) / wide) - erf((distance - 0.5) / wide)))


def _roughness(counts: Sequence[int]) -> Float64:
    """The quadratic form of the squared differences between adjacent pixels of each projector."""
    total, start = sum(counts), 0
    form = np.zeros((total, total))
    for count in counts:
        difference = np.diff(np.eye(count), axis=0)
        form[start : start + count, start : start + count] = difference.T @ difference
        start += count
    return form


def _amplitude(made: Float64, phase: Float64, x: Float64) -> float:
    inside = (x > MARGIN_PX) & (x < LENGTH_PX - MARGIN_PX)
    parts = np.stack([np.cos(phase), np.sin(phase), np.ones_like(x), x - x.mean()], axis=1)[inside]
    return float(np.linalg.lstsq(parts, made[inside], rcond=None)[0][0])
