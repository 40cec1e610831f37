"""The data of one bounded solve, as the solver, its sweeps and the regions share it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from controller.core.arrays import FloatImage
from controller.transport import LightTransport
from controller.transport.planes import planes_above

EdgeWeights = npt.NDArray[np.uint16]
"""Squared weights of the smoothness edges (3, pixels), in steps of 1 / EDGE_WEIGHT_STEPS (docs/decisions/0055)."""


@dataclass(frozen=True, slots=True)
class Problem:
    """Data of one solve on planes; smoothness is already scaled by its strength.

    ``picture``, ``black`` (camera rows, columns, 3): what is wanted, and the black image; not copies
    ``weights`` (camera rows, columns): 0 off the object
    ``across``, ``down`` (3, pixels of all projectors) uint16: squared weights of the smoothness edges to the right
    and lower neighbour, in steps of 1 / EDGE_WEIGHT_STEPS
    ``strength_per_step``: factor in the objective of an edge whose stored weight is 1
    ``majoriser`` (3, pixels): the diagonal that bounds each projector's own Hessian, 0 where a pixel lights nothing
    """

    transport: LightTransport
    picture: FloatImage
    black: FloatImage
    weights: FloatImage
    across: EdgeWeights
    down: EdgeWeights
    strength_per_step: float
    majoriser: FloatImage

    def target(self) -> FloatImage:
        """(3, camera rows, columns): the light to be made. A new array each time: a sweep does not need it."""
        return planes_above(self.picture, self.black)
