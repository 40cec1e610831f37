"""Solves a run's appearances on other machines; each is still its own step. A worker gets the stage once."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Final

from controller.core.errors import VelaturaError, WorkError
from controller.optics.solve.bounded.engine import Processor
from controller.optics.solve.request import AppearanceResult, SolveOptions
from controller.optics.solve.targets.values import Target
from controller.run.runner import Context
from controller.stage.artefacts.calibrated import Calibrated
from controller.stage.cluster import Cluster, Shared, StageData, Task, connected, make_there
from controller.stage.steps.appearance.solving import Answering, AppearanceRequest, answer_here


class SpreadAppearances:
    """Starts appearances elsewhere, and gives their results by name. ``stage`` is asked for at the first one."""

    def __init__(self, cluster: Cluster, stage: Callable[[], StageData]) -> None:
        self.cluster, self._data = cluster, stage
        self._stage: Shared | None = None
        self._begun: dict[str, Task[AppearanceResult]] = {}

    def begin(self, name: str, asked: Target, options: SolveOptions) -> None:
        """Start an appearance, unless it was started already."""
        if name not in self._begun:
            stage = self._stage = self._stage or Shared(self._data())
            self._begun[name] = self.cluster.submit(make_there, stage, asked, options)

    def answer(self, name: str, check: Callable[[], None]) -> AppearanceResult:
        """The result of a started one; errors as ``solve.request.solve_appearance`` and ``Task.result``."""
        return self._begun.pop(name).result(check)

    def cancel(self) -> None:
        """Cancel all that were started and not fetched."""
        for task in self._begun.values():
            task.cancel()
        self._begun.clear()


def _answer_spread(
    spread: SpreadAppearances,
    requests: Sequence[AppearanceRequest],
    request: AppearanceRequest,
    options: SolveOptions,
    context: Context,
) -> AppearanceResult:
    """An ``Answering``; the first request also submits those that follow, but for those with a step before their
    solving (Blender's).
    """
    context.advance(0.0, f"{spread.cluster.workers} workers")
    names = [other.name for other in requests]
    for other in requests[names.index(request.name) :]:
        if other.name == request.name or other.prepare is None:
            context.check()
            spread.begin(other.name, other.target(), options)
    return spread.answer(request.name, context.check)


def _stage_data(calibrated: Calibrated) -> StageData:
    return StageData(calibrated.transport, calibrated.calibration.black, calibrated.reflected)


_LOST: Final = ("no-workers", "workers-lost")
"""In the morning, when the stages open."""


@contextlib.contextmanager
def answering_on(
    scheduler: str | None, calibrated: Calibrated, requests: Sequence[AppearanceRequest], stage: Path
) -> Iterator[Answering]:
    """Solves appearances on the cluster of ``scheduler``; without one on that of the house of ``stage``, if it has
    workers now; else here.

    Raises what ``cluster.connected`` raises, of ``scheduler`` alone.
    """
    here = partial(answer_here, calibrated)
    with contextlib.ExitStack() as stack:
        if scheduler is not None:
            cluster = stack.enter_context(connected(scheduler))
        else:
            # A graphics processor is faster than they are.
            of_house = _cluster_of_house(stage, stack) if isinstance(calibrated.engine, Processor) else None
            if of_house is None:
                yield here
                return
            cluster = of_house
        spread = SpreadAppearances(cluster, partial(_stage_data, calibrated))
        stack.callback(spread.cancel)
        there = partial(_answer_spread, spread, requests)
        yield there if scheduler is not None else partial(_answer_there, there, here)


def _cluster_of_house(stage: Path, stack: contextlib.ExitStack) -> Cluster | None:
    """None where there is none, or none that can solve for this stage now."""
    try:
        from controller.stage.link.peers import peer, peer_folder, scheduler_at, tls_files
    except ModuleNotFoundError:  # an extra
        return None
    with contextlib.suppress(OSError, VelaturaError):
        member = peer(peer_folder(stage))
        if member is not None and (address := scheduler_at(member)) is not None:
            return stack.enter_context(connected(address, workers_s=0, tls=tls_files(member)))
    return None


def _answer_there(
    there: Answering, here: Answering, request: AppearanceRequest, options: SolveOptions, context: Context
) -> AppearanceResult:
    try:
        return there(request, options, context)
    except WorkError as error:
        if error.code not in _LOST:
            raise
        context.reporter.say(f"{error.what} {request.title} is solved here.")
        return here(request, options, context)
