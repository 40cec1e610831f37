"""Who has a stage's lock and devices while something is done with the stage, given to every service that needs them."""

from __future__ import annotations

import contextlib
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from controller.core.storage import clear_unfinished_writes
from controller.rig.ambient_light import dark_before
from controller.rig.lamp_session import lit, power_steps
from controller.rig.rig import Rig
from controller.run.compiling import kernels_compiled
from controller.run.journal import Journal
from controller.run.progress import Reporter
from controller.run.runner import Runner, Step
from controller.run.state_machine import Machine
from controller.stage.check import Checked
from controller.stage.open import opened
from controller.stage.run import LONGEST_RUN_S, stage_lock, unfinished_run
from hal.deadline import in_seconds

MakeSteps = Callable[[Rig, Path], Sequence[Step]]
"""The steps of a run on the opened stage; the path is the run's folder."""


class StageSession(ABC):
    """Work on one stage. ``stage``: its folder, which holds stage.toml."""

    stage: Path

    @abstractmethod
    def locked(self) -> contextlib.AbstractContextManager[None]:
        """For work that touches no device: inside, no one else works on the stage.

        Raises UsageError("already-running").
        """

    @abstractmethod
    def run(
        self,
        checked: Checked,
        make_steps: MakeSteps,
        *,
        name: str,
        reporter: Reporter,
        cancel: threading.Event,
        dark: bool = False,
        plays: bool = False,
        before: Callable[[Rig], Sequence[Step]] = lambda rig: (),
    ) -> Path:
        """Run the steps of a new or unfinished run of this name with the lamps on; the run's folder.

        ``checked``: the session's stage; ``dark``: not in a bright room, where the stage has a light sensor;
        ``plays``: as in ``stage.open.opened``; ``before``: steps that come before the lamps are struck, where they are
        not lit already.
        Raises what the steps raise; UsageError("already-running") if another program works on the stage.
        """


@dataclass(frozen=True, slots=True)
class OwnSession(StageSession):
    """Takes the stage's lock, opens its devices and strikes its lamps for each run, and leaves the lamps safe.

    ``around`` is entered before the devices are opened and left when they are closed
    ``again``: a finished run of the name is continued, too; what it has done already is not repeated
    """

    stage: Path
    around: contextlib.AbstractContextManager[object] | None = None
    again: bool = False

    def locked(self) -> contextlib.AbstractContextManager[None]:
        """See ``StageSession``."""
        return stage_lock(self.stage)

    def run(
        self,
        checked: Checked,
        make_steps: MakeSteps,
        *,
        name: str,
        reporter: Reporter,
        cancel: threading.Event,
        dark: bool = False,
        plays: bool = False,
        before: Callable[[Rig], Sequence[Step]] = lambda rig: (),
    ) -> Path:
        """See ``StageSession``."""
        stage = checked.stage
        deadline = in_seconds(LONGEST_RUN_S, cancel)
        safety = stage.tables.safety
        with (
            stage_lock(stage.folder),
            kernels_compiled(reporter) as compiled,
            self.around or contextlib.nullcontext(),
            opened(checked, deadline=deadline, plays=plays) as rig,
            Journal(unfinished_run(stage.folder, name, finished=self.again)) as journal,
        ):
            clear_unfinished_writes(journal.folder)
            machine = Machine(journal.record_change)
            first = dark_before(rig.darkness) if dark else []
            power = power_steps(rig, power_up_s=safety.power_up_s)
            steps = [*first, *before(rig), *power, *compiled, *make_steps(rig, journal.folder)]
            with lit(rig, machine, power_down_s=safety.power_down_s, reporter=reporter):
                Runner(steps, journal, reporter=reporter, machine=machine).run(name, deadline=deadline)
            return journal.folder


@dataclass(frozen=True, slots=True)
class BorrowedSession(StageSession):
    """Uses what the kiosk holds: its lock, and the lit ``rig`` that it lends; None for work that touches no device.

    The lamps stay lit, and the state machine is the kiosk's.
    """

    stage: Path
    rig: Rig | None = None

    def locked(self) -> contextlib.AbstractContextManager[None]:
        """See ``StageSession``; the kiosk has the lock already."""
        return contextlib.nullcontext()

    def run(
        self,
        checked: Checked,
        make_steps: MakeSteps,
        *,
        name: str,
        reporter: Reporter,
        cancel: threading.Event,
        dark: bool = False,
        plays: bool = False,
        before: Callable[[Rig], Sequence[Step]] = lambda rig: (),
    ) -> Path:
        """See ``StageSession``. Raises ValueError without a rig."""
        if self.rig is None:
            raise ValueError("this session was given no devices to work with")
        with kernels_compiled(reporter) as compiled, Journal(unfinished_run(self.rig.stage, name)) as journal:
            clear_unfinished_writes(journal.folder)
            first = dark_before(self.rig.darkness) if dark else []
            steps = [*first, *compiled, *make_steps(self.rig, journal.folder)]
            Runner(steps, journal, reporter=reporter).run(name, deadline=in_seconds(LONGEST_RUN_S, cancel))
            return journal.folder
