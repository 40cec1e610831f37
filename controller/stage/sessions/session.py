"""Gives services a stage's lock and devices while they work on the stage."""

from __future__ import annotations

import contextlib
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from controller.config.models import ONLY_CAMERA
from controller.core.storage import clear_unfinished_writes
from controller.run.compiling import kernels_compiled
from controller.run.journal import Journal
from controller.run.progress import Reporter
from controller.run.runner import Runner, Step
from controller.run.state_machine import Machine
from controller.stage.rig.ambient_light import dark_before
from controller.stage.rig.lamp_session import lit, power_steps
from controller.stage.rig.rig import Rig
from controller.stage.sessions.check import Checked
from controller.stage.sessions.open import opened_rig
from controller.stage.sessions.run import LONGEST_RUN_S, stage_lock, unfinished_run
from controller.stage.sessions.views import MakeSteps, OtherViews
from hal.deadline import Deadline, in_seconds


@dataclass(frozen=True, slots=True)
class StageWork:
    """A run on the opened stage.

    Parameters
    ----------
    name : the run's kind; an unfinished run of this name is continued
    make_steps : its steps with the lamps on, from the devices and the run's folder
    dark : refuse a bright room, if the stage has a light sensor
    plays : as in ``sessions.open.opened_rig``
    views : the other cameras do the same steps, each in the folder of its view; else the steps may use them
    place : the only view that is photographed, and its folder; a view of its own in an earlier run
    before : steps before the lamps are struck, if they are not lit yet
    """

    name: str
    make_steps: MakeSteps
    dark: bool = False
    plays: bool = False
    views: bool = False
    place: tuple[str, Path] | None = None
    before: Callable[[Rig], Sequence[Step]] = lambda rig: ()


class StageSession(ABC):
    """Work on one stage. ``stage``: its folder, which holds stage.toml."""

    stage: Path

    @abstractmethod
    def locked(self) -> contextlib.AbstractContextManager[None]:
        """For work without devices: inside, no other program works on the stage.

        Raises UsageError("already-running").
        """

    @abstractmethod
    def run(self, checked: Checked, work: StageWork, *, reporter: Reporter, cancel: threading.Event) -> Path:
        """Run the steps of a new or unfinished run with the lamps on; the run's folder.

        Those that need no stable light are done while lamps become stable, where it is the session that strikes them.

        ``checked``: the session's stage. Raises what the steps raise; UsageError("already-running") if another program
        works on the stage.
        """


@dataclass(frozen=True, slots=True)
class OwnSession(StageSession):
    """For each run: takes the stage's lock, opens its devices, strikes its lamps, and leaves the lamps safe.

    ``around`` is entered before the devices are opened and left when they are closed
    ``again``: continue a finished run of the name, too; its finished steps are not repeated
    """

    stage: Path
    around: contextlib.AbstractContextManager[object] | None = None
    again: bool = False

    def locked(self) -> contextlib.AbstractContextManager[None]:
        """See ``StageSession``."""
        return stage_lock(self.stage)

    def run(self, checked: Checked, work: StageWork, *, reporter: Reporter, cancel: threading.Event) -> Path:
        """See ``StageSession``."""
        stage = checked.stage
        deadline = in_seconds(LONGEST_RUN_S, cancel)
        safety = stage.tables.safety
        only, place = (None, None) if work.place is None else work.place
        with (
            stage_lock(stage.folder),
            kernels_compiled(reporter) as compiled,
            self.around or contextlib.nullcontext(),
            opened_rig(checked, deadline=deadline, plays=work.plays, only=only) as rig,
            Journal(place or unfinished_run(stage.folder, work.name, finished=self.again)) as journal,
        ):
            clear_unfinished_writes(journal.folder)
            machine = Machine(journal.record_change)
            first = dark_before(rig.ambient_limit) if work.dark else []
            made, others = _with_others(rig, work, journal, reporter, deadline)
            unsteady = [*(step for step in made if step.unsteady), *others.early()]
            power = power_steps(rig, power_up_s=safety.power_up_s, early=[*compiled, *unsteady] if unsteady else ())
            rest = [*(() if unsteady else compiled), *(step for step in made if not step.unsteady)]
            steps = [*first, *work.before(rig), *power, *rest]
            with lit(rig, machine, power_down_s=safety.power_down_s, reporter=reporter):
                runner = Runner(steps, journal, reporter=reporter, machine=machine)
                with others.ending():
                    runner.run(work.name, deadline=deadline)
            return journal.folder


@dataclass(frozen=True, slots=True)
class BorrowedSession(StageSession):
    """Uses the kiosk's lock and its lit ``rig``; ``rig`` is None for work without devices.

    The lamps stay lit, and the state machine is the kiosk's.
    """

    stage: Path
    rig: Rig | None = None

    def locked(self) -> contextlib.AbstractContextManager[None]:
        """See ``StageSession``; the kiosk has the lock already."""
        return contextlib.nullcontext()

    def run(self, checked: Checked, work: StageWork, *, reporter: Reporter, cancel: threading.Event) -> Path:
        """See ``StageSession``. Raises ValueError without a rig."""
        if self.rig is None:
            raise ValueError("this session has no devices")
        with kernels_compiled(reporter) as compiled, Journal(unfinished_run(self.rig.stage, work.name)) as journal:
            clear_unfinished_writes(journal.folder)
            first = dark_before(self.rig.ambient_limit) if work.dark else []
            deadline = in_seconds(LONGEST_RUN_S, cancel)
            made, others = _with_others(self.rig, work, journal, reporter, deadline)
            steps = [*first, *compiled, *others.early(), *made]
            with others.ending():
                Runner(steps, journal, reporter=reporter).run(work.name, deadline=deadline)
            return journal.folder


def _with_others(
    rig: Rig, work: StageWork, journal: Journal, reporter: Reporter, deadline: Deadline
) -> tuple[list[Step], OtherViews]:
    """The steps of the run, among them those that start and await its other views."""
    of = rig if work.views else replace(rig, others=(), absent={})
    others = OtherViews(of, journal, work.name, work.make_steps, reporter, deadline)
    steps = list(work.make_steps(rig, journal.folder))
    alone = not of.others and not of.absent and of.view == ONLY_CAMERA
    return (steps if alone or not work.views else others.around(steps)), others
