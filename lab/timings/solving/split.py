"""One solve of a façade on several workers: its time against one worker, and its objective against the whole solve.

A part of it (``split_parts``), its equations, frames and light stay on their worker; only light at borders is sent. All
workers are processes of this computer, each with one thread. Where it has fewer cores than workers, the processor time
says more than the clock: of each turn, that of the worker that takes longest.
"""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

import dask
import numpy as np
from distributed import Client, LocalCluster
from numba import set_num_threads

from controller.core.arrays import FloatImage
from controller.optics.solve.bounded.engine import MOST_GROWTH, OVERRELAXATION
from controller.optics.solve.bounded.equations import (
    MOST_ITERATIONS,
    TOLERANCE,
    SolveSettings,
    build_problem,
    objective_of,
)
from controller.optics.solve.bounded.solver import solve_bounded
from controller.optics.transport.views import ViewsTransport
from hal.runtime.compute import usable_cpus
from lab.timings import Row, at_least, at_most
from lab.timings.tools.facade import facade_solve
from lab.timings.tools.split_parts import (
    Places,
    State,
    Swept,
    advanced,
    first_state,
    part_problem,
    parts_of,
    sweep_part,
    turns,
)

FACADES: Final = {"small": (4, 2, (52, 70)), "medium": (16, 4, (52, 70)), "paper": (16, 4, (210, 280))}
"""Cameras, projectors for each, and (rows, columns) of a projector."""
WORKERS: Final = (1, 2, 4)
NEAR: Final = 1e-3
"""Of the whole solve's objective."""


@dataclass(frozen=True, slots=True)
class Split:
    """``busy_s``: processor time of the sweeps if each worker had a core; ``border``: samples sent in a sweep."""

    objective: float
    kkt: float
    sweeps: int
    seconds: float
    busy_s: float
    border: int


def solve_split(
    client: Any, transport: ViewsTransport, target: FloatImage, black: FloatImage, tolerance: float = TOLERANCE,
    most_sweeps: int = MOST_ITERATIONS,
) -> Split:  # fmt: skip
    """As ``solve_bounded``, in parts."""
    began_s, sheet, parts = time.perf_counter(), transport.sheet, parts_of(transport)
    whole = build_problem(transport, target, black, SolveSettings().smoothness, None)
    addresses = sorted(client.scheduler_info(n_workers=-1)["workers"])
    order = turns(parts)
    # Those of one turn on all workers.
    at = {g: addresses[i % len(addresses)] for together in order for i, g in enumerate(together)}
    borders = [
        [(h, *part.border(other)) for h, other in enumerate(parts) if h != g and part.border(other)[0].size]
        for g, part in enumerate(parts)
    ]

    def there(g: int, function: Callable[..., Any], *arguments: Any) -> Any:
        return client.submit(function, *arguments, workers=[at[g]], pure=False)

    sent = [client.scatter(part, workers=[at[g]], hash=False) for g, part in enumerate(parts)]
    problems = [
        there(g, part_problem, sent[g], part.seen(sheet, target), part.seen(sheet, black), None,
              whole.strength_per_step)
        for g, part in enumerate(parts)
    ]  # fmt: skip
    states = [there(g, first_state, *pair) for g, pair in enumerate(zip(sent, problems, strict=True))]
    total, inertia, kkt, least, busy_s, sweep = (
        float(whole.majoriser.sum(dtype=np.float64)),
        1.0,
        np.inf,
        np.inf,
        0.0,
        0,
    )
    while kkt > tolerance and sweep < most_sweeps:
        sweep, shown = sweep + 1, list(states)
        for g in (g for together in order for g in together):
            beside = [(places, there(h, _light, shown[h], of)) for h, places, of in borders[g]]
            shown[g] = there(g, sweep_part, sent[g], problems[g], states[g], beside)
        told = client.gather([there(g, _told, one) for g, one in enumerate(shown)])
        for together in order:
            of_worker: dict[str, float] = defaultdict(float)
            for g in together:
                of_worker[at[g]] += told[g][2]
            busy_s += max(of_worker.values())
        kkt = float(np.sqrt(sum(one[0] for one in told) / total))
        following = (1 + np.sqrt(1 + 4 * inertia**2)) / 2
        momentum, over, inertia = (inertia - 1) / following, OVERRELAXATION * inertia / following, following
        least = min(least, kkt)
        if sum(one[1] for one in told) > 0 or kkt > MOST_GROWTH * least:
            momentum, over, inertia = 0.0, 0.0, 1.0
        states = [there(g, advanced, states[g], shown[g], momentum, over) for g in range(len(parts))]
    x = np.zeros((3, transport.pixels), np.float32)
    for part, state in zip(parts, client.gather([there(g, _point, one) for g, one in enumerate(states)]), strict=True):
        x[:, part.own] = state
    border = sum(places.size for one in borders for _, places, _ in one)
    objective = objective_of(whole, x, transport.forward_planes(x))
    return Split(objective, kkt, sweep, time.perf_counter() - began_s, busy_s, border)


def _light(one: State | Swept, places: Places) -> FloatImage:
    return one.light_y[places]


def _told(swept: Swept) -> tuple[float, float, float]:
    return swept.squared, swept.uphill, swept.seconds


def _point(state: State) -> FloatImage:
    return state.x


def measure(size: str) -> list[Row]:
    """The whole solve here with one thread, and split on 1, 2 and 4 workers."""
    cameras, each, pixels = FACADES[size]
    transport, target, black = facade_solve(cameras, each, pixels)
    set_num_threads(1)
    solve_bounded(transport, target, black, SolveSettings(most_iterations=1))  # compiles
    began_s = time.process_time()
    whole = solve_bounded(transport, target, black)
    whole_s = time.process_time() - began_s
    what = f"{cameras} cameras, {cameras * each} projectors of {pixels[1]}x{pixels[0]}"
    rows = [at_most(f"{what}, whole", whole_s, None, unit="s", how=f"processor time; {whole.iterations} sweeps")]
    first: Split | None = None
    for workers in WORKERS:
        environment = {"distributed.nanny.pre-spawn-environ": {"NUMBA_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}}
        with (
            dask.config.set(environment),
            LocalCluster(n_workers=workers, threads_per_worker=1, dashboard_address=":0") as cluster,  # type: ignore[no-untyped-call]
            Client(cluster, set_as_default=False) as client,  # type: ignore[no-untyped-call]
        ):
            if workers == 1:
                solve_split(client, transport, target, black, most_sweeps=1)  # compiles
            split = solve_split(client, transport, target, black, 0.0, whole.iterations)
        first = first or split
        apart = abs(split.objective / whole.objective - 1)
        sent = f"{split.sweeps} sweeps; {4 * split.border / 1e6:.2g} MB of borders in each"
        clock = f"by the clock {split.seconds:.3g} s on {usable_cpus()} cores, {first.seconds / split.seconds:.2g} x"
        rows += [
            at_most(f"{workers} workers, objective apart from the whole", apart, NEAR, unit="", how=sent),
            at_least(f"{workers} workers, times as fast as 1", first.busy_s / split.busy_s, None, unit="x",
                     how=f"processor time {split.busy_s:.3g} s with a core each; {clock}"),
        ]  # fmt: skip
    return rows
