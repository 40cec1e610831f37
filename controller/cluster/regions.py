"""Regions of a solve, spread over a cluster in batches (paper 3.2)."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from itertools import islice
from typing import Final

from controller.arrays import Float64
from controller.cluster.connect import Cluster, Task
from controller.cluster.tasks import solve_there
from controller.solve.box_solvers import BoxProblem, BoxSolver
from controller.solve.regions import Each

BATCH: Final = 16
"""Regions a task: a task of its own for each would cost more to hand over than to solve."""
AHEAD: Final = 3
"""Batches begun a worker: enough that none waits, few enough that their equations fit into memory."""


def each_on(cluster: Cluster, *, check: Callable[[], None] = lambda: None) -> Each:
    """For ``solve_regions(each=...)``: solves on the cluster and gives the results in order; ``check`` may raise."""

    def each(solve: BoxSolver, problems: Iterable[BoxProblem]) -> Iterator[Float64]:
        waiting: deque[Task[list[Float64]]] = deque()
        left = iter(problems)
        try:
            while True:
                while len(waiting) < AHEAD * max(cluster.workers, 1) and (batch := list(islice(left, BATCH))):
                    waiting.append(cluster.submit(solve_there, solve, batch))
                if not waiting:
                    return
                yield from waiting.popleft().result(check)
        finally:
            for task in waiting:
                task.cancel()

    return each
