"""Bends targets so that the object's own pattern doesn't show where light is lacking.

Cutting a target off at each pixel shows the object's paint: a dark patch stays dark, and where light of other surfaces
falls on a pale one it stays pale. What is not seen is a limit that varies slowly. So what single pixels can't make
becomes smooth limits (``smooth_limits``), and the target is bent towards them as a film bends highlights: what keeps
well away from a limit stays as it is, differences beyond it shrink.

1. Dark: no darker than a smooth floor, in grey, so that shadows don't take on the colour of the light in them. Paint on
   which no grey outshines that colour keeps it, and does not lift what is around.
2. Chroma: no more saturated than can be shown around; the hue and the lightness stay.
3. Light: no brighter than a smooth ceiling. Mostly all channels together, so that highlights keep their colour.

Chroma comes before lightness: a pixel whose channels lack light alone is not dimmed. Arrays in, arrays out
(docs/decisions/0048).
"""

from __future__ import annotations

from typing import Final

import numpy as np

from controller.core.arrays import FloatImage, Mask, strips
from controller.core.channels import largest, smallest
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
    target = _Bent(np.asarray(wanted, np.float32), np.asarray(floor, np.float32), drive, SmoothLimits.on(drive.mask))
    target.lift()
    target.pale()
    return target.dimmed(strength)


class _Bent:
    """A target on its way. The steps work on strips of rows, and keep what a whole picture has to be known for.

    ``lowest``, ``level`` (rows, columns): the darkest grey of each pixel, and what the smooth floor makes of it;
    ``chroma`` (rows, columns): what is left of the saturation, from 0 to 1
    """

    def __init__(self, wanted: FloatImage, floor: FloatImage, drive: DriveLevels, limits: SmoothLimits) -> None:
        self._wanted, self._floor, self._drive, self._limits = wanted, floor, drive, limits
        self._lowest = self._level = np.zeros(drive.mask.shape, np.float32)
        self._chroma: FloatImage = np.ones(drive.mask.shape, np.float32)

    def lift(self) -> None:
        """Raise the darkest parts by grey light, where the stage can make a grey that bright at all."""
        need = np.zeros_like(self._lowest)
        for rows in strips(len(need)):
            floor, wanted = self._floor[rows], np.maximum(self._wanted[rows], 0)
            of_floor, of_grey = self._drive.of(floor, rows), self._drive.of(np.ones_like(floor), rows)
            self._lowest[rows] = np.maximum(largest(_quotient(of_floor, of_grey, otherwise=0.0)), 0)
            brightest = smallest(_quotient(of_floor + 1, of_grey, otherwise=np.inf))
            shown = self._lowest[rows] <= brightest
            lacking = self._drive.mask[rows] & shown & (wanted @ GREY < self._lowest[rows])
            need[rows] = np.where(lacking, self._lowest[rows], 0)
        self._level = self._limits.above(need)
        np.maximum(self._lowest, self._level, out=self._lowest)

    def pale(self) -> None:
        """Take chroma away where a channel would have to be darker than dark.

        A channel's share of grey light says how saturated a colour is; the limit is on the smallest of these shares.
        """
        needs = np.zeros((3, *self._chroma.shape), np.float32)
        for rows in strips(self._chroma.shape[0]):
            needs[:, rows] = self._chroma_needed(rows)
        for channel in range(3):
            needs[channel] = self._limits.above(needs[channel])
        for rows in strips(self._chroma.shape[0]):
            chroma = np.ones_like(self._chroma[rows])
            lifted, grey = self._lifted(rows)
            for channel, limit in enumerate(needs[:, rows]):
                own = lifted[..., channel] / grey
                raised = np.minimum(_soft_maximum(own, limit), 1)
                chroma = np.minimum(chroma, _quotient(1 - raised, 1 - own, otherwise=1.0, where=own < 1))
            self._chroma[rows] = np.clip(chroma, 0, 1)

    def _chroma_needed(self, rows: slice) -> FloatImage:
        """(3, rows, columns): the least share of grey light that each channel can show, 0 where it can show its own."""
        lifted, grey = self._lifted(rows)
        floor = self._floor[rows]
        of_grey = np.maximum(self._drive.of(grey[..., None] - floor, rows), 0)
        of_colour = self._drive.of(lifted - floor, rows)
        with np.errstate(invalid="ignore"):
            # both are infinite where a colour of light is none
            lost = of_grey - of_colour
        kept = _quotient(of_grey, lost, otherwise=1.0)
        clear = np.clip((grey / np.maximum(self._lowest[rows], np.float32(1e-12)) - 1) / CLEAR, 0, 1)[..., None]
        own = lifted / grey[..., None]
        need = own + clear * (1 - kept) * (1 - own)
        lacking = self._drive.mask[rows][..., None] & (of_colour < -FORGIVEN) & (own < 1)
        return np.moveaxis(np.where(lacking, need, 0), 2, 0).astype(np.float32)

    def dimmed(self, strength: float) -> FloatImage:
        """Bend the brightest parts below a smooth ceiling; all steps together, as strong as ``strength``."""
        rows_of, mask = list(strips(len(self._wanted))), self._drive.mask
        top = np.float32(max(self._paler(rows)[mask[rows]].max(initial=0) for rows in rows_of) / KNEE)
        depths = np.empty((3, *mask.shape), np.float32)
        for rows in rows_of:
            depths[:, rows] = np.moveaxis(self._depth(rows, top), 2, 0)
        is_dimmed = bool(depths.any())
        for channel in range(3 if is_dimmed else 0):
            depths[channel] = self._limits.above(depths[channel])
        changed = self._wanted.copy()
        for rows in rows_of:
            bent = self._paler(rows)
            if is_dimmed:
                of_ceiling = np.asarray(bent / (top * np.exp(-np.moveaxis(depths[:, rows], 0, 2))), np.float32)
                gain = _quotient(_shoulder(of_ceiling), of_ceiling, otherwise=1.0)
                together = gain.min(axis=2, keepdims=True)
                bent *= gain ** np.float32(1 - TOGETHER) * together ** np.float32(TOGETHER)
            wanted = self._wanted[rows]
            changed[rows] = np.where(mask[rows][..., None], wanted + np.float32(strength) * (bent - wanted), wanted)
        return changed

    def _depth(self, rows: slice, top: np.float32) -> FloatImage:
        """(rows, columns, 3): how far the ceiling is below ``top``; 0 where light is not lacking."""
        target, floor = self._paler(rows), self._floor[rows]
        levels = self._drive.of(target - floor, rows)
        over = self._drive.mask[rows][..., None] & (levels > 1 + FORGIVEN)
        most = np.maximum(floor + self._drive.light(np.clip(levels, 0, 1), rows), np.float32(1e-12))
        return np.where(over, np.clip(np.log(top / most), 0, DEEPEST), 0).astype(np.float32)

    def _lifted(self, rows: slice) -> tuple[FloatImage, FloatImage]:
        """The target after ``lift``, and (rows, columns) its grey."""
        wanted = np.maximum(self._wanted[rows], 0)
        grey = wanted @ GREY
        lifted = np.asarray(wanted + (_soft_maximum(grey, self._level[rows]) - grey)[..., None], np.float32)
        return lifted, np.maximum(lifted @ GREY, np.float32(1e-12))

    def _paler(self, rows: slice) -> FloatImage:
        """The target after ``pale``. Full chroma leaves every bit as it is."""
        lifted, grey = self._lifted(rows)
        return np.asarray(lifted + (1 - self._chroma[rows])[..., None] * (grey[..., None] - lifted), np.float32)


def _shoulder(value: FloatImage) -> FloatImage:
    """The identity up to ``KNEE``, then towards 1 with the same slope at the knee."""
    room = np.float32(1 - KNEE)
    above = np.maximum(value - np.float32(KNEE), 0) / room
    return np.asarray(np.minimum(value, np.float32(KNEE)) + room * (1 - np.exp(-above)), np.float32)


def _soft_maximum(value: FloatImage, level: FloatImage) -> FloatImage:
    """At least the larger of both; ``value`` itself where ``level`` is 0."""
    found = np.asarray(np.maximum(value, 0), np.float32)
    # elsewhere a root of a power is not the number itself, by a bit or two that differ from processor to processor
    raised = level > 0
    found[raised] = (found[raised] ** POWER + level[raised] ** POWER) ** np.float32(1 / POWER)
    return found


def _quotient(above: FloatImage, below: FloatImage, *, otherwise: float, where: Mask | None = None) -> FloatImage:
    """``above`` / ``below`` where that is positive (and ``where``), else ``otherwise``."""
    possible = (below > 1e-9) & np.isfinite(above) & np.isfinite(below)
    out = np.full(above.shape, otherwise, np.float32)
    return np.asarray(np.divide(above, below, out=out, where=possible if where is None else possible & where))
