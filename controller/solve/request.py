"""One appearance from its picture to its frames: exposure, feasibility, adaptation and the solve, arrays in and out.

What is asked and what is answered are plain values, so that the same function makes appearances here and on another
machine, and gives the same.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from controller.arrays import FloatImage, Mask
from controller.solve.adapt import adapt_gently
from controller.solve.appearance import (
    FINE_DETAIL,
    Base,
    BaseChoice,
    Mode,
    high_pass_base,
    make_appearance,
    solve_base,
)
from controller.solve.drive import Drive
from controller.solve.feasibility import choose_exposure, feasibility, target_radiance
from controller.solve.targets_values import Target
from controller.solve.weights import appearance_weights
from controller.transport import LightTransport

GO_FULL = 'The target has finer detail than one projector can scale; mode "full" or base "high-pass" would keep it.'


@dataclass(frozen=True, slots=True)
class SolveOptions:
    """``share`` of the object's pixels that each target's exposure makes reachable; ``smoothness`` of eq. 3.

    ``base``: the base image; with "high-pass" each appearance solves one of its own
    ``adapt``: greatest strength of the contrast adaptation, from 0 (none) to 1
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
        """What the base image depends on: neither on how appearances are made of it, nor how bright."""
        shared = "white" if self.base == "high-pass" else self.base
        return {"smoothness": repr(self.smoothness), "base": shared}


@dataclass(frozen=True, slots=True)
class Answer:
    """What an appearance came to.

    ``frames``: one (rows, columns, 3) float32 linear image a projector, in [0, 1]
    ``target`` (rows, columns, 3) float32: radiance aimed at
    ``reachable`` (rows, columns) bool: where the picture says something that is in reach
    ``figures``: mode, exposure, seconds, reachable_share, fine_detail, advice, iterations, kkt; with adaptation also
        the share and the contrast kept before and after it
    """

    frames: tuple[FloatImage, ...]
    target: FloatImage
    reachable: Mask
    figures: dict[str, float | int | str | None] = field(default_factory=dict)


def answer(
    transport: LightTransport,
    base: Base,
    black: FloatImage,
    asked: Target,
    options: SolveOptions,
    *,
    drive: Drive | None = None,
    progress: Callable[[int, float], None] | None = None,
    cancelled: Callable[[], bool] | None = None,
) -> Answer:
    """Make an appearance of the picture ``asked`` for, reflectance-like, as seen from the camera.

    Raises what ``choose_exposure`` and ``solve_bounded`` raise.
    """
    drive = Drive(transport) if drive is None else drive
    picture = asked.image
    exposure = choose_exposure(transport, picture, black, share=options.share, drive=drive)
    wanted = np.float32(exposure) * picture
    possible = feasibility(transport, wanted, black, drive=drive)
    told: dict[str, float | int | str | None] = {"exposure": exposure, "reachable_share": possible.share}
    if options.adapt > 0:
        adapted, cut_off, kept = adapt_gently(transport, wanted, black, white=exposure, most=options.adapt, drive=drive)
        wanted, possible = adapted.target, adapted.after
        told |= {"contrast_kept_cut_off": cut_off, "contrast_kept": kept, "adapted_share": possible.share}
    target = target_radiance(wanted, black, 1.0)
    began_s = time.perf_counter()
    if options.base == "high-pass":
        image = high_pass_base(transport, base.image, target, black)
        base = solve_base(
            transport, image, black, smoothness=options.smoothness, progress=progress, cancelled=cancelled
        )
    made = make_appearance(
        transport,
        base,
        target,
        black,
        mode=options.mode,
        smoothness=options.smoothness,
        weights=appearance_weights(target, possible.reachable, exposure),
        progress=progress,
        cancelled=cancelled,
    )
    told |= {
        "mode": made.mode,
        "seconds": time.perf_counter() - began_s,
        "fine_detail": made.fine_detail,
        "advice": GO_FULL if made.mode == "scale" and made.fine_detail >= FINE_DETAIL else None,
        "iterations": 0 if made.solution is None else made.solution.iterations,
        "kkt": None if made.solution is None else made.solution.kkt,
    }
    return Answer(made.frames, wanted, possible.reachable & asked.mask, told)
