"""How long to expose: by photographs of white, which are not kept."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

from controller.core.arrays import ByteImage
from controller.core.errors import CalibrationError
from controller.optics.capture.acquire import Shot
from controller.optics.capture.brackets import choose_brackets
from controller.optics.capture.jpeg_response import nominal_response
from controller.optics.capture.latency import LONGEST_S
from controller.optics.capture.raw import read_photograph
from controller.run.runner import Context
from controller.stage.artefacts.names import CAPTURES
from controller.stage.rig.rig import Rig, RigProjector

FIRST_EXPOSURE_S: Final = 1 / 30
TRIES: Final = 8


@dataclass(frozen=True, slots=True)
class White:
    """White of some projectors. ``named``: these, for people; ``first_s``: the exposure that is tried first."""

    projectors: Sequence[RigProjector]
    named: str
    first_s: float = FIRST_EXPOSURE_S

    def frames(self) -> dict[str, ByteImage]:
        """By projector name."""
        return {projector.name: projector.white() for projector in self.projectors}


def white_exposures(rig: Rig, context: Context, white: White, longest_s: float, *, most: int) -> tuple[float, ...]:
    """At most ``most`` exposures of the camera, up to ``longest_s``, that measure ``white``, in rising order.

    At the first one white is just not clipped. Raises CalibrationError("exposure-not-found").
    """
    available = [value for value in rig.acquirer.exposures_s() if value <= longest_s]
    exposure_s = bracket(white.first_s, (1.0,), rig.acquirer.exposures_s(), longest_s)[0]
    frames: Mapping[str, ByteImage] = rig.on_outputs(white.frames())
    for number in range(TRIES):
        context.check()
        shot = Shot(f"try-{number}", frames, exposure_s)
        # Before the display's delay is known, the first photograph of this white waits for the longest possible.
        wait_s = LONGEST_S if number == 0 and not rig.acquirer.protected else None
        file, confirmed_s = rig.acquirer.take(shot, context.folder / CAPTURES, deadline=context.deadline, wait_s=wait_s)
        image = read_photograph(file.path, response=nominal_response()).measured()
        file.path.unlink()
        choice = choose_brackets(image, confirmed_s, available, most=most)
        exposure_s = choice.exposures_s[0]
        if choice.settled:
            return choice.exposures_s
    rig.check_light(deadline=context.deadline, stable=False)  # a longer exposure does not help with a dead lamp
    raise CalibrationError(
        "exposure-not-found",
        what=f"No exposure suits the white light of {white.named}.",
        remedy="Check that it lights the object and the room is dark. Check the camera's aperture and ISO.",
    )


def bracket(base_s: float, factors: Sequence[float], available_s: Sequence[float], longest_s: float) -> list[float]:
    """Distinct exposures of the camera, each the nearest to ``base_s`` times a factor, none above ``longest_s``."""
    usable = [value for value in available_s if value <= longest_s] or [min(available_s)]
    return sorted({min(usable, key=lambda value: abs(math.log(value / (base_s * factor)))) for factor in factors})


__all__ = ["White", "bracket", "white_exposures"]
