"""A stage's side in a house: it publishes its state, its picture and its events, does what the building's verbs allow,
and gives its backup. It needs nothing of the house: without it, only this thread waits.
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from importlib import metadata
from pathlib import Path
from typing import Any, Final

from controller.core.errors import UsageError, WorkError
from controller.core.kiosk_places import is_installed
from controller.kiosk.house.workers import may_solve, say_closed
from controller.kiosk.install.system import System
from controller.kiosk.install.update import Outcome, Packages, outcome
from controller.kiosk.interface import Kiosk
from controller.kiosk.operations.dispatch import local_values
from controller.kiosk.operations.house import MEMBERSHIP, Invitation
from controller.kiosk.operations.table import OPERATIONS, compute
from controller.kiosk.panel_address import own_addresses
from controller.kiosk.state import EventRow, KioskState
from controller.stage.link.joining import VALID_S, Joining
from controller.stage.link.membership import Certified, Membership, leave, membership
from controller.stage.link.peers import keep_peer, peer_folder
from controller.stage.link.session import EVERYWHERE, Link, member_link
from controller.stage.link.transfer import Arrivals, Offer
from hal.errors import CodedError

PAUSE_S: Final = 2.0
"""Between two states, at least."""
AGAIN_S: Final = 30.0
CERTIFIED_S: Final = 600.0
MOST_EVENTS: Final = 200
PICTURE_PX: Final = 160
_VERBS: Final = {one.building_verb: one for one in OPERATIONS if one.building_verb} | {compute.name: compute}


@dataclass(frozen=True, slots=True)
class Report:
    """What a stage reports. ``events``: those after the last report, or the newest of all."""

    state: KioskState
    appearances: tuple[str, ...]
    version: str
    events: tuple[EventRow, ...] = ()
    update: Outcome = field(default_factory=Outcome)
    """Of its program."""


@dataclass(frozen=True, slots=True)
class Order:
    """One of the building's verbs, or "compute", and ``who`` asked at the house. A target is one that has come."""

    verb: str
    who: str
    values: dict[str, Any] = field(default_factory=dict)


class Member:
    """This stage's side. Use as a context manager; it follows a membership that begins or ends meanwhile."""

    def __init__(
        self, kiosk: Kiosk, stage: Path, *, host: str = EVERYWHERE, computer: System | None = None, **joining: Any
    ) -> None:
        """``host`` and ``joining``: as of ``Joining``; ``computer``: whose program the house may update; None for this
        one, if it is a kiosk.
        """
        if computer is None and is_installed(stage):
            computer = System(lambda line: None)
        self._computer = computer
        self._kiosk, self._stage, self._folder = kiosk, stage, stage / MEMBERSHIP
        self._host, self._joining = host, joining
        self._lock = threading.Lock()
        self._running: _Reports | None = None
        self._open_code: Joining | None = None

    def __enter__(self) -> Member:
        self._follow()
        return self

    def __exit__(self, *_: object) -> None:
        with self._lock:
            self._end_code()
            self._end_reports()

    def invite(self, name: str) -> Invitation:
        """As ``operations.house.house_join``. Raises UsageError("house-joined-already", "house-name-wrong"),
        WorkError("link-not-opened").
        """
        with self._lock:
            if (there := membership(self._folder)) is not None:
                raise UsageError(
                    "house-joined-already",
                    what=f"This stage belongs to the house {there.house} already.",
                    remedy="Leave that house first, with `velatura kiosk house leave`.",
                )
            self._end_code()
            opened = self._open_code = Joining(self._folder, name, host=self._host, **self._joining)
        threading.Thread(target=self._wait, args=(opened,), name="house-code", daemon=True).start()
        return Invitation(opened.code, own_addresses(), VALID_S)

    def leave(self) -> None:
        with self._lock:
            self._end_code()
            self._end_reports()
            leave(self._folder)

    def _wait(self, opened: Joining) -> None:
        try:
            joined = opened.wait()
            self._kiosk.record("house-joined", f"This stage has joined the house {joined.house}.")
        except CodedError as error:
            self._kiosk.record(error.code, f"{error.what} {error.remedy}", "warning")
        with self._lock:
            if self._open_code is opened:
                self._end_code()
        self._follow()

    def _follow(self) -> None:
        with self._lock:
            try:
                there = membership(self._folder)
                if there is not None and self._running is None:
                    self._running = _Reports(self._kiosk, there, self._computer, self._stage)
            except CodedError as error:
                self._kiosk.record(error.code, f"{error.what} {error.remedy}", "error")

    def _end_code(self) -> None:
        if self._open_code is not None:
            self._open_code.__exit__()
            self._open_code = None

    def _end_reports(self) -> None:
        if self._running is not None:
            self._running.close()
            self._running = None


class _Reports:
    """The link of one membership, and the thread that publishes."""

    def __init__(self, kiosk: Kiosk, member: Membership, computer: System | None, stage: Path) -> None:
        self._kiosk, self._member, self._computer, self._peers = kiosk, member, computer, peer_folder(stage)
        self._certify_s = 0.0
        self._key = f"member/{member.name}"
        self._link: Link = member_link(member)
        self._changed, self._ended = threading.Event(), threading.Event()
        self._backup: tuple[Path, Offer] | None = None
        self._backing_up = threading.Lock()
        self._unsubscribe = kiosk.subscribe(self._changed.set)
        for name, answer in (("report", self._whole), ("picture", self._picture), ("backup", self._make_backup)):
            self._link.answer(f"{self._key}/{name}", bytes, answer)
        self._targets = Arrivals(stage / "kiosk/house-targets", lambda file: None)  # the kiosk checks what it computes
        self._targets.listen(self._link, f"{self._key}/target")
        self._link.answer(f"{self._key}/do", Order, self._do)
        self._link.answer(f"{self._key}/part", int, self._part)
        if computer is not None:
            Packages(computer, self._link, self._key)
        self._link.appear(f"{self._key}/here")
        self._thread = threading.Thread(target=self._publish, name="house", daemon=True)
        self._thread.start()

    def close(self) -> None:
        self._unsubscribe()
        self._ended.set()
        self._changed.set()
        self._link.close()
        self._forget_backup()
        say_closed(self._peers, False)

    def _publish(self) -> None:
        last, sent_s, number = None, 0.0, 0
        while not self._ended.is_set():
            self._changed.wait(AGAIN_S)
            self._changed.clear()
            with contextlib.suppress(CodedError, OSError):  # without a house or a disk it solves nothing for others
                self._offer_solves()
            events = tuple(self._kiosk.events(number))
            report = self._report(events[-MOST_EVENTS:])
            if report != last or time.monotonic() - sent_s >= AGAIN_S:
                self._link.publish(f"{self._key}/state", report)
                last, sent_s = replace(report, events=()), time.monotonic()
                number = events[-1].number if events else number
            self._ended.wait(PAUSE_S)

    def _offer_solves(self) -> None:
        """Let the house's solves use this computer while the stage is closed."""
        closed = may_solve(self._kiosk.snapshot(), time.time())
        if closed and time.monotonic() >= self._certify_s:
            keep_peer(
                self._peers, self._member, lambda request: self._link.ask(f"{self._key}/peer", request, Certified)
            )
            self._certify_s = time.monotonic() + CERTIFIED_S
        say_closed(self._peers, closed)

    def _report(self, events: Sequence[EventRow]) -> Report:
        now = self._kiosk.snapshot()
        # So that a lit lamp alone does not change it every second.
        lamps = tuple(replace(lamp, hours=round(lamp.hours, 1)) for lamp in now.lamps)
        names: tuple[str, ...] = ()
        with contextlib.suppress(CodedError):
            names = tuple(one.name for one in self._kiosk.appearances())
        state = replace(now, revision=0, lamps=lamps, grades=now.grades[:1], drifts=now.drifts[:1], places=())
        return Report(state, names, metadata.version("velatura"), tuple(events), self._outcome())

    def _outcome(self) -> Outcome:
        return Outcome() if self._computer is None else replace(outcome(self._computer), before={})

    def _whole(self, _: bytes) -> Report:
        return self._report(tuple(self._kiosk.events())[-MOST_EVENTS:])

    def _do(self, order: Order) -> None:
        operation = _VERBS.get(order.verb)
        if operation is None:
            raise UsageError("verb-unknown", what="There is no such verb.", remedy=f"Use one of {', '.join(_VERBS)}.")
        sent = dict(order.values)
        if operation is compute:
            sent["target"] = str(self._targets.path(sent.get("target", "")))
        values = local_values(operation, sent)
        with operation.logged(self._kiosk.record, f"{order.who} at the house {self._member.house}", values):
            operation.function(self._kiosk, **values)

    def _picture(self, _: bytes) -> bytes:
        """Of what plays: photographed, else calculated, as a small JPEG; empty without one."""
        import cv2

        playing = self._kiosk.snapshot().playing
        photographed = {one.name: one.pictures.get("achieved") for one in self._kiosk.comparisons()}
        shown = next((one for one in self._kiosk.appearances() if one.name == playing), None)
        path = photographed.get(playing) or (shown.preview if shown is not None else None)
        picture = cv2.imread(str(path)) if path is not None else None
        if picture is None:
            return b""
        scale = min(1.0, PICTURE_PX / max(picture.shape[:2]))
        small = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        return bytes(cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, 70])[1])

    def _make_backup(self, _: bytes) -> Offer:
        job = self._kiosk.snapshot().job
        if job is not None and not job.ended:
            raise WorkError("backup-busy", what="A job runs on this stage.", remedy="Try again when it is done.")
        with self._backing_up:
            self._forget_backup()
            file = self._kiosk.backup()
            self._backup = file, Offer.of(file)
            return self._backup[1]

    def _part(self, number: int) -> bytes:
        with self._backing_up:
            if self._backup is None or not 0 <= number < len(self._backup[1].parts):
                raise UsageError("backup-part-unknown", what="There is no such part.", remedy="Make the backup again.")
            file, offer = self._backup
            return offer.part(file, number)

    def _forget_backup(self) -> None:
        if self._backup is not None:
            self._backup[0].unlink(missing_ok=True)
            self._backup = None
