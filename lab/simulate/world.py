"""The world of a simulated kiosk: time, power, devices, a player, servers that take alerts. Nothing of it is real."""

from __future__ import annotations

import contextlib
import random
import sqlite3
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from datetime import UTC, date, datetime
from pathlib import Path
from typing import Any, Final, cast

from controller.config.models import AlertsTable, StageTables
from controller.core.errors import WorkError
from controller.kiosk.alerts import Send
from controller.kiosk.changes.inventory import Fact, Inventory
from controller.kiosk.state import EventRow
from controller.kiosk.world import Lock as AnyLock
from controller.kiosk.world import Thread, World
from controller.play.control.launch import PlayerSettings
from hal.deadline import Deadline
from hal.errors import DeviceBusy, DeviceGone
from hal.player import PlayerClient
from hal.registry import Driver, Drivers, OpenContext
from hal.values import CameraCapabilities, DeviceIdentity, OutputInfo
from lab.simulate.disk import STAGE, TOTAL_BYTES, Disk
from lab.simulate.lamps import Lamp, Line, SimulatedProjector
from lab.simulate.player import Screen, SimulatedPlayer
from lab.simulate.scheduler import Event, Lock, Program, Scheduler
from lab.simulate.stage import NAMES, OUTPUTS

_ADDRESSES: Final = {f"192.0.2.{number}": name for number, name in enumerate(NAMES, 1)}

ANSWER_S: Final = 0.05
EXPOSED_S: Final = (0.2, 4.0)
"""Exposure and reading of one photograph."""


class SimulatedCamera:
    """An opened camera; see ``hal.interfaces.Camera``. It takes no pictures: photons are not simulated."""

    def __init__(self, body: Body) -> None:
        self._body, self._closed, self._connection = body, False, body.connection
        if body.owner is not None:
            raise DeviceBusy("camera-taken", what="The camera is in use by another program.", remedy="Stop it.")
        body.answer()
        body.owner = self

    capabilities = CameraCapabilities((0.01,), (100,), (8.0,), raw=True, jpeg=False)

    def identity(self, *, deadline: Deadline) -> DeviceIdentity:
        if self._closed:
            raise DeviceGone("camera-closed", what="The camera is no longer open.", remedy="Open it again.")
        if self._connection != self._body.connection:
            raise DeviceGone("camera-gone", what="The camera was away since it was opened.", remedy="Open it again.")
        self._body.answer()
        return DeviceIdentity("Simulated", "Camera")

    def configure(self, settings: Any, *, deadline: Deadline) -> Any:
        self.identity(deadline=deadline)
        return settings

    def capture(self, destination: Path, *, deadline: Deadline) -> list[Any]:
        self.identity(deadline=deadline)
        self._body.answer(self._body.rng.uniform(*EXPOSED_S))
        return []

    def close(self) -> None:
        self._closed = True
        if self._body.owner is self:
            self._body.owner = None


class Body:
    """The camera itself. ``sins``: that two used it at a time; ``connection``: another one once it was away."""

    def __init__(self, scheduler: Scheduler, rng: random.Random) -> None:
        self._scheduler, self.rng = scheduler, rng
        self.gone, self.owner = False, cast("SimulatedCamera | None", None)
        self.violations: list[str] = []
        self.connection = 0
        self._asked = False

    def answer(self, lasts_s: float = ANSWER_S) -> None:
        """Takes so long. Raises DeviceGone."""
        if self._asked:
            self.violations.append("the camera was used by two at a time")
        self._asked = True
        try:
            self._scheduler.sleep(lasts_s)
            if self.gone:
                raise DeviceGone("camera-gone", what="The camera does not answer.", remedy="Check its cable.")
        finally:
            self._asked = False


class _Display:
    """A job's own pictures on the outputs, in the place of the player's."""

    def __init__(self, screen: Screen) -> None:
        self._screen = screen

    def outputs(self, *, deadline: Deadline) -> tuple[OutputInfo, ...]:
        return tuple(OutputInfo(output, 8, 8) for output in OUTPUTS.values())

    def show(self, frames: Mapping[str, Any], *, deadline: Deadline) -> None:
        if self._screen.process is not None and not self._screen.hung:
            self._screen.process.pattern()

    def identity(self, *, deadline: Deadline) -> DeviceIdentity:
        return DeviceIdentity("Simulated", "Display")

    def close(self) -> None:
        """Nothing to release."""


class SimulatedWorld(World):
    """``begins_unix_s``: the time at which it begins; ``clock_off_s``: by how much the computer's clock is wrong."""

    def __init__(self, seed: str, begins_unix_s: float) -> None:
        self.scheduler = Scheduler(seed)
        rng = random.Random(f"{seed} devices")
        self.rng = rng
        self.disk = Disk(self.scheduler)
        self.screen = Screen(self.scheduler, self.disk, rng)
        self.lamps = {name: Lamp(name, self.scheduler) for name in NAMES}
        self.lines = {name: Line(lamp, self.scheduler, rng) for name, lamp in self.lamps.items()}
        self.camera = Body(self.scheduler, rng)
        self.alerted: list[EventRow] = []
        self.no_network = False
        self.begins_unix_s, self.clock_off_s = begins_unix_s, 0.0
        self.is_synchronised = True
        self.drifted = self.is_small = False
        """Whether something has moved; and whether the computer can't do work and answer in time."""
        self.program: Program | None = None
        self._connections: list[sqlite3.Connection] = []
        self._booted_s, self._boots = 0.0, 0
        self.drivers = Drivers((
            Driver("projector", "pjlink", "A projector.", self._projector, {"address": "it", "profile": "it"}),
            Driver("camera", "ptp", "A camera.", lambda *_: SimulatedCamera(self.camera), {"address": "it"}),
            Driver("display", "player", "Outputs.", lambda *_: _Display(self.screen), {"outputs": "them"}),
        ))  # fmt: skip

    # -- from outside

    @property
    def truth_s(self) -> float:
        """Unix seconds, as they are."""
        return self.begins_unix_s + self.scheduler.now_s

    def reboot(self) -> None:
        """The power is back."""
        self._booted_s, self._boots = self.scheduler.now_s, self._boots + 1

    def release(self) -> None:
        """The system closes what a killed program had open."""
        self.camera.owner = None
        # As a kill leaves them: SQLite would write its write-ahead log into the file when it is closed.
        log = STAGE / "kiosk" / "events.sqlite"
        left = {path: path.read_bytes() for path in (log, log.with_name(f"{log.name}-wal")) if path.is_file()}
        for connection in self._connections:
            # SQLite closes one of another thread only with its last name
            with contextlib.suppress(sqlite3.ProgrammingError):
                connection.close()
        had = bool(self._connections)
        self._connections.clear()
        for path, content in left.items() if had else ():
            path.write_bytes(content)
        for line in self.lines.values():
            line.drop()

    @contextlib.contextmanager
    def as_program(self, program: Program) -> Iterator[None]:
        """Threads that are made inside belong to it."""
        before, self.program = self.program, program
        try:
            yield
        finally:
            self.program = before

    @contextlib.contextmanager
    def busy(self) -> Iterator[None]:
        """The computer works: on a small one, some answers of the player are late meanwhile."""
        self.screen.late = self.is_small
        self.screen.apply_trouble()
        try:
            yield
        finally:
            self.screen.late = False
            self.screen.apply_trouble()

    # -- as World

    def now_s(self) -> float:
        return self.scheduler.now_s - self._booted_s

    def boot(self) -> str:
        return f"boot-{self._boots}"

    def monotonic(self) -> float:
        return self.scheduler.now_s - self._booted_s

    def wall(self) -> float:
        return self.truth_s + self.clock_off_s

    def synchronised(self) -> bool:
        return self.is_synchronised

    def today(self) -> date:
        return datetime.fromtimestamp(self.wall(), UTC).date()

    def sleep(self, seconds: float, deadline: Deadline | None = None) -> None:
        self.scheduler.sleep(seconds if deadline is None else min(seconds, deadline.left_s()))

    def thread(self, run: Callable[[], object], name: str) -> Thread:
        return self.scheduler.task(run, name, self.scheduler.present.program or self.program)

    def event(self) -> threading.Event:
        return Event(self.scheduler)

    def lock(self) -> AnyLock:
        return Lock(self.scheduler, again=False)

    def rlock(self) -> AnyLock:
        return Lock(self.scheduler, again=True)

    def connect(self, *arguments: Any, **settings: Any) -> sqlite3.Connection:
        connection = self.disk.connect(*arguments, **settings)
        self._connections.append(connection)
        return connection

    def disk_usage(self, folder: Path) -> tuple[int, int]:
        return TOTAL_BYTES, 0 if self.disk.full else self.disk.free_bytes

    def launch(self, runtime: Path, settings: PlayerSettings) -> SimulatedPlayer:
        return self.screen.launch(runtime, settings)

    def channel(self) -> PlayerClient:
        return PlayerClient(self.screen.connect, self)

    def ways_out(self, table: AlertsTable) -> dict[str, Send]:
        return {"webhook": self._alert} if table.webhook is not None else {}

    def inventory(self, stage: Path, tables: StageTables, devices: tuple[Fact, ...], run: str) -> Inventory:
        return Inventory(self.wall(), run, devices)

    def open_context(self, stage: Path, runtime: Path) -> OpenContext:
        return OpenContext(stage=stage, runtime=runtime, checked=False)

    def _projector(self, settings: Mapping[str, Any], context: OpenContext, deadline: Deadline) -> SimulatedProjector:
        return SimulatedProjector(self.lines[_ADDRESSES[settings["address"]]], deadline)

    def _alert(self, stage: Path, name: str, table: AlertsTable, rows: Sequence[EventRow]) -> None:
        self.scheduler.sleep(self.rng.uniform(0.05, 0.5))
        if self.no_network:
            raise WorkError("alert-not-sent", what="The server of the webhook does not answer.", remedy="Check it.")
        self.alerted += rows
