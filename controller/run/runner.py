"""Runs steps in order: each once, with a deadline, stoppable at any time, resumed from the journal.

Steps that only calculate run beside later ones that use devices, so that a camera need not wait for them. The time
that a step takes is estimated from the last runs of its kind.
"""

from __future__ import annotations

import contextlib
import statistics
import time
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Final

from controller.core.errors import VelaturaError, WorkError
from controller.run.background import Advance, BackgroundSteps
from controller.run.journal import Artefact, Journal
from controller.run.progress import Reporter, Silent, Tracker
from controller.run.state_machine import Event, Machine
from controller.run.step_id import StepId, input_name
from hal.deadline import Cancelled, Deadline
from hal.errors import CodedError, DeviceError
from hal.notices import Level
from hal.runtime.compute import threads_may_compute


@dataclass(frozen=True, slots=True)
class Context:
    """Argument of a step's ``run``.

    ``folder`` for artefacts; ``results`` the artefacts of earlier steps. ``advance`` also raises on a stop
    request, so a long step calls it often.
    """

    folder: Path
    journal: Journal
    deadline: Deadline
    reporter: Reporter
    results: Mapping[StepId, tuple[Artefact, ...]]
    _advance: Callable[[float, str], None] = field(repr=False)

    def advance(self, fraction: float, note: str = "") -> None:
        """Report progress. Raises Cancelled, or WorkError("run-too-slow") once the deadline has passed."""
        self.check()
        self._advance(fraction, note)

    def check(self) -> None:
        """Raise Cancelled, or WorkError("run-too-slow") once the deadline has passed."""
        check(self.deadline)

    def paths(self, step: StepId) -> tuple[Path, ...]:
        """The artefacts of an earlier step, in the order in which it returned them."""
        return tuple(artefact.path for artefact in self.results[step])


@dataclass(frozen=True, slots=True)
class Step:
    """One piece of work that ends with artefacts.

    Parameters
    ----------
    id : its identity in the journal, unique in its run
    run : does the work, writes its artefacts atomically (``controller.core.storage``) and returns their paths
    inputs : name -> hash of everything outside the run that the result depends on: settings, files, code version
    after : earlier steps whose artefacts it reads; their hashes become inputs too
    weight : expected cost relative to the other steps; seconds on the reference machine
    title : the text for the technician; the identity if empty
    enter, leave : machine events at the start and end of the work; none for a skipped step
    always : run it even if an earlier run did it. For steps that set the state of hardware, which can't be
        restored from the journal
    calculates : it uses no device, so it may run beside later steps that do not read from it. It has no ``enter`` or
        ``leave``
    unsteady : it may be done before lamps are stable, and reads from no earlier step
    """

    id: StepId
    run: Callable[[Context], Sequence[Path]]
    inputs: Mapping[str, str] = field(default_factory=dict)
    after: tuple[StepId, ...] = ()
    weight: float = 1.0
    title: str = ""
    enter: Event | None = None
    leave: Event | None = None
    always: bool = False
    calculates: bool = False
    unsteady: bool = False

    @property
    def heading(self) -> str:
        """Its title for the technician."""
        return self.title or str(self.id)


_Results = dict[StepId, tuple[Artefact, ...]]


class Runner:
    """Runs a list of steps against one journal.

    Parameters
    ----------
    machine : gets ``Step.enter`` and ``Step.leave``; CANCEL when the run is stopped; FAIL, with the reason,
        when a device fails (other failures of the work are a CANCEL with the reason: the lamps are fine)
    """

    def __init__(
        self,
        steps: Sequence[Step],
        journal: Journal,
        *,
        reporter: Reporter | None = None,
        machine: Machine | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._steps = tuple(steps)
        _check_order(self._steps)
        self._journal = journal
        self._reporter = reporter or Silent()
        self._machine = machine
        self._clock = clock

    def run(self, name: str, *, deadline: Deadline) -> dict[StepId, tuple[Artefact, ...]]:
        """Run or continue the steps; return the artefacts of each.

        Raises what a step raises, after journalling it; Cancelled when ``deadline.cancel`` is set, and
        WorkError("run-too-slow") when the deadline passes, in both cases between two steps or at a step's ``advance``.
        """
        titles = [step.heading for step in self._steps]
        took_before = measured(self._journal.folder, [step.id for step in self._steps])
        weights = [step.weight for step in self._steps]
        tracker = Tracker(titles, weights, self._reporter, self._clock, took_before)
        results: _Results = {}

        def calculate(index: int, advance: Advance, until: Deadline) -> bool:
            return self._one(self._steps[index], results, lambda: None, advance, until)

        beside = BackgroundSteps(calculate, deadline)
        with self._journal.run(name):
            try:
                with beside.ending():
                    self._all(results, tracker, beside, deadline)
            except BaseException as error:
                self._failed(error)
                raise
        return results

    def _all(self, results: _Results, tracker: Tracker, beside: BackgroundSteps, deadline: Deadline) -> None:
        """All steps; one that calculates in the thread beside, as long as a step that uses devices follows.

        All in order where two threads may not run kernels: the step that photographs may run one, too.
        """

        def advance(fraction: float, note: str = "") -> None:
            beside.check()
            tracker.advance(fraction, note)

        last = max((index for index, step in enumerate(self._steps) if not step.calculates), default=-1)
        in_thread = any(step.calculates for step in self._steps[: last + 1]) and threads_may_compute()
        for index, step in enumerate(self._steps):
            check(deadline)
            if step.calculates and index < last and in_thread:
                beside.begin(index, step.id)
                continue
            self._await(beside, step.after, tracker, deadline)
            if self._one(step, results, partial(tracker.begin, index), advance, deadline):
                tracker.end()
            else:
                tracker.skip(index)
        self._await(beside, None, tracker, deadline)

    def _await(
        self, beside: BackgroundSteps, steps: Sequence[StepId] | None, tracker: Tracker, deadline: Deadline
    ) -> None:
        """Until ``steps`` (None: all) that run beside are done; count what is done by now."""
        shown: int | None = None
        while True:
            for number, done_now in beside.finished():
                if not done_now:
                    tracker.skip(number)
                elif number == shown:
                    tracker.end()
                else:
                    tracker.done_beside(number)
            if (running := beside.awaited(steps)) is None:
                return
            check(deadline)
            if running[0] != shown:
                shown = running[0]
                tracker.begin(shown)
            tracker.advance(running[1])
            beside.wait()

    def _one(
        self, step: Step, results: _Results, begin: Callable[[], None], advance: Advance, deadline: Deadline
    ) -> bool:
        """Do a step, or take what an earlier run did; whether it was done now."""
        inputs = self._inputs(step, results)
        if not step.always and (done := self._journal.done(step.id, inputs)) is not None:
            results[step.id] = done
            return False
        begin()
        self._report(step.enter, step.heading)
        began_at_s = time.time()
        context = Context(self._journal.folder, self._journal, deadline, self._reporter, results.copy(), advance)
        paths = step.run(context)
        results[step.id] = self._journal.complete(step.id, inputs, paths, began_at_s=began_at_s)
        self._report(step.leave, step.heading)
        return True

    def _inputs(self, step: Step, results: _Results) -> dict[str, str]:
        made = {
            input_name(earlier, number): artefact.sha256
            for earlier in step.after
            for number, artefact in enumerate(results[earlier])
        }
        return {**step.inputs, **made}

    def _report(self, event: Event | None, reason: str) -> None:
        if self._machine is not None and event is not None:
            self._machine.handle(event, reason)

    def _failed(self, error: BaseException) -> None:
        """Journal the failure and report it to the machine; errors here must not hide ``error``."""
        stopped = isinstance(error, Cancelled)
        broken = isinstance(error, DeviceError) and not stopped
        code = error.code if isinstance(error, CodedError) else type(error).__name__
        text = error.what if isinstance(error, CodedError) else str(error)
        try:
            self._journal.record(code, text, Level.INFO if stopped else Level.ERROR)
            event = Event.FAIL if broken else Event.CANCEL
            if self._machine is not None and self._machine.allows(event):
                self._machine.handle(event, text)
        except VelaturaError as second:
            error.add_note(f"The error could not be written to the journal: {second}")


def check(deadline: Deadline) -> None:
    """Raise Cancelled if a stop is requested, WorkError("run-too-slow") after the deadline."""
    if deadline.cancel is not None and deadline.cancel.is_set():
        raise Cancelled
    if deadline.passed:
        raise WorkError(
            "run-too-slow",
            what="The run took longer than its time limit.",
            remedy="Start it again to continue after the last finished step.",
        )


def _check_order(steps: Sequence[Step]) -> None:
    seen: set[StepId] = set()
    for step in steps:
        if step.id in seen or not seen.issuperset(step.after):
            raise ValueError(f"step {str(step.id)!r} is there twice, or stands before a step that it reads from")
        seen.add(step.id)


RUNS: Final = 3
"""So many runs of the same kind are asked, the newest first."""


def measured(run: Path, steps: Sequence[StepId]) -> list[float | None]:
    """Seconds that each step took in the last runs of this kind beside ``run`` (DATE-TIME-KIND); None: not known.

    A step that no run had (a new appearance) takes as long as the others of its kind.
    """
    kind = run.name.rpartition("-")[2]
    same: defaultdict[StepId, list[float]] = defaultdict(list)
    alike: defaultdict[str, list[float]] = defaultdict(list)
    others = (path for path in sorted(run.parent.glob(f"*-*-{kind}"), reverse=True) if path != run)
    for folder in [path for path in others if (path / Journal.FILE).is_file()][:RUNS]:
        # A journal that can't be read only makes the estimate worse.
        with contextlib.suppress(VelaturaError), Journal(folder) as journal:
            for step, seconds in journal.steps().items():
                same[step].append(seconds)
                alike[step.kind].append(seconds)
    found = [same.get(step) or alike.get(step.kind) for step in steps]
    return [None if seconds is None else max(0.01, statistics.median(seconds)) for seconds in found]
