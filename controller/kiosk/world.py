"""All that a kiosk has of the world outside: clock, threads, disk, processes, network, drivers.

The code of the kiosk waits, starts threads and reaches devices through one ``World`` alone, so that a simulated one
(``lab.simulate``) can make it run from a seed.
"""

from __future__ import annotations

import shutil
import sqlite3
import threading
import time
from collections.abc import Callable
from datetime import date
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Protocol

from controller.config.models import AlertsTable, StageTables
from controller.kiosk.alerts import Send, ways_out
from controller.kiosk.changes.inventory import Fact, Inventory
from controller.kiosk.changes.machine import Machine
from controller.kiosk.changes.watch import take
from controller.kiosk.decide.clock import synchronised
from controller.play.control.launch import PlayerProcess, PlayerSettings, end_leftover
from controller.stage.rig.lamp_ledger import SystemClock
from controller.stage.sessions.run import open_context
from hal.deadline import Deadline
from hal.player import PlayerClient
from hal.registry import Drivers, OpenContext


class Thread(Protocol):
    """As ``threading.Thread``. ``start`` raises RuntimeError where the system has no thread left."""

    def start(self) -> None: ...

    def join(self, timeout: float | None = None) -> None: ...

    def is_alive(self) -> bool: ...


class Lock(Protocol):
    """As ``threading.Lock``."""

    def acquire(self, blocking: bool = True, timeout: float = -1) -> bool: ...

    def release(self) -> None: ...

    def locked(self) -> bool: ...

    def __enter__(self) -> bool: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None, /
    ) -> None: ...


READY_S: Final = 8.0
"""In which a player has to be ready."""


class Process(Protocol):
    """A running player, as ``play.control.launch.PlayerProcess``."""

    @property
    def socket(self) -> Path: ...

    @property
    def pid(self) -> int: ...

    @property
    def alive(self) -> bool: ...

    def wait_until_ready(self, timeout_s: float = READY_S) -> dict[str, Any]: ...

    def kill(self) -> None: ...

    def terminate(self) -> int: ...


def launched(runtime: Path, settings: PlayerSettings) -> Process:
    """A player that is being started, in the place of one that a killed starter left behind."""
    end_leftover(runtime)
    return PlayerProcess(runtime, settings)


class World(SystemClock):
    """The real one. ``drivers``: those that devices may have; None: all that are installed."""

    drivers: Drivers | None = None

    # -- time

    def monotonic(self) -> float:
        """Seconds that only go up."""
        return time.monotonic()

    def wall(self) -> float:
        """Unix seconds, as the computer's clock says."""
        return time.time()

    def synchronised(self) -> bool:
        """Whether the computer's clock is synchronised."""
        return synchronised()

    def today(self) -> date:
        """The date at the computer's place."""
        return date.fromtimestamp(self.wall())

    def sleep(self, seconds: float, deadline: Deadline | None = None) -> None:
        """Wait; at most until the ``deadline``."""
        if deadline is not None:
            deadline.sleep(seconds)
        else:
            time.sleep(seconds)

    def deadline(self, seconds: float, cancel: threading.Event | None = None) -> Deadline:
        """The deadline in so many seconds."""
        return Deadline(self.monotonic() + seconds, cancel, self)

    # -- threads

    def thread(self, run: Callable[[], object], name: str) -> Thread:
        """A thread that is to be started."""
        return threading.Thread(target=run, name=name, daemon=True)

    def event(self) -> threading.Event:
        """A flag that threads wait for."""
        return threading.Event()

    def lock(self) -> Lock:
        """A lock that may be held while its holder waits for a device."""
        return threading.Lock()

    def rlock(self) -> Lock:
        """The same, that its holder may take again."""
        return threading.RLock()  # type: ignore[return-value]

    # -- disk

    def connect(self, *arguments: Any, **settings: Any) -> sqlite3.Connection:
        """As ``sqlite3.connect``."""
        connection: sqlite3.Connection = sqlite3.connect(*arguments, **settings)
        return connection

    def disk_usage(self, folder: Path) -> tuple[int, int]:
        """Bytes in total, and free, of the folder's disk. Raises OSError."""
        usage = shutil.disk_usage(folder)
        return usage.total, usage.free

    # -- processes, network, devices

    def launch(self, runtime: Path, settings: PlayerSettings) -> Process:
        """A player that is being started. Raises VelaturaError and OSError."""
        return launched(runtime, settings)

    def channel(self) -> PlayerClient:
        """The way to ask the player."""
        return PlayerClient()

    def ways_out(self, table: AlertsTable) -> dict[str, Send]:
        """What sends alerts to each receiver that the settings name."""
        return ways_out(table)

    def inventory(self, stage: Path, tables: StageTables, devices: tuple[Fact, ...], run: str) -> Inventory:
        """What the kiosk consists of now, its computer included. Seconds."""
        return take(stage, tables, devices, Machine(), run)

    def open_context(self, stage: Path, runtime: Path) -> OpenContext:
        """What drivers get to open the devices. Raises WorkError("tape-not-made")."""
        return open_context(stage, runtime=runtime)
