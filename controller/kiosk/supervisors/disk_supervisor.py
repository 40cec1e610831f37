"""Watches the space on the stage's disk, makes room in time, and is the one that says that the disk is full."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Final

from controller.config.models import DiskTable
from controller.core.errors import WorkError
from controller.core.storage import write_atomically
from controller.kiosk.decide.interfaces import DISK_FULL
from controller.kiosk.state import DeviceRow, LiveValue
from controller.kiosk.store.bundle_store import BundleStore
from controller.kiosk.store.disk_space import make_room, runs_of
from controller.kiosk.store.event_log import EventLog
from controller.kiosk.world import World
from hal.notices import Level, Notice

GB: Final = 1e9
STEP_BYTES: Final = 10_000_000
PROBE: Final = "kiosk/.room"
PROBE_BYTES: Final = 65_536
AGAIN_S: Final = 600.0
"""Between attempts to make room where nothing was left to remove."""


class DiskSupervisor:
    """``free_bytes`` and ``total_bytes`` of the stage's disk. One thread calls ``step`` every few seconds.

    ``table``: the settings now; ``busy``: whether a job runs, which may need what would be removed.
    """

    def __init__(
        self, stage: Path, table: Callable[[], DiskTable], bundles: BundleStore, log: EventLog,
        busy: Callable[[], bool], world: World | None = None,
    ) -> None:  # fmt: skip
        self._world = world or World()
        self._stage, self._table, self._bundles, self._log, self._busy = stage, table, bundles, log, busy
        self.free_bytes = self.total_bytes = 0
        self.problem: Notice | None = None
        self._again_at_s = 0.0
        self._suspected: Notice | None = None

    def suspect(self, problem: Notice) -> None:
        """A device could not write; ``problem`` is reported where the disk is not the reason."""
        self._suspected = problem

    def step(self) -> None:
        """Look once."""
        self._look()
        if self.free_bytes < self._level and not self._busy() and self._world.monotonic() >= self._again_at_s:
            self._make_room()
        self._judge()

    @property
    def row(self) -> DeviceRow:
        """As the panel shows it among the devices."""
        values = (LiveValue.said("Free", "{0} GB of {1} GB", self.free_bytes / GB, self.total_bytes / GB, digits=1),)
        problem = self.problem
        what, remedy = (None, "") if problem is None else (problem.what, problem.remedy)
        return DeviceRow("disk", "disk", "", values, what, remedy)

    @property
    def _level(self) -> float:
        return self._table().warn_free_gb * GB

    def _look(self) -> None:
        total, free = self._world.disk_usage(self._stage)
        # In steps: each change of the state is sent to every open panel.
        self.free_bytes, self.total_bytes = free // STEP_BYTES * STEP_BYTES, total

    def _make_room(self) -> None:
        self._again_at_s = self._world.monotonic() + AGAIN_S
        before = self.free_bytes

        def enough() -> bool:
            self._look()
            return self.free_bytes >= self._level

        indexes = [self._bundles.index(path) for path in self._bundles.installed()]
        try:
            removed = make_room(self._stage, enough, keep_runs=self._table().keep_runs, used=runs_of(*indexes))
        except OSError as error:
            self._log.add(Notice("disk-not-cleared", f"Old runs could not be removed: {error.strerror}.",
                                    "Check the permissions of the stage's folder.", Level.WARNING))  # fmt: skip
            return
        if removed:
            self._look()
            what = ", ".join(removed[:5]) + (f" and {len(removed) - 5} more" if len(removed) > 5 else "")
            freed = max(0, self.free_bytes - before) / GB
            text = f"The disk was filling. Removed: {what}, which freed {freed:.2f} GB."
            self._log.add(Notice("disk-cleared", text))

    def _judge(self) -> None:
        before, self.problem = self.problem, self._problem()
        if self.problem is not None and (before is None or before.code != self.problem.code):
            self._log.add(self.problem)
        elif self.problem is None and before is not None:
            self._log.add(Notice("disk-well", f"The disk has {self.free_bytes / GB:.1f} GB of free space again."))

    def _problem(self) -> Notice | None:
        low = self.free_bytes < self._level
        if (low or self._suspected is not None or self._log.problem is not None) and (why := self._refusal()):
            return _full(why)
        suspected, self._suspected = self._suspected, None
        if suspected is not None:
            self._log.add(suspected)
        if low:
            text = f"Only {self.free_bytes / GB:.1f} GB are free on the disk of the stage."
            remedy = "Remove old runs, or copy them elsewhere. When the disk is full, no lamp is switched on."
            return Notice("disk-filling", text, remedy, Level.WARNING)
        return None

    def _refusal(self) -> str | None:
        """Why nothing can be written, or None: free space alone does not tell (quotas, broken or read-only disks)."""
        try:
            write_atomically(self._stage / PROBE, os.urandom(PROBE_BYTES))
            (self._stage / PROBE).unlink()
        except WorkError as error:
            return "is full" if error.code == "no-space" else "can't be written to"
        except OSError:
            return "can't be written to"
        return None


def _full(why: str) -> Notice:
    return Notice(
        DISK_FULL,
        f"The disk of the stage {why}. Playback continues. No lamp is switched on, because that could not be recorded.",
        "Free some space on the disk, and check that it is in order.", Level.ERROR,
    )  # fmt: skip
