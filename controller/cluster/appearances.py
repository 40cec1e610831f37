"""Appearances of one stage, spread over a cluster: the stage goes to a worker once, then only targets and frames."""

from __future__ import annotations

from collections.abc import Callable

from controller.cluster.connect import Cluster, Task
from controller.cluster.tasks import StageData, make_there
from controller.solve.request import AppearanceResult, SolveOptions
from controller.solve.targets.values import Target


class SpreadAppearances:
    """Begins appearances anywhere, and gives their answers by name."""

    def __init__(self, cluster: Cluster, stage: StageData) -> None:
        key = f"velatura-stage-{stage.digest()}"
        self._key, self._cluster = key, cluster
        self._stage = cluster.share(key, stage)
        self._begun: dict[str, Task[AppearanceResult]] = {}

    def begin(self, name: str, asked: Target, options: SolveOptions) -> None:
        """Begin an appearance, unless one of that name has been."""
        if name not in self._begun:
            self._begun[name] = self._cluster.submit(make_there, self._stage, self._key, asked, options)

    def answer(self, name: str, check: Callable[[], None]) -> AppearanceResult:
        """The answer of one that was begun; errors as ``solve.request.solve_appearance`` and ``Task.result``."""
        return self._begun.pop(name).result(check)

    def cancel(self) -> None:
        """Let go of all that was begun and not fetched."""
        for task in self._begun.values():
            task.cancel()
        self._begun.clear()
