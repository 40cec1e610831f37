"""Starts the service of a stage, with its lock, its last good settings and its log, and ends it."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

from controller.core.errors import UsageError
from controller.kiosk.jobs.job_handlers import JobHandlers
from controller.kiosk.service import MakeJobs, Service
from controller.kiosk.store import archive, settings_change
from controller.kiosk.store.event_log import Decision, EventLog
from controller.kiosk.store.journal import journal_of
from controller.kiosk.store.settings import checked_settings
from controller.kiosk.world import World
from controller.stage.sessions.check import Checked
from controller.stage.sessions.run import stage_lock
from hal.deadline import Stop


def _usable(stage: Path, world: World) -> tuple[Checked, Decision | None]:
    """The stage's settings, or the last good ones and why. Raises what ``checked_settings`` raises."""
    try:
        return checked_settings(stage, world.drivers), None
    except UsageError as error:
        return settings_change.last_good(stage, error, world.drivers)


@contextlib.contextmanager
def serving(
    stage: Path,
    cancel: threading.Event,
    *,
    leave_lit: bool = False,
    alive: Callable[[], None] = lambda: None,
    world: World | None = None,
    jobs: MakeJobs = JobHandlers.table,
) -> Iterator[Service]:
    """A started service, its loop in a thread; ended, with the lamps cooled, on leaving. ``alive``: as ``Service``'s.

    Raises what ``checked_settings`` raises, UsageError("already-running"), and UsageError("display-plays-no-bundles").
    """
    world = world or World()
    if (stage / archive.RESTORING).exists():
        with stage_lock(stage):
            archive.finish_restore(stage)
    checked, problem = _usable(stage, world)
    if checked.stage.tables.display.driver != "player":
        raise UsageError(
            "display-plays-no-bundles",
            what="A kiosk needs the player as its display.",
            remedy='Use the driver "player" under [display] in stage.toml.',
        )
    with stage_lock(checked.stage.folder):
        archive.clear_cut_off(checked.stage.folder)
        file = checked.stage.folder / EventLog.FILE
        log = EventLog(file, wall=world.wall, monotonic=world.monotonic, connect=world.connect,
                       also=journal_of(checked.stage.tables.stage.name))  # fmt: skip
        with contextlib.closing(log):
            service = Service(checked, log, problem, world, jobs)
            service.alive = alive
            ended = world.event()
            loop = world.thread(partial(service.run, ended), "reconciler")
            try:
                service.start()
                loop.start()
                if problem is None:
                    service.good_settings.keep(checked)
                yield service
            finally:
                ended.set()
                if loop.is_alive():
                    loop.join(10.0)
                service.end(leave_lit=leave_lit or (isinstance(cancel, Stop) and cancel.restarting))
