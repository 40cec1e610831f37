"""Sweeps over the projectors, one after the other, with momentum: the work of the bounded solver.

Each projector takes a projected gradient step against what the others show by then, scaled by a diagonal that bounds
its own part of the Hessian alone; with n projectors alike that is n times as far as a step of all at once could go.
Momentum carries on from sweep to sweep, with part of the sweep's own step again (Kim and Fessler 2016), and starts anew
where it points uphill (O'Donoghue and Candes 2015). What the constants are worth: docs/decisions/0025.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from controller.arrays import FloatImage
from controller.errors import WorkError
from controller.solve.gradient import carry_on, extrapolate, projected_step
from controller.transport import LightTransport

if TYPE_CHECKING:
    from controller.solve.bounded import Problem

MOST_GROWTH: Final = 5.0
"""Without momentum sweeps never go uphill; with it nothing is proven, so it ends where the residual grows as much."""
AGAIN: Final = 0.9
"""Part of a sweep's step that is taken once more: 1 is optimal for steps of all at once, and too far from 1.2 on."""
AFRESH: Final = 50
"""Sweeps until light is worked out from the frames again: sums of steps drift, by 1e-4 of the objective in 1000."""


@dataclass(frozen=True, slots=True)
class Watch:
    """When to stop, and whom to tell; see ``solve_bounded``.

    ``look`` is shown each sweep's point (3, pixels), to be read before it returns
    """

    tolerance: float
    most_iterations: int
    progress: Callable[[int, float], None] | None = None
    cancelled: Callable[[], bool] | None = None
    look: Callable[[int, FloatImage], None] | None = None


def descend(problem: Problem, x: FloatImage, watch: Watch) -> tuple[FloatImage, float, int]:
    """Sweep from ``x`` (3, pixels), which is overwritten; returns the last point, its KKT residual and the sweeps."""
    transport = problem.transport
    aim = transport.aim(problem.wanted, problem.weights)
    light, ahead, before, residual = transport.sheet(), transport.sheet(), transport.sheet(), np.empty_like(aim)
    y, new, step = x.copy(), np.empty_like(x), np.empty_like(x)
    total = max(float(problem.majoriser.sum(dtype=np.float64)), np.finfo(np.float64).tiny)
    inertia, kkt, least, iteration = 1.0, np.inf, np.inf, 0
    for iteration in range(1, watch.most_iterations + 1):
        if watch.cancelled is not None and watch.cancelled():
            raise WorkError("solve-cancelled", what="The solve was stopped.", remedy="Start it again when wanted.")
        squared_step = uphill = 0.0
        if iteration % AFRESH == 1:
            _show(transport, x, light)
            ahead[:] = light
            if iteration > 1:
                _show(transport, y, ahead)
        before[:] = ahead
        for n, (rows, columns) in enumerate(transport.sizes):
            transport.weigh(ahead, problem.weights, aim, residual)
            transport.pull(n, residual, step)
            start = transport.span(n).start
            ties = problem.majoriser, problem.across, problem.down
            a, b = projected_step(y, x, step, *ties, start, rows, columns, new)
            squared_step, uphill = squared_step + a, uphill + b
            transport.add_light(n, step, ahead)
        kkt = float(np.sqrt(squared_step / total))
        following = (1 + np.sqrt(1 + 4 * inertia**2)) / 2
        momentum, again = (inertia - 1) / following, AGAIN * inertia / following
        inertia = following
        least = min(least, kkt)
        if uphill > 0 or kkt > MOST_GROWTH * least:
            momentum, again, inertia = 0.0, 0.0, 1.0
        if watch.look is not None:
            watch.look(iteration, new)
        extrapolate(new, x, step, momentum, again, y)
        x, new = new, x
        # the sheets follow: ``ahead`` is the light of the new point by now, and becomes that of y
        carry_on(ahead.reshape(-1), light.reshape(-1), before.reshape(-1), momentum, again)
        if watch.progress is not None:
            watch.progress(iteration, kkt)
        if kkt <= watch.tolerance:
            break
    return x, kkt, iteration


def _show(transport: LightTransport, x: FloatImage, sheet: FloatImage) -> None:
    """Write the light of ``x`` (3, pixels) to a sheet."""
    sheet[:] = 0
    for n in range(len(transport.sizes)):
        transport.add_light(n, x, sheet)
