"""Whether a lamp gives the same light in all photographs: by the steps of sinusoids, which add up to white."""

from __future__ import annotations

from typing import Final

import numpy as np

from controller.core.arrays import Float64

NAMED: Final = 0.002
"""Standard deviation from which flicker is named; steady lamps are measured with 0.0009 at most."""


def lamp_flicker(strengths: Float64 | None) -> float:
    """Standard deviation of a lamp's light from one photograph to the next, relative.

    ``strengths`` (sinusoids, steps): of ``separation.SinusoidContrast``; 0 where they are not known. Compared are the
    steps of a sinusoid: what all of them have in common, an error of the response does, too.
    """
    if strengths is None or strengths.shape[1] < 2:
        return 0.0
    off = strengths - strengths.mean(axis=1, keepdims=True)
    return float(np.sqrt(np.sum(off**2) / (off.size - len(off))))


def unsteady(name: str, flicker: float) -> str | None:
    """What a technician should know of ``lamp_flicker``; None where the lamp is steady."""
    if flicker < NAMED:
        return None
    return (
        f"The light of projector {name} is not steady: it differs by {100 * flicker:.1f} % (standard deviation) from "
        "one photograph to the next. Patterns are corrected for that; white images and brightness stay uncertain by as "
        "much. Let the lamp warm up longer, switch its automatic and dynamic lamp modes off, and calibrate again."
    )


__all__ = ["lamp_flicker", "unsteady"]
