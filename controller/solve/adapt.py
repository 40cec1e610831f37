"""Bends targets so that the object's own pattern doesn't show where light is lacking.

Cutting a target off at each pixel shows the object's paint: a dark patch stays dark, and where light of other surfaces
falls on a pale one it stays pale. What is not seen is a limit that varies slowly. So what single pixels can't make
becomes smooth limits (``smooth_limits``), and the target is bent towards them as a film bends highlights: what keeps
well away from a limit stays as it is, differences beyond it shrink.

1. Dark: no darker than a smooth floor, in grey, so that shadows don't take on the colour of the light in them.
2. Chroma: no more saturated than can be shown around; the hue and the lightness stay.
3. Light: no brighter than a smooth ceiling. Mostly all channels together, so that highlights keep their colour.

Chroma comes before lightness: a pixel whose channels lack light alone is not dimmed. Arrays in, arrays out
(docs/decisions/0048).
"""

from __future__ import annotations

from typing import Final

import numpy as np

from controller.core.arrays import FloatImage, Mask
from controller.core.channels import largest
from controller.core.errors import UsageError
from controller.solve.bounded.solver import check_target
from controller.solve.drive_levels import DriveLevels
from controller.solve.smooth_limits import SmoothLimits
from controller.transport import LightTransport

KNEE: Final = 0.8
"""Of the ceiling: light below this part of it stays as it is."""
TOGETHER: Final = 0.8
"""How far channels are dimmed together, from 0 (each by itself, which colours highlights) to 1."""
DEEPEST: Final = 2.5
"""Largest logarithm of the brightest target's light over a ceiling: what hardly any light reaches is given up."""
POWER: Final = 4
"""Of the means that stand for a soft maximum of a target and its floor."""
CLEAR: Final = 1.0
"""Chroma counts in full where a target is brighter than its floor by this part of it; in the dark it hardly shows."""
FORGIVEN: Final = 1e-3
"""Drive beyond [0, 1] that is no lack of light."""
GREY: Final = np.array([0.25, 0.5, 0.25], np.float32)
"""Lightness from the camera's channels, of which green is that of the eye."""


def adapted_target(
    transport: LightTransport,
    wanted: FloatImage,
    floor: FloatImage,
    *,
    strength: float = 1.0,
    drive: DriveLevels | None = None,
) -> FloatImage:
    """``wanted`` (rows, columns, 3) radiance, bent into what the stage can make without showing its own pattern.

    Parameters
    ----------
    wanted, floor : (rows, columns, 3) radiance. ``floor`` is what is there without any projector's direct light: the
        black image, and what other surfaces throw back
    strength : from 0 (leave it, to be cut off) to 1
    drive : of this transport, where already known

    Returns the target, float32; what lies beside the object stays as it is. Where nothing is lacking, it is ``wanted``.
    Raises UsageError "image-wrong-size", "target-not-finite" or "adapt-strength".
    """
    if not 0 <= strength <= 1:
        raise UsageError(
            "adapt-strength",
            what=f"A target can't be adapted with strength {strength}.",
            remedy="Give a strength from 0 (too bright or too dark parts are cut off) to 1.",
        )
    check_target(transport, wanted)
    check_target(transport, floor)
    drive = DriveLevels(transport) if drive is None else drive
    if strength == 0 or not drive.mask.any():
        return np.asarray(wanted, np.float32)
    limits = SmoothLimits.on(drive.mask)
    asked = np.maximum(wanted, 0)
    lifted, lowest = _lifted(asked, floor, drive, limits)
    paler = _paler(lifted, lowest, floor, drive, limits)
    bent = _dimmed(paler, floor, drive, limits)
    changed = np.where(drive.mask[..., None], wanted + np.float32(strength) * (bent - wanted), wanted)
    return np.asarray(changed, np.float32)


def _lifted(
    wanted: FloatImage, floor: FloatImage, drive: DriveLevels, limits: SmoothLimits
) -> tuple[FloatImage, FloatImage]:
    """``wanted`` with its darkest parts raised by grey light, and (rows, columns) the darkest grey of each pixel."""
    grey = wanted @ GREY
    lowest = _quotient(drive.of(floor), drive.of(np.ones_like(wanted)), otherwise=0.0)
    lowest = np.maximum(largest(lowest), 0)
    lacking = drive.mask & (grey < lowest)
    level = limits.above(np.where(lacking, lowest, 0).astype(np.float32))
    raised = _soft_maximum(grey, level)
    return np.asarray(wanted + (raised - grey)[..., None], np.float32), np.maximum(lowest, level)


def _paler(
    lifted: FloatImage, lowest: FloatImage, floor: FloatImage, drive: DriveLevels, limits: SmoothLimits
) -> FloatImage:
    """With less chroma where a channel would have to be darker than dark.

    A channel's share of grey light says how saturated a colour is; the limit is on the smallest of these shares.
    """
    grey = np.maximum(lifted @ GREY, np.float32(1e-12))[..., None]
    share = lifted / grey
    of_grey, of_colour = np.maximum(drive.of(grey - floor), 0), drive.of(lifted - floor)
    kept = _quotient(of_grey, of_grey - of_colour, otherwise=1.0)
    clear = np.clip((grey[..., 0] / np.maximum(lowest, np.float32(1e-12)) - 1) / CLEAR, 0, 1)
    lacking = drive.mask[..., None] & (of_colour < -FORGIVEN)
    chroma = np.ones(drive.mask.shape, np.float32)
    for channel in range(3):
        own = share[..., channel]
        need = own + clear * (1 - kept[..., channel]) * (1 - own)
        limit = limits.above(np.where(lacking[..., channel] & (own < 1), need, 0).astype(np.float32))
        raised = np.minimum(_soft_maximum(own, limit), 1)
        chroma = np.minimum(chroma, _quotient(1 - raised, 1 - own, otherwise=1.0, where=own < 1))
    # Written so that full chroma leaves every bit as it is.
    return np.asarray(lifted + (1 - np.clip(chroma, 0, 1))[..., None] * (grey - lifted), np.float32)


def _dimmed(target: FloatImage, floor: FloatImage, drive: DriveLevels, limits: SmoothLimits) -> FloatImage:
    """With its brightest parts bent below a smooth ceiling."""
    levels = drive.of(target - floor)
    over = drive.mask[..., None] & (levels > 1 + FORGIVEN)
    if not over.any():
        return target
    most = np.maximum(floor + drive.light(np.clip(levels, 0, 1)), np.float32(1e-12))
    top = np.float32(target[drive.mask].max() / KNEE)
    depth = np.where(over, np.clip(np.log(top / most), 0, DEEPEST), 0).astype(np.float32)
    ceiling = top * np.exp(-np.stack([limits.above(depth[..., channel]) for channel in range(3)], axis=2))
    of_ceiling = target / ceiling
    gain = _quotient(_shoulder(of_ceiling), of_ceiling, otherwise=1.0)
    together = gain.min(axis=2, keepdims=True)
    return np.asarray(target * gain ** np.float32(1 - TOGETHER) * together ** np.float32(TOGETHER), np.float32)


def _shoulder(value: FloatImage) -> FloatImage:
    """The identity up to ``KNEE``, then towards 1 with the same slope at the knee."""
    room = np.float32(1 - KNEE)
    above = np.maximum(value - np.float32(KNEE), 0) / room
    return np.asarray(np.minimum(value, np.float32(KNEE)) + room * (1 - np.exp(-above)), np.float32)


def _soft_maximum(value: FloatImage, level: FloatImage) -> FloatImage:
    """At least the larger of both; ``value`` itself where ``level`` is 0."""
    value = np.maximum(value, 0)
    # A root of a power is not the number itself, by a bit or two that differ from processor to processor.
    return np.where(level > 0, (value**POWER + level**POWER) ** np.float32(1 / POWER), value)


def _quotient(above: FloatImage, below: FloatImage, *, otherwise: float, where: Mask | None = None) -> FloatImage:
    """``above`` / ``below`` where that is positive (and ``where``), else ``otherwise``."""
    possible = (below > 1e-9) & np.isfinite(above) & np.isfinite(below)
    out = np.full(above.shape, otherwise, np.float32)
    return np.asarray(np.divide(above, below, out=out, where=possible if where is None else possible & where))
