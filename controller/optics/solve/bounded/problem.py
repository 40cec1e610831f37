"""What a bounded solve is given, its equations as sweeps and regions share them, and its result."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from controller.core.arrays import FloatImage
from controller.optics.transport import LightTransport
from controller.optics.transport.planes import planes_above

EdgeWeights = npt.NDArray[np.uint16]
"""Squared weights of the smoothness edges (3, pixels), in steps of 1 / EDGE_WEIGHT_STEPS (docs/decisions/0004)."""


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


@dataclass(frozen=True, slots=True)
class SolveInput:
    """What an engine is asked to solve; ``solver.solve_bounded`` says what each means, and has checked it."""

    transport: LightTransport
    target: FloatImage
    black: FloatImage
    smoothness: float
    weights: FloatImage | None
    start: Sequence[FloatImage] | None


@dataclass(frozen=True, slots=True)
class Solution:
    """Result of a solve.

    ``frames``: one (rows, columns, 3) float32 linear image a projector, in [0, 1]
    ``objective``: weighted squared residual plus smoothness, in camera units squared
    ``kkt``: rms of the last projected, scaled gradient step, in units of projector light; 0 at the optimum
    ``converged``: the KKT residual fell below the tolerance before the cap on iterations
    """

    frames: tuple[FloatImage, ...]
    objective: float
    kkt: float
    iterations: int
    seconds: float
    converged: bool
