"""The views of a run's other cameras: each does the steps of the first one, in a thread and a folder of its own."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Final

from controller.core.arrays import Float64
from controller.core.errors import CalibrationError, WorkError
from controller.core.storage import clear_unfinished_writes
from controller.run.background import EitherEvent
from controller.run.journal import Journal
from controller.run.progress import Progress, Reporter, Silent
from controller.run.runner import Context, Runner, Step
from controller.run.step_id import StepId
from controller.stage.artefacts.kinds import StepKind
from controller.stage.artefacts.projectors import Light
from controller.stage.artefacts.views import reopen_view, view_folder, write_view
from controller.stage.rig.rig import Rig
from controller.stage.rig.shared_display import Seat
from hal.deadline import SLICE_S, Cancelled, Deadline
from hal.errors import CodedError, DeviceError
from hal.notices import Level
from hal.runtime.compute import threads_may_compute

MakeSteps = Callable[[Rig, Path], Sequence[Step]]
LOOK_S: Final = 20.0
"""Longest time in which the lamps are looked at after a fault."""


class OtherViews:
    """The further cameras of ``rig`` during the run ``name`` in the folder of ``journal``.

    ``make_steps``: the steps of a view, from its rig and its folder
    A fault of one ends its view alone, with a warning that names it. All of them stop with the first view, unless that
    one lacks only its camera or its own light: then the others become whole before the error is raised.
    """

    def __init__(
        self, rig: Rig, journal: Journal, name: str, make_steps: MakeSteps, reporter: Reporter, deadline: Deadline
    ) -> None:
        self._rig, self._journal, self._name, self._reporter = rig, journal, name, reporter
        self._stop = EitherEvent(deadline.cancel)
        self._deadline = Deadline(deadline.at_s, self._stop, deadline.time)
        self._absent, self._views = dict(rig.absent), []
        for number, other in enumerate(rig.others, start=1):
            own, folder = replace(rig.seen_by(other), drawn_by=self._drawn_by), view_folder(journal.folder, other.name)
            try:
                self._views.append(_View(number, other.seat, own, make_steps, folder))
            except CodedError as error:
                self._absent[other.name] = error
        self._beside = threads_may_compute()

    def around(self, steps: Sequence[Step]) -> list[Step]:
        """The first view's ``steps``, and before and after its photographs those that start the others and wait."""
        photographs = [n for n, step in enumerate(steps) if not step.unsteady and step.enter is None]
        first = photographs[0] if photographs else len(steps)
        last = next((n for n, step in enumerate(steps) if step.leave or step.id.kind in _LAST), len(steps))
        begin = Step(StepId("views-begin"), self._begin, title="Starting the other cameras", weight=0.01, always=True)
        weight = max(0.1, 0.25 * sum(step.weight for step in steps))
        done = Step(StepId("views"), self._wait, title="Waiting for the other views", weight=weight, always=True)
        return [*steps[:first], begin, *steps[first:last], done, *steps[last:]]

    def early(self) -> list[Step]:
        """What may be measured before lamps are stable: one view after the other, because it is about the display."""
        return [
            Step(
                StepId(StepKind.DELAY, item=view.rig.view),
                partial(self._measure_early, view),
                title=f"Measuring the display's delay of view {view.rig.view}",
                weight=sum(step.weight for step in steps),
                always=True,
            )
            for view in self._views
            if (steps := view.unsteady)
        ]

    @contextlib.contextmanager
    def ending(self) -> Iterator[None]:
        """Leaves no thread behind."""
        try:
            yield
        except BaseException as error:
            self._leave()
            if not self._only_first_failed(error):
                self._stop.set()
            elif self._views:
                self._reporter.say(f"View {self._rig.view} failed; the other views become whole.", Level.WARNING)
            self._join()
            raise
        finally:
            self._leave()
            self._stop.set()
            self._join()

    def _begin(self, context: Context) -> Sequence[Path]:
        for name, error in self._absent.items():
            self._lose(name, error)
        write_view(context.folder, self._rig.view, 0, context.folder.name)
        if self._beside and self._views:
            for seat in (self._rig.seat, *(view.seat for view in self._views)):
                if seat is not None:
                    seat.join()
            for view in self._views:
                view.thread = threading.Thread(target=self._make, args=(view,), name="velatura-view", daemon=True)
                view.thread.start()
        return ()

    def _wait(self, context: Context) -> Sequence[Path]:
        self._leave()
        for view in self._views:
            if not self._beside:
                self._make(view)
            while view.thread is not None and view.thread.is_alive():
                context.advance(min(one.fraction for one in self._views), f"view {view.rig.view}")
                context.deadline.sleep(SLICE_S)
        context.check()
        return ()

    def _measure_early(self, view: _View, context: Context) -> Sequence[Path]:
        """A fault is reported by the view itself, which meets it again or not."""
        with contextlib.suppress(DeviceError, WorkError, CalibrationError):
            view.run(self._name, view.unsteady, context.deadline, Silent())
        context.check()
        return ()

    def _make(self, view: _View) -> None:
        name = view.rig.view
        try:
            reopen_view(view.folder)
            view.run(self._name, view.steps, self._deadline, _Named(view, self._reporter))
            write_view(view.folder, name, view.number, self._journal.folder.name)
        except Cancelled:
            pass
        except CodedError as error:
            self._lose(name, error)
        except Exception as error:  # noqa: BLE001 - whatever it is, the other views continue
            self._lose(name, WorkError("view-failed", what=f"{type(error).__name__}: {error}.",
                                       remedy="Report this fault."))  # fmt: skip
        finally:
            view.seat.leave()

    def _lose(self, name: str, error: CodedError) -> None:
        text = f"View {name} is not whole: {error.what} {error.remedy} The other views continue."
        if self._name == "calibrate":
            text += f" Then run `velatura calibrate STAGE --view {name}` to complete it."
        self._reporter.say(text, Level.WARNING)
        self._journal.record("view-not-whole", text, Level.WARNING)

    def _only_first_failed(self, error: BaseException) -> bool:
        if isinstance(error, Cancelled) or not isinstance(error, DeviceError | CalibrationError | WorkError):
            return False
        if isinstance(error, WorkError) and error.code != "camera-no-file":
            return False
        try:
            self._rig.check_light(deadline=self._deadline.within(LOOK_S), stable=False)
        except DeviceError:
            return False
        return True

    def _leave(self) -> None:
        if self._rig.seat is not None:
            self._rig.seat.leave()

    def _join(self) -> None:
        for view in self._views:
            if view.thread is not None:
                view.thread.join()

    def _drawn_by(self, projector: str, deadline: Deadline) -> Float64 | None:
        """The first view's response of a projector; None where that view has ended without it."""
        path = Light.path(self._journal.folder, projector)
        while not path.exists():
            if self._rig.seat is None or not self._rig.seat.joined:
                return None
            deadline.check("views-too-slow", what="The first view has measured no response.", remedy="Start again.")
            deadline.sleep(SLICE_S)
        return Light.read(self._journal.folder, projector).response


class _View:
    """One further view: its steps, and how far it is."""

    def __init__(self, number: int, seat: Seat, rig: Rig, make_steps: MakeSteps, folder: Path) -> None:
        self.number, self.seat, self.rig, self.folder = number, seat, rig, folder
        self.steps = list(make_steps(rig, folder))
        self.unsteady = [step for step in self.steps if step.unsteady]
        self.thread: threading.Thread | None = None
        self.fraction = 0.0

    def run(self, name: str, steps: Sequence[Step], deadline: Deadline, reporter: Reporter) -> None:
        with Journal(self.folder) as journal:
            clear_unfinished_writes(self.folder)
            Runner(steps, journal, reporter=reporter).run(name, deadline=deadline)


class _Named:
    """Says of which view a sentence is, and notes how far it is."""

    def __init__(self, view: _View, reporter: Reporter) -> None:
        self._view, self._reporter = view, reporter

    def progress(self, now: Progress) -> None:
        self._view.fraction = now.fraction

    def say(self, text: str, level: Level = Level.INFO) -> None:
        self._reporter.say(f"View {self._view.rig.view}: {text}", level)


_LAST: Final = ("dark-after", "take-over")
"""Kinds of steps that concern all views."""
