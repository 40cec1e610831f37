"""Solves a run's appearances on other machines; each is still its own step. A worker gets the stage once."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Sequence

from controller.optics.solve.request import AppearanceResult, SolveOptions
from controller.optics.solve.targets.values import Target
from controller.run.runner import Context
from controller.stage.artefacts.calibrated import Calibrated
from controller.stage.cluster import Cluster, StageData, Task, connected, make_there
from controller.stage.steps.appearance.solving import Answering, AppearanceRequest


class SpreadAppearances:
    """Starts appearances elsewhere, and gives their results by name."""

    def __init__(self, cluster: Cluster, stage: StageData) -> None:
        key = f"velatura-stage-{stage.digest()}"
        self._key, self._cluster = key, cluster
        self._stage = cluster.share(key, stage)
        self._begun: dict[str, Task[AppearanceResult]] = {}

    def begin(self, name: str, asked: Target, options: SolveOptions) -> None:
        """Start an appearance, unless it was started already."""
        if name not in self._begun:
            self._begun[name] = self._cluster.submit(make_there, self._stage, self._key, asked, options)

    def answer(self, name: str, check: Callable[[], None]) -> AppearanceResult:
        """The result of a started one; errors as ``solve.request.solve_appearance`` and ``Task.result``."""
        return self._begun.pop(name).result(check)

    def cancel(self) -> None:
        """Cancel all that were started and not fetched."""
        for task in self._begun.values():
            task.cancel()
        self._begun.clear()


class ClusterSolve:
    """Solves like ``steps.appearance.solving``; the first request also submits those that follow.

    Requests with a step before their solving (Blender's) are submitted when it is their turn.
    """

    def __init__(self, cluster: Cluster, calibrated: Calibrated, requests: Sequence[AppearanceRequest]) -> None:
        self._cluster, self._calibrated, self._requests = cluster, calibrated, tuple(requests)
        self._spread: SpreadAppearances | None = None

    def __call__(self, request: AppearanceRequest, options: SolveOptions, context: Context) -> AppearanceResult:
        """The result of one request."""
        context.advance(0.0, f"{self._cluster.workers} workers")
        spread = self._spread or self._opened()
        names = [other.name for other in self._requests]
        for other in self._requests[names.index(request.name) :]:
            if other.name == request.name or other.prepare is None:
                context.check()
                spread.begin(other.name, other.target(), options)
        return spread.answer(request.name, context.check)

    def _opened(self) -> SpreadAppearances:
        base, calibration = self._calibrated.base, self._calibrated.calibration
        indirect = self._calibrated.reflected
        stage = StageData(self._calibrated.transport, base.image, base.solution, calibration.black, indirect)
        self._spread = SpreadAppearances(self._cluster, stage)
        return self._spread

    def cancel(self) -> None:
        """Cancel the requests that are still running."""
        if self._spread is not None:
            self._spread.cancel()


@contextlib.contextmanager
def answering_on(
    scheduler: str | None, calibrated: Calibrated, requests: Sequence[AppearanceRequest]
) -> Iterator[Answering | None]:
    """Solves appearances on the cluster of ``scheduler``; None without a scheduler.

    Raises what ``cluster.connect.connected`` raises.
    """
    if scheduler is None:
        yield None
        return
    with connected(scheduler) as cluster:
        spreading = ClusterSolve(cluster, calibrated, requests)
        try:
            yield spreading
        finally:
            spreading.cancel()
