"""Solves the appearances of one stage on a cluster. A worker gets the stage once, then only targets."""

from __future__ import annotations

from collections.abc import Callable

from controller.optics.solve.request import AppearanceResult, SolveOptions
from controller.optics.solve.targets.values import Target
from controller.stage.cluster.connect import Cluster, Task
from controller.stage.cluster.tasks import StageData, make_there


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
