"""The data of one bounded solve, as the solver, its sweeps and the regions share it."""

from __future__ import annotations

from dataclasses import dataclass

from controller.core.arrays import FloatImage
from controller.transport import LightTransport


@dataclass(frozen=True, slots=True)
class Problem:
    """Data of one solve on planes; smoothness is already scaled by its strength.

    ``target`` (3, camera rows, columns): the picture less black; ``weights`` (camera rows, columns): 0 off the object;
    ``across``, ``down``, ``majoriser`` (3, pixels of all projectors): squared smoothness weights to the right and lower
    neighbour, and the diagonal that bounds each projector's own Hessian, 0 where a pixel lights nothing
    """

    transport: LightTransport
    target: FloatImage
    weights: FloatImage
    across: FloatImage
    down: FloatImage
    majoriser: FloatImage
