"""The service behind ``kiosk.StageKiosk``: attached and detached, its state and events, and who hears of them."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

from controller.core.errors import WorkError
from controller.kiosk.api import finding
from controller.kiosk.api.folder import FolderKiosk
from controller.kiosk.api.snapshot import Snapshots
from controller.kiosk.operations.accounts import Accounts as AccountsInUse
from controller.kiosk.operations.house import House
from controller.kiosk.preview.computed import ComputedPreviews
from controller.kiosk.service import Service
from controller.kiosk.state import EventLevel, EventRow, KioskState
from controller.kiosk.store.accounts import Accounts, stage_accounts
from controller.kiosk.values import Unsubscribe
from controller.kiosk.world import World
from hal.notices import Level, Notice

LIT_FOR_NOTICE_S: Final = 900.0
"""The longest time for a text on the projectors, so that no lamp burns for it all night."""
MOST_UNLOGGED: Final = 200
"""Lines for the event log of a service that does not run yet."""
_REVISIONS: Final = 1_000_000_000


class AttachedKiosk(FolderKiosk):
    """It outlives restarts of the service; the service is None while stage.toml is missing or wrong. ``accounts`` are
    shared by panel and socket, and opened at the first use; ``sessions_ended`` is set by a panel. ``reload`` is set
    when the settings have changed: its owner then restarts the service.
    """

    def __init__(self, stage: Path, world: World | None = None) -> None:
        super().__init__(stage)
        self._world = world or World()
        self.reload = self._world.event()
        self.accounts: Accounts | None = None
        self.house = House()
        self.sessions_ended: Callable[[str], object] = lambda name: None
        self._service: Service | None = None
        self._lock = threading.RLock()
        self._opening_accounts = threading.Lock()
        self._callbacks: list[Callable[[], None]] = []
        self._last = KioskState(
            0, stage.name, "off", "The stage is not set up yet.", self._world.wall(), needs_setup=True
        )
        self._events = 0
        self._previews = ComputedPreviews()
        self._snapshots = Snapshots(stage, self._world)
        self._examinations = finding.Examinations(lambda: finding.findings(stage, self._service))
        self._notice: tuple[tuple[str, ...], Callable[[], bool]] | None = None
        self._notice_ends_s = float("inf")
        self._unlogged: deque[Notice] = deque(maxlen=MOST_UNLOGGED)

    def attach(self, service: Service | None, reason: str = "") -> None:
        """Use this service from now on; None with the ``reason`` why there is none."""
        with self._lock:
            self._service = service
            if service is None:
                revision = self._last.revision + 1
                state, why = ("fault", reason) if reason else ("off", "The stage is not set up yet.")
                self._last = KioskState(revision, self.stage.name, state, why, self._world.wall(), needs_setup=True)
            else:
                starts = int(service.log.value("starts") or 0) + 1
                service.log.keep("starts", str(starts))
                self._last = replace(self._last, revision=starts * _REVISIONS)
                service.changed = self._refresh
                while self._unlogged:
                    service.log.add(self._unlogged.popleft())
                self._show_notice()
        self._notify()

    def detach(self) -> None:
        """Stop using the service, which has ended: the next one may have read its files already."""
        self._service = None
        self._previews.end()

    def held_accounts(self) -> Accounts:
        """The one copy that panel and socket share: a second one would overwrite its changes."""
        with self._opening_accounts:
            if self.accounts is None:
                self.accounts = stage_accounts(self.stage)
            return self.accounts

    def holders(self) -> dict[str, Any]:
        """The holders of the socket's operations."""
        return {"kiosk": self, "accounts": AccountsInUse(self.held_accounts, self._end_sessions), "house": self.house}

    def _end_sessions(self, name: str) -> None:
        # Looked up late, because a panel may be attached after the socket.
        self.sessions_ended(name)

    @property
    def service(self) -> Service:
        """Raises WorkError("not-set-up", "kiosk-restarting")."""
        service = self._service
        if service is None and not self._last.needs_setup:
            raise WorkError("kiosk-restarting", what="The kiosk is restarting.", remedy="Try again in a moment.")
        if service is None:
            raise WorkError("not-set-up", what=self._last.reason, remedy="Set the stage up first.")
        return service

    def announce(self, lines: tuple[str, ...], until: Callable[[], bool]) -> None:
        """Show text on the projectors in turn, with lamps lit, until ``until`` is true, or for ``LIT_FOR_NOTICE_S``.

        Only on a stage without a bundle: the text is for the person who sets it up, not for visitors.
        """
        self._notice = (lines, until)
        self._show_notice()

    def _show_notice(self) -> None:
        service = self._service
        if service is not None and self._notice is not None and service.bundles.bundle() is None:
            service.player.notice = self._notice[0]
            service.reconciler.light_for(LIT_FOR_NOTICE_S)
            self._notice_ends_s = self._world.monotonic() + LIT_FOR_NOTICE_S

    def _end_notice(self, service: Service) -> None:
        if self._notice is not None and (self._notice[1]() or self._world.monotonic() > self._notice_ends_s):
            self._notice = None
            service.player.notice = ()
            service.reconciler.light_for(0.0)

    # -- frequent questions

    def snapshot(self) -> KioskState:
        return self._last

    def events(self, after: int = 0) -> Sequence[EventRow]:
        return () if self._service is None else self._service.log.after(after)

    def record(self, code: str, what: str, level: EventLevel = "info") -> None:
        notice = Notice(code, what, "", Level(level))
        with self._lock:
            if self._service is not None:
                self._service.log.add(notice)
            else:
                self._unlogged.append(notice)

    def warn(self, about: str, what: str) -> None:
        self._snapshots.others = {**self._snapshots.others, about: what}

    def subscribe(self, callback: Callable[[], None]) -> Unsubscribe:
        with self._lock:
            self._callbacks.append(callback)
        return lambda: self._callbacks.remove(callback) if callback in self._callbacks else None

    def _refresh(self) -> None:
        service = self._service
        if service is None:
            return
        self._end_notice(service)
        if service.jobs.running is not None:
            self._previews.end()
        now = self._snapshots.of(service, self._last.revision)
        with self._lock:
            # Read once: an event logged between two reads would never be sent to the panel.
            events = service.log.number
            same = now == self._last and self._events == events
            self._events = events
            if not same:
                self._last = replace(now, revision=now.revision + 1)
        if not same:
            self._notify()

    def _notify(self) -> None:
        for callback in tuple(self._callbacks):
            callback()
