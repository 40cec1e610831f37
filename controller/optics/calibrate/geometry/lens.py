"""How far a lens bends its picture."""

from __future__ import annotations

from typing import Final

import numpy as np

from controller.optics.calibrate.values import Pinhole

NAMED_PX: Final = 0.5
"""At the farthest corner: less is not seen."""


def bend_px(lens: Pinhole) -> float:
    """Pixels by which distortion displaces the corner that it displaces most."""
    width, height = lens.size_px
    corners = np.array([(x, y) for x in (0, width) for y in (0, height)], np.float64)
    focal = lens.matrix[[0, 1], [0, 1]]
    squared = np.sum(((corners - lens.matrix[:2, 2]) / focal) ** 2, axis=1)
    k1, k2 = lens.distortion
    return float(np.max(np.abs(k1 * squared + k2 * squared**2) * np.sqrt(squared)) * focal.mean())


def bent(name: str, lens: Pinhole) -> str | None:
    """What a technician should know of a projector's lens; None where its picture is as good as straight."""
    by_px = bend_px(lens)
    if by_px < NAMED_PX:
        return None
    return (
        f"The lens of projector {name} bends its picture, by up to {by_px:.1f} pixels at a corner. The geometry takes "
        "that into account. Nothing has to be done."
    )


__all__ = ["bend_px", "bent"]
