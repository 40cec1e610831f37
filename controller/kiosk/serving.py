"""Starts the service of a stage, with its lock, its last good settings and its log, and ends it."""

from __future__ import annotations

import contextlib
import os
import socket
import threading
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Final

from controller.core.errors import UsageError, VelaturaError, WorkError
from controller.core.files import file_error
from controller.core.kiosk_places import PLAYER_OPTIONS, PLAYER_SOCKET, RUNTIME
from controller.kiosk.jobs.job_handlers import JobHandlers
from controller.kiosk.service import MakeJobs, Service
from controller.kiosk.state import EventRow
from controller.kiosk.store import archive
from controller.kiosk.store.event_log import EventLog
from controller.kiosk.store.settings import checked_settings, last_good
from controller.kiosk.supervisors.player_supervisor import PlayerSupervisor
from controller.kiosk.world import World
from controller.play.control.launch import AttachedPlayer, PlayerSettings
from controller.stage.sessions.check import Checked
from controller.stage.sessions.run import stage_lock
from hal.deadline import Stop
from hal.notices import Level, Notice

SOCKET: Final = "/run/systemd/journal/socket"
_PRIORITIES: Final = {"info": "6", "warning": "4", "error": "3"}
"""Those of syslog."""


def journal_of(
    stage: str, environment: Mapping[str, str] = os.environ, path: str = SOCKET
) -> Callable[[EventRow], None] | None:
    """What sends an event to the journal; None where systemd did not start this process with its journal."""
    if "JOURNAL_STREAM" not in environment:
        return None

    def send(row: EventRow) -> None:
        datagram = fields(row, stage)
        # A journal that is full or gone must not stop the kiosk, which has its own event log.
        with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as channel:
            channel.setblocking(False)
            channel.sendto(datagram, path)

    return send


def fields(row: EventRow, stage: str) -> bytes:
    """An event as the journal's datagram."""
    named = {
        "MESSAGE": row.text,
        "PRIORITY": _PRIORITIES[row.level],
        "SYSLOG_IDENTIFIER": "velatura",
        "VELATURA_CODE": row.code,
        "VELATURA_STAGE": stage,
        "VELATURA_EVENT": str(row.number),
    }
    return b"".join(_field(name, value.encode("utf-8", "replace")) for name, value in named.items())


def _field(name: str, value: bytes) -> bytes:
    """With its length, so that a line break in a device's text begins no new field."""
    return name.encode() + b"\n" + len(value).to_bytes(8, "little") + value + b"\n"


def _usable(stage: Path, world: World) -> tuple[Checked, Notice | None]:
    """The stage's settings, or the last good ones and why. Raises what ``checked_settings`` raises."""
    try:
        return checked_settings(stage, world.drivers), None
    except UsageError as error:
        return last_good(stage, error, world.drivers)


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

    Raises what ``checked_settings`` raises, and UsageError("already-running").
    """
    world = world or World()
    given_up: VelaturaError | None = None
    if (stage / archive.RESTORING).exists():
        with stage_lock(stage):
            try:
                archive.finish_restore(stage)
            except (WorkError, OSError) as error:
                # The stage plays without what the backup has.
                given_up = file_error(error) if isinstance(error, OSError) else error
    checked, problem = _usable(stage, world)
    with stage_lock(checked.stage.folder):
        archive.clear_cut_off(checked.stage.folder)
        file = checked.stage.folder / EventLog.FILE
        log = EventLog(file, wall=world.wall, monotonic=world.monotonic, connect=world.connect,
                       also=journal_of(checked.stage.tables.stage.name))  # fmt: skip
        with contextlib.closing(log):
            if given_up is not None:
                log.add(Notice(given_up.code, given_up.what, given_up.remedy, Level.ERROR))
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


_SETUP_STEP_S: Final = 0.5


@contextlib.contextmanager
def setup_picture(lines: Callable[[], tuple[str, ...]]) -> Iterator[None]:
    """Show ``lines()`` on one projector after the other until the end: how to reach the panel of a kiosk that has no
    stage yet.
    """
    supervisor = PlayerSupervisor(
        RUNTIME,
        lambda _: PlayerSettings((), None),
        lambda _: None,
        attach=lambda _: AttachedPlayer(PLAYER_SOCKET, PLAYER_OPTIONS, None),
    )
    ended = threading.Event()
    thread = threading.Thread(target=partial(_show_lines, supervisor, lines, ended), name="set-up picture", daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join(10.0)
        supervisor.close()


def _show_lines(supervisor: PlayerSupervisor, lines: Callable[[], tuple[str, ...]], ended: threading.Event) -> None:
    while not ended.is_set():
        supervisor.notice = lines()
        supervisor.step()
        ended.wait(_SETUP_STEP_S)
