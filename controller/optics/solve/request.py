"""One appearance from its picture to its frames: exposure, feasibility, adaptation and the solve, arrays in and out.

Request and result are plain values, so that the same function makes appearances here and on another
machine, and gives the same.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final, Literal, TypeAlias
from weakref import WeakKeyDictionary

import cv2
import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from controller.core.arrays import FloatImage, Mask, moved_to_file
from controller.optics.solve.appearance import BaseKind, StageLight
from controller.optics.solve.bounded.engine import ALONE, SolveContext
from controller.optics.solve.bounded.equations import APPEARANCE_TOLERANCE, Solution, SolveSettings, appearance_weights
from controller.optics.solve.bounded.solver import solve_bounded
from controller.optics.solve.reach.adaptation import adapted_target
from controller.optics.solve.reach.drive_levels import DriveLevels
from controller.optics.solve.reach.feasibility import (
    Feasibility,
    direct_part,
    expose_target,
    feasibility,
    target_radiance,
)
from controller.optics.solve.targets.values import Target
from controller.optics.transport import LightTransport
from controller.optics.transport.indirect.indirect_light import ReflectedLight

ADAPTATIONS: Final = 2
"""An adapted target throws back other light than was asked for, and so needs another floor."""


Unseen: TypeAlias = Literal["smooth", "black"]
BESIDE: Final = 32
"""Light is continued from so many pixels: at the edge of what cameras see it is noisy."""
RIM_PX: Final = 4
"""Farthest of these from the edge."""
WIDEST: Final = 0.15
"""A gap between what cameras see, as a share of the picture's longer side, is still a part of the object."""


@dataclass(frozen=True, slots=True)
class SolveOptions:
    """``share`` of the object's pixels that each target's exposure makes reachable; ``smoothness`` of eq. 3.

    ``base``: the base image, with which live targets are made
    ``adapt``: how far targets are bent into what the stage can make, from 0 (cut off) to 1
    ``exposure``: instead of that by ``share``, where a target asks for one
    ``unseen``: what projector pixels show that no camera sees, see ``continued``
    """

    share: float
    smoothness: float
    base: BaseKind = "white"
    adapt: float = 0.0
    exposure: float | None = None
    unseen: Unseen = "black"

    def inputs(self) -> dict[str, str]:
        """What an appearance depends on, as the journal compares it."""
        # the last two had other values once: what was solved since then stays valid
        inputs = {"share": repr(self.share), "smoothness": repr(self.smoothness), "mode": "full", "base": "white"}
        if self.adapt != 0:
            inputs["adapt"] = repr(self.adapt)
        if self.unseen != "black":
            inputs["unseen"] = self.unseen
        return inputs

    def base_inputs(self) -> dict[str, str]:
        """The inputs of the base image; the brightness of appearances is not among them."""
        return {"smoothness": repr(self.smoothness), "base": self.base}


@dataclass(frozen=True, slots=True)
class AppearanceResult:
    """A solved appearance.

    ``frames``: one (rows, columns, 3) float32 linear image a projector, in [0, 1]
    ``target`` (rows, columns, 3) float32: radiance aimed at, adapted where that was wanted
    ``reachable`` (rows, columns) bool: valid pixels of the picture where ``target`` is reachable
    ``asked`` (rows, columns, 3) float32: radiance that was asked for, before any adaptation
    ``asked_reachable``, ``valid`` (rows, columns) bool: where that is reachable; where the picture says something
    ``figures``: exposure, held_back (of ``ExposedTarget``), seconds, reachable_share, iterations, kkt; with
        adaptation also adapted_share, that of the pixels where ``target`` is reachable
    """

    frames: tuple[FloatImage, ...]
    target: FloatImage
    reachable: Mask
    asked: FloatImage
    asked_reachable: Mask
    valid: Mask
    figures: dict[str, float | int | str | None] = field(default_factory=dict)


def solve_appearance(
    light: StageLight, requested: Target, options: SolveOptions, context: SolveContext = ALONE
) -> AppearanceResult:
    """Make an appearance of the picture ``requested``, reflectance-like, as seen from the camera.

    With ``light.indirect`` the frames leave room in the target for the light by way of other surfaces.
    Raises what ``exposures`` and ``solve_bounded`` raise.
    """
    drive, exposed = light.levels(context.folder), replace(options, exposure=requested.exposure)
    aim = aim_at(drive, light.black, light.indirect, requested.image, exposed, context.folder)
    valid = requested.mask
    del requested  # the picture is large, and of no more use
    began_s = time.perf_counter()
    made = _solved(light, aim, options, context)
    figures = aim.figures | {
        "seconds": time.perf_counter() - began_s,
        "iterations": made.iterations,
        "kkt": made.kkt,
    }
    frames = made.frames if options.unseen == "black" else continued(light.transport, made.frames)
    reachable, asked_reachable = (part.reachable & valid for part in (aim.possible, aim.asked_possible))
    return AppearanceResult(frames, aim.wanted, reachable, aim.asked, asked_reachable, valid, figures)


@dataclass(frozen=True, slots=True)
class _Gap:
    """``at`` (pixels,): those of a projector that no camera sees; ``beside`` (pixels, nearest): others next to them,
    which are seen, or light the room. Both are indices into its picture, row by row.
    """

    at: npt.NDArray[np.intp]
    beside: npt.NDArray[np.intp]


_gaps: Final[WeakKeyDictionary[LightTransport, Sequence[_Gap]]] = WeakKeyDictionary()


SheetOf: TypeAlias = Callable[[int, Mask], FloatImage]
"""By a projector's number and a mask of its pixels: what is painted where they land, (rows, columns, 3), or NaN."""
DARKEST: Final = 0.02
"""Paint, by which light is divided."""


def continued(
    transport: LightTransport, frames: Sequence[FloatImage], sheet: SheetOf | None = None
) -> tuple[FloatImage, ...]:
    """Frames (rows, columns, 3) in which pixels that no camera sees have the mean light of those next to them, or what
    that is on ``sheet``.

    They are gaps between what cameras see of the object, and what lies between it and the room beside it. Next to the
    room they fade. What is open to the picture's border stays dark: it may light anything.
    """
    if transport not in _gaps:
        _gaps[transport] = [_gap(transport, n) for n in range(len(transport.sizes))]
    whole = []
    for n, (frame, gap) in enumerate(zip(frames, _gaps[transport], strict=True)):
        filled = np.array(frame, np.float32)
        pixels = filled.reshape(-1, 3)
        light = pixels[gap.beside].mean(axis=1)
        if sheet is not None:
            asked = np.isin(np.arange(len(pixels)), np.union1d(gap.at, gap.beside)).reshape(frame.shape[:2])
            paint = np.maximum(sheet(n, asked), DARKEST).reshape(-1, 3)
            level = np.nan_to_num(pixels[gap.beside] / paint[gap.beside]).mean(axis=1)
            light = np.where(np.isfinite(paint[gap.at]), np.minimum(level * paint[gap.at], 1), light)
        pixels[gap.at] = light
        whole.append(filled)
    return tuple(whole)


def _gap(transport: LightTransport, n: int) -> _Gap:
    span, shape = transport.span(n), transport.sizes[n]
    room = np.zeros(shape, np.bool_) if transport.beside is None else transport.beside[span].reshape(shape)
    seen = (transport.per_weight[span] > 0).reshape(shape) & ~room
    unseen = _within(seen, seen | room)
    near = cv2.dilate(unseen.astype(np.uint8), np.ones((2 * RIM_PX + 1,) * 2, np.uint8)) > 0
    rim, at = np.argwhere((seen | room) & near), np.argwhere(unseen)
    if not len(rim) or not seen.any():
        return _Gap(np.empty(0, np.intp), np.empty((0, 1), np.intp))
    nearest = np.asarray(cKDTree(rim).query(at, min(BESIDE, len(rim)))[1], np.intp).reshape(len(at), -1)
    return _Gap(np.flatnonzero(unseen), (rim @ (shape[1], 1))[nearest])


def _within(seen: Mask, known: Mask) -> Mask:
    """(rows, columns): pixels that are not ``known``, but in gaps of what is ``seen``, or enclosed by what is known."""

    def beyond(mask: Mask) -> FloatImage:
        return np.asarray(
            cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE), np.float32
        )

    # a closing: what is not far from what is seen, less what is not far from what is
    steps = max(1, round(WIDEST * max(seen.shape) / 2))
    gaps = beyond(np.pad(beyond(seen) > steps, 1, constant_values=True))[1:-1, 1:-1] > steps
    _, parts = cv2.connectedComponents((~known).astype(np.uint8), connectivity=4)
    border = np.concatenate([parts[[0, -1]].ravel(), parts[:, [0, -1]].ravel()])
    return np.asarray(~known & (gaps | ~np.isin(parts, border)))


@dataclass(frozen=True, slots=True)
class Aim:
    """What a solve aims at, (rows, columns, 3) radiance.

    ``wanted``: the whole picture; ``direct``: what the projectors are to make of it by their direct light, with the
    black image; ``possible``: how that lies in what they can make; ``asked``, ``asked_possible``: ``wanted`` before it
    was adapted, and how that lay in it; ``figures``: see ``AppearanceResult``
    """

    wanted: FloatImage
    direct: FloatImage
    possible: Feasibility
    asked: FloatImage
    asked_possible: Feasibility
    exposure: float
    figures: dict[str, float | int | str | None]


def aim_at(
    drive: DriveLevels,
    black: FloatImage,
    indirect: ReflectedLight | None,
    picture: FloatImage,
    options: SolveOptions,
    folder: Path | None = None,
) -> Aim:
    """Expose a picture, see what of it is in reach, and adapt it if asked.

    With indirect light all of this is asked of the direct light that the picture leaves to be made. A pixel is too
    dark, too, where more indirect light falls than is wanted. ``folder``: as of ``SolveContext``. Raises what
    ``exposures`` raises.
    """
    exposed = expose_target(drive, picture, black, share=options.share, indirect=indirect, asked=options.exposure)
    exposure, needed, possible = exposed.exposure, exposed.needed, exposed.possible
    asked = wanted = moved_to_file(exposed.wanted, folder)
    figures: dict[str, float | int | str | None] = {
        "exposure": exposure, "reachable_share": possible.share, "held_back": exposed.held_back,
    }  # fmt: skip
    asked_possible = possible
    del exposed  # all parts are as large as the camera's picture: what is of no more use is let go
    if options.adapt > 0:
        for _ in range(1 if indirect is None else ADAPTATIONS):
            # what is there without any direct light of the projectors, where ``needed`` is shown around
            floor = np.subtract(wanted, needed)
            floor += black
            del wanted, needed
            wanted = moved_to_file(adapted_target(drive, asked, floor, strength=options.adapt), folder)
            del floor
            needed = direct_part(drive.reach, wanted, black, indirect)
        possible = feasibility(drive, needed, black)
        figures |= {"adapted_share": possible.share}
    direct = moved_to_file(target_radiance(needed, black, 1.0), folder)
    return Aim(wanted, direct, possible, asked, asked_possible, exposure, figures)


def _solved(light: StageLight, aim: Aim, options: SolveOptions, context: SolveContext) -> Solution:
    """Frames for an aim; its direct light is corrected once for what the frames' own light throws back."""
    black, reflected = light.black, light.indirect
    weights = appearance_weights(target_radiance(aim.wanted, black, 1.0), aim.possible.reachable, aim.exposure)

    def left(frames: Sequence[FloatImage]) -> FloatImage:
        # what can't be reached throws back other light than was wanted of it
        assert reflected is not None
        return target_radiance(aim.wanted - reflected.forward(light.transport.forward(frames)), black, 1.0)

    correction = None if reflected is None else left
    settings = SolveSettings(options.smoothness, weights, tolerance=APPEARANCE_TOLERANCE, correction=correction)
    return solve_bounded(light.transport, aim.direct, black, settings, context)
