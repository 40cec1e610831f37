"""One appearance from its picture to its frames: exposure, feasibility, adaptation and the solve, arrays in and out.

Request and result are plain values, so that the same function makes appearances here and on another
machine, and gives the same.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Final

import numpy as np

from controller.core.arrays import FloatImage, Mask, moved_to_file
from controller.optics.solve.appearance import (
    FINE_DETAIL,
    Appearance,
    Base,
    BaseChoice,
    Mode,
    high_pass_base,
    make_appearance,
    solve_base,
)
from controller.optics.solve.bounded.engine import Engine
from controller.optics.solve.bounded.equations import appearance_weights
from controller.optics.solve.bounded.solver import TOLERANCE
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
from controller.optics.transport.indirect.indirect_light import IndirectLight

ADVICE_FULL_SOLVE = (
    'The target has finer detail than one projector can scale. To keep it, use mode "full" or base "high-pass".'
)


ADAPTATIONS: Final = 2
"""An adapted target throws back other light than was asked for, and so needs another floor."""
FIRST_TOLERANCE: Final = 2 * TOLERANCE
"""Of a solve that another one continues, without the momentum that makes up most of the KKT residual by then."""


@dataclass(frozen=True, slots=True)
class SolveOptions:
    """``share`` of the object's pixels that each target's exposure makes reachable; ``smoothness`` of eq. 3.

    ``base``: the base image; with "high-pass" each appearance solves one of its own
    ``adapt``: how far targets are bent into what the stage can make, from 0 (cut off) to 1
    """

    share: float
    smoothness: float
    mode: Mode = "auto"
    base: BaseChoice = "white"
    adapt: float = 0.0

    def inputs(self) -> dict[str, str]:
        """What an appearance depends on, as the journal compares it."""
        asked = {"share": repr(self.share), "smoothness": repr(self.smoothness), "mode": self.mode, "base": self.base}
        return asked if self.adapt == 0 else {**asked, "adapt": repr(self.adapt)}

    def base_inputs(self) -> dict[str, str]:
        """The inputs of the base image; the mode and brightness of appearances are not among them."""
        shared = "white" if self.base == "high-pass" else self.base
        return {"smoothness": repr(self.smoothness), "base": shared}


@dataclass(frozen=True, slots=True)
class AppearanceResult:
    """A solved appearance.

    ``frames``: one (rows, columns, 3) float32 linear image a projector, in [0, 1]
    ``target`` (rows, columns, 3) float32: radiance aimed at, adapted where that was wanted
    ``reachable`` (rows, columns) bool: valid pixels of the picture where ``target`` is reachable
    ``asked`` (rows, columns, 3) float32: radiance that was asked for, before any adaptation
    ``asked_reachable``, ``valid`` (rows, columns) bool: where that is reachable; where the picture says something
    ``figures``: mode, exposure, seconds, reachable_share, fine_detail, advice, iterations, kkt; with adaptation also
        adapted_share, that of the pixels where ``target`` is reachable
    """

    frames: tuple[FloatImage, ...]
    target: FloatImage
    reachable: Mask
    asked: FloatImage
    asked_reachable: Mask
    valid: Mask
    figures: dict[str, float | int | str | None] = field(default_factory=dict)


def solve_appearance(
    transport: LightTransport,
    base: Base,
    black: FloatImage,
    requested: Target,
    options: SolveOptions,
    *,
    drive: DriveLevels | None = None,
    indirect: IndirectLight | None = None,
    progress: Callable[[int, float], None] | None = None,
    cancelled: Callable[[], bool] | None = None,
    engine: Engine | None = None,
    folder: Path | None = None,
) -> AppearanceResult:
    """Make an appearance of the picture ``requested``, reflectance-like, as seen from the camera.

    ``indirect``: light by way of other surfaces, of which the frames then leave room in the target.
    ``engine``: what does the heavy loops (``solve.engines``); None: the processor
    ``folder``: for nameless files of what need not stay in memory during the solve; None: it stays there

    Raises what ``choose_exposure`` and ``solve_bounded`` raise.
    """
    drive = DriveLevels(transport, folder) if drive is None else drive
    picture, valid = requested.image, requested.mask
    del requested
    aim = aim_at(transport, black, picture, options, drive=drive, indirect=indirect, folder=folder)
    del picture
    began_s = time.perf_counter()
    solve = partial(_solved, transport, base, black, options, aim, progress=progress, cancelled=cancelled,
                    engine=engine)  # fmt: skip
    made = solve(aim.direct, tolerance=TOLERANCE if indirect is None else FIRST_TOLERANCE)
    if indirect is not None:
        # what can't be reached throws back other light than was wanted of it
        frames = made.frames
        del made
        made = solve(_left_to_make(transport, aim.wanted, black, frames, indirect), start=frames)
    figures = aim.figures | {
        "mode": made.mode,
        "seconds": time.perf_counter() - began_s,
        "fine_detail": made.fine_detail,
        "advice": ADVICE_FULL_SOLVE if made.mode == "scale" and made.fine_detail >= FINE_DETAIL else None,
        "iterations": 0 if made.solution is None else made.solution.iterations,
        "kkt": None if made.solution is None else made.solution.kkt,
    }
    reachable, asked_reachable = (found.reachable & valid for found in (aim.possible, aim.asked_possible))
    return AppearanceResult(made.frames, aim.wanted, reachable, aim.asked, asked_reachable, valid, figures)


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
    transport: LightTransport,
    black: FloatImage,
    picture: FloatImage,
    options: SolveOptions,
    *,
    drive: DriveLevels,
    indirect: IndirectLight | None = None,
    folder: Path | None = None,
) -> Aim:
    """Expose a picture, see what of it is in reach, and adapt it if asked.

    With ``indirect`` light all of this is asked of the direct light that the picture leaves to be made. A pixel is too
    dark, too, where more indirect light falls than is wanted. ``folder``: as of ``solve_appearance``. Raises what
    ``choose_exposure`` raises.
    """
    found = expose_target(transport, picture, black, share=options.share, drive=drive, indirect=indirect)
    asked, exposure, asked_possible = moved_to_file(found.wanted, folder), found.exposure, found.possible
    wanted, needed, possible = asked, found.needed, asked_possible
    del found
    figures: dict[str, float | int | str | None] = {"exposure": exposure, "reachable_share": possible.share}
    if options.adapt > 0:
        for _ in range(1 if indirect is None else ADAPTATIONS):
            floor = black if indirect is None else _least(transport, black, needed, indirect)
            # Each is as large as the camera's picture, so none stays while the next one is made.
            del wanted, needed
            wanted = adapted_target(transport, asked, floor, strength=options.adapt, drive=drive)
            wanted = moved_to_file(wanted, folder)
            del floor
            needed = direct_part(transport, wanted, black, indirect)
        possible = feasibility(transport, needed, black, drive=drive)
        figures |= {"adapted_share": possible.share}
    direct = moved_to_file(target_radiance(needed, black, 1.0), folder)
    return Aim(wanted, direct, possible, asked, asked_possible, exposure, figures)


def _left_to_make(
    transport: LightTransport, wanted: FloatImage, black: FloatImage, frames: Sequence[FloatImage],
    indirect: IndirectLight,
) -> FloatImage:  # fmt: skip
    """The radiance (rows, columns, 3) that direct light has to make beside the indirect light of ``frames``."""
    return target_radiance(wanted - indirect.forward(transport.forward(frames)), black, 1.0)


def _least(transport: LightTransport, black: FloatImage, needed: FloatImage, indirect: IndirectLight) -> FloatImage:
    """What is there (rows, columns, 3) without any projector's direct light, where ``needed`` is shown around."""
    shown = np.clip(needed - black, 0, transport.reach())
    return black + indirect.forward(shown)


def _solved(
    transport: LightTransport,
    base: Base,
    black: FloatImage,
    options: SolveOptions,
    aim: Aim,
    target: FloatImage,
    *,
    start: Sequence[FloatImage] | None = None,
    tolerance: float = TOLERANCE,
    progress: Callable[[int, float], None] | None = None,
    cancelled: Callable[[], bool] | None = None,
    engine: Engine | None = None,
) -> Appearance:
    """Frames for a target radiance, in direct light."""
    if options.base == "high-pass":
        image = high_pass_base(transport, base.image, target, black)
        base = solve_base(
            transport, image, black, smoothness=options.smoothness, progress=progress, cancelled=cancelled,
            engine=engine,
        )  # fmt: skip
    return make_appearance(
        transport,
        base,
        target,
        black,
        mode=options.mode,
        smoothness=options.smoothness,
        weights=appearance_weights(target_radiance(aim.wanted, black, 1.0), aim.possible.reachable, aim.exposure),
        reachable=aim.possible.reachable,
        start=start,
        tolerance=tolerance,
        progress=progress,
        cancelled=cancelled,
        engine=engine,
    )
