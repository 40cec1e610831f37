"""A kiosk that is the house of many stages: what each last reported, orders to one, a group or all, one event log, and
one place for the backups of all. Its settings are ``house.toml`` in the folder of its stage.
"""

from __future__ import annotations

import contextlib
import shutil
import socket
import threading
import time
import tomllib
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from datetime import datetime
from functools import lru_cache, partial
from pathlib import Path
from typing import Annotated, Final

from pydantic import BaseModel, Field, ValidationError

from controller.core.errors import UsageError, VelaturaError, WorkError
from controller.core.files import read_text
from controller.core.storage import sha256_of, write_atomically
from controller.kiosk.backup import OURS
from controller.kiosk.backup import Folder as BackupFolder
from controller.kiosk.house.member import Order, Report
from controller.kiosk.install.system import System
from controller.kiosk.install.update import changelog, news
from controller.kiosk.operations.dispatch import CALLER
from controller.kiosk.operations.house import (
    HOUSE_FILE,
    UPDATE_FILE,
    HouseEvent,
    HouseNow,
    Rollout,
    StageNow,
    StageUpdate,
)
from controller.kiosk.panel_address import own_addresses
from controller.kiosk.state import EventLevel
from controller.stage.link.joining import admit
from controller.stage.link.membership import Authority, Certified, Membership
from controller.stage.link.peers import keep_peer, peer_folder
from controller.stage.link.session import EVERYWHERE, PORT, house_link
from controller.stage.link.transfer import Arrivals, Offer, send
from hal.errors import CodedError

FOLDER: Final = "keys/house-authority"
ROLLOUT: Final = "update-stages"
"""While an update is brought to stages: their names, the first one first."""
MOST_EVENTS: Final = 2000
_AT_ONCE: Final = 16
_ORDER_S: Final = 10.0
_COMPUTE_S: Final = 60.0  # a stage fits the picture to its view before it answers
_BACKUP_S: Final = 3600.0
_LOOK_S: Final = 30.0
_BACKUP_WINDOW_S: Final = 6 * 3600.0
_AGAIN_S: Final = 1800.0

Record = Callable[[str, str, EventLevel], object]


class HouseSettings(BaseModel, extra="forbid"):
    """house.toml. ``groups``: stages by the name of a group; ``addresses``: where stages reach the house, beside the
    name and the numbers of this computer; ``backups``: a folder; ``backup_at``: local time; ``keep``: of each stage.
    """

    name: Annotated[str, Field(min_length=1, max_length=64)]
    groups: dict[str, list[str]] = {}
    addresses: list[str] = []
    port: Annotated[int, Field(ge=1, le=65535)] = PORT
    backups: Path | None = None
    backup_at: Annotated[str, Field(pattern=r"^([01][0-9]|2[0-3]):[0-5][0-9]$")] = "04:00"
    keep: Annotated[int, Field(ge=1, le=1000)] = 14


def house_settings(stage: Path) -> HouseSettings | None:
    """None without a house.toml. Raises UsageError("house-toml-wrong")."""
    file = stage / HOUSE_FILE
    if not file.exists():
        return None
    try:
        return HouseSettings.model_validate(tomllib.loads(read_text(file)))
    except (OSError, ValueError) as error:
        first = error.errors()[0] if isinstance(error, ValidationError) else None
        why = f"{'.'.join(map(str, first['loc']))}: {first['msg']}" if first else str(error)
        raise UsageError(
            "house-toml-wrong", what=f"{HOUSE_FILE} can't be used: {why[:200]}.", remedy="Correct it, and start again."
        ) from error


@dataclass(slots=True)
class _Stage:
    """What the house knows of one."""

    linked: bool = False
    report: Report | None = None
    picture: bytes = b""
    shown: tuple[str, str] = ("", "")
    """The appearance and bundle of ``picture``."""
    backup_again_s: float = 0.0
    offered: str = ""
    """The update that it got from this process."""
    events: deque[HouseEvent] = field(default_factory=lambda: deque(maxlen=MOST_EVENTS))


@dataclass(frozen=True, slots=True)
class _Package:
    """The update that the house offers. ``digest``: SHA-256, as stages name it."""

    file: Path
    digest: str
    version: str
    changelog: str


@lru_cache(maxsize=1)
def _package_of(file: Path, changed_ns: int) -> _Package:
    here = System(lambda line: None)
    version = here.look("dpkg-deb", "--field", str(file), "Version") or "unknown"
    return _Package(file, sha256_of(file), version.strip(), changelog(here, file))


class House:
    """``operations.house.Stagehouse``; a context manager. ``record``: adds to the event log of this kiosk."""

    def __init__(self, stage: Path, settings: HouseSettings, record: Record, *, host: str = EVERYWHERE) -> None:
        """Raises UsageError("house-keys-damaged"), WorkError("link-not-opened")."""
        self._stage, self._settings, self._record, self._host = stage, settings, record, host
        self._authority = Authority(stage / FOLDER, settings.name)
        self._stages: dict[str, _Stage] = {}
        self._openings = 0
        self._changing, self._rolling, self._ended = threading.Lock(), threading.Lock(), threading.Event()
        self._pool = ThreadPoolExecutor(_AT_ONCE, thread_name_prefix="house")
        self._open()
        self._thread = threading.Thread(target=self._look_after, name="house backups", daemon=True)
        self._thread.start()

    def __enter__(self) -> House:
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._link.close()
        self._pool.shutdown(wait=False, cancel_futures=True)

    def _open(self) -> None:
        """A link for the members of now."""
        link = self._link = house_link(self._authority, host=self._host, port=self._settings.port)
        self._openings += 1  # what an older link still says counts no more
        self._stages = {name: self._stages.get(name, _Stage()) for name in self._authority.members}
        for name, stage in self._stages.items():
            stage.linked = False
            link.subscribe(f"member/{name}/state", Report, partial(self._hear, name))
            link.watch(f"member/{name}/here", partial(self._appear, name, self._openings))
            link.answer(f"member/{name}/peer", bytes, partial(self._certify, name))
        with contextlib.suppress(OSError):  # solves then stay where they are
            keep_peer(peer_folder(self._stage), Membership(self._stage, "house", self._settings.name, ()),
                      partial(self._certify, "house"))  # fmt: skip

    def _certify(self, name: str, request: bytes) -> Certified:
        return self._authority.peers().certify(request, name)

    def _appear(self, name: str, opening: int, here: bool) -> None:
        if opening != self._openings or self._ended.is_set():
            return
        self._stages[name].linked = here
        if here:
            self._pool.submit(self._greet, name)

    def _greet(self, name: str) -> None:
        """Ask for all that a stage said before it was linked."""
        with contextlib.suppress(CodedError):
            self._hear(name, self._link.ask(f"member/{name}/report", b"", Report))

    def _hear(self, name: str, report: Report) -> None:
        stage = self._stages.get(name)
        if stage is None or self._ended.is_set():
            return
        last = stage.events[-1].event.number if stage.events else 0
        stage.events.extend(HouseEvent(name, row) for row in report.events if row.number > last)
        stage.report, stage.linked = report, True
        shown = (report.state.playing, report.state.bundle.digest if report.state.bundle else "")
        if shown != stage.shown:
            stage.shown = shown
            with contextlib.suppress(RuntimeError):  # the house ends just now
                self._pool.submit(self._look, name)

    def _look(self, name: str) -> None:
        try:
            self._stages[name].picture = self._link.ask(f"member/{name}/picture", b"", bytes)
        except (CodedError, KeyError):
            if (stage := self._stages.get(name)) is not None:
                stage.shown = ("", "")  # it is asked again with the next report

    def now(self) -> HouseNow:
        stages = sorted(map(self._now, self._stages), key=lambda one: (-one.urgency, one.name))
        return HouseNow(self._settings.name, tuple(stages), tuple(self._settings.groups))

    def _now(self, name: str) -> StageNow:
        stage = self._stages[name]
        report = stage.report
        groups = tuple(group for group, names in self._settings.groups.items() if name in names)
        return StageNow(
            name, stage.linked, None if report is None else report.state, groups,
            () if report is None else report.appearances, "" if report is None else report.version,
            self._newest_backup(name), "" if report is None else f"{report.update.state} {report.update.why}".strip(),
        )  # fmt: skip

    def picture(self, stage: str) -> bytes | None:
        return self._known(stage).picture or None

    def events(self) -> Sequence[HouseEvent]:
        rows = [row for stage in list(self._stages.values()) for row in list(stage.events)]
        return sorted(rows, key=lambda row: row.event.unix_s)[-MOST_EVENTS:]

    def do(self, stages: str, verb: str, *, target: Path | None = None, **values: object) -> None:
        """``target``: a picture that the stages get first. Raises UsageError("house-stages-unknown"), OSError, and
        WorkError("house-order-failed") once all others have done it.
        """
        who, within_s = CALLER.get(), _ORDER_S if target is None else _COMPUTE_S

        def order(name: str) -> str:
            if not self._stages[name].linked:
                return f"{name}: it is not linked now."
            try:
                sent = {} if target is None else {"target": send(self._link, f"member/{name}/target", target)}
                self._link.ask(f"member/{name}/do", Order(verb, who, values | sent), type(None), within_s=within_s)
            except CodedError as error:
                return f"{name}: {error.what}"
            self._greet(name)  # the page is to show it at once
            return ""

        wanted = self._named(stages)
        failed = [said for said in self._pool.map(order, wanted) if said]
        if failed:
            raise WorkError(
                "house-order-failed",
                what=f"{len(failed)} of {len(wanted)} stages did not do it. {' '.join(failed)[:600]}",
                remedy="All others did. See these stages, and try again.",
            )

    def _named(self, stages: str) -> Sequence[str]:
        """Stages of the house by a name, a group or "all"."""
        chosen = [stages] if stages in self._stages else self._settings.groups.get(stages, [])
        named = [name for name in (self._stages if stages == "all" else chosen) if name in self._stages]
        if not named:
            raise UsageError(
                "house-stages-unknown",
                what=f"The house has no stage and no group {stages[:64]}.",
                remedy="Choose a stage of its page, a group of house.toml, or all.",
            )
        return named

    def _known(self, name: str) -> _Stage:
        if name not in self._stages:
            raise UsageError("house-stage-unknown", what=f"The house has no stage {name}.", remedy="Choose another.")
        return self._stages[name]

    # -- members

    def admit(self, address: str, code: str) -> None:
        hosts = [*self._settings.addresses, *own_addresses(), f"{socket.gethostname()}.local"]
        with self._changing:
            member = admit(self._authority, address, code, tuple(f"tls/{host}:{self._settings.port}" for host in hosts))
            self._open_again()
        self._record("house-joined", f"The stage {member.name} has joined the house.", "info")

    def remove(self, stage: str) -> None:
        self._known(stage)
        with self._changing:
            self._authority.remove(stage)
            self._open_again()

    def _open_again(self) -> None:
        self._link.close()
        self._open()

    # -- updates

    def plan(self, stages: str) -> list[str]:
        """Raises UsageError("house-no-update", "house-stages-unknown")."""
        package = self._package()
        if package is None:
            raise UsageError("house-no-update", what=f"There is no {UPDATE_FILE} beside {HOUSE_FILE}.",
                             remedy="Put the signed package of the new version there.")  # fmt: skip
        chosen = [self._now(name) for name in self._named(stages)]
        first, *others = (f"{stage.name} ({stage.version})" for stage in chosen)
        then = f" Once it has proved itself there: {', '.join(others)}." if others else ""
        new = news(package.changelog, {stage.version for stage in chosen if stage.version})
        return [f"Version {package.version} goes to {first}.{then}", *new]

    def update(self, stages: str) -> None:
        """Begin; it continues also after a restart. Raises as ``plan``."""
        self.plan(stages)
        write_atomically(self._stage / ROLLOUT, "\n".join(self._named(stages)).encode())
        self._pool.submit(self.roll_out)

    def stop_update(self) -> None:
        (self._stage / ROLLOUT).unlink(missing_ok=True)

    def _package(self) -> _Package | None:
        with contextlib.suppress(OSError):
            file = self._stage / UPDATE_FILE
            return _package_of(file, file.stat().st_mtime_ns)
        return None

    def rollout(self) -> Rollout:
        package, begun = self._package(), self._stage / ROLLOUT
        names = begun.read_text().split() if begun.exists() else []
        ordered = [*(name for name in names if name in self._stages), *sorted(self._stages.keys() - set(names))]
        rows = tuple(self._update_of(name, package, "waits" if name in names else "") for name in ordered)
        if package is None:
            return Rollout("", begun.exists(), rows)
        new = news(package.changelog, {stage.version for stage in rows if stage.version})
        return Rollout(package.version, begun.exists(), rows, tuple(new))

    def _update_of(self, name: str, package: _Package | None, before: str) -> StageUpdate:
        """``before``: its state until it has the package."""
        stage = self._stages[name]
        if stage.report is None:
            return StageUpdate(name, "", before)
        told = stage.report.update
        if package is not None and told.name == package.digest:
            return StageUpdate(name, stage.report.version, told.state, told.why)
        comes = before and package is not None and stage.offered == package.digest
        return StageUpdate(name, stage.report.version, "comes" if comes else before)

    def roll_out(self) -> None:
        """Bring the update to the first stage, and to the others once that reports that it is well. Raises OSError."""
        with self._rolling:
            now, package = self.rollout(), self._package()
            stages = [stage for stage in now.stages if stage.state]
            if not now.begun or package is None:
                return
            if failed := [stage for stage in stages if stage.state == "failed"]:
                self._give_up(f"{failed[0].name} went back. {failed[0].why}")
                return
            if all(stage.state == "done" for stage in stages):
                self.stop_update()
                names = ", ".join(stage.name for stage in stages)
                self._record("house-updated", f"The update is on {names}.", "info")
                return
            try:
                for stage in stages[: None if stages[0].state == "done" else 1]:
                    if stage.state == "waits" and self._stages[stage.name].linked:
                        self._offer(stage.name, package.file)
                        self._stages[stage.name].offered = package.digest
            except WorkError as error:
                # a stage that does not answer is asked again
                if error.code != "link-no-answer":
                    self._give_up(error.what)

    def _give_up(self, why: str) -> None:
        self.stop_update()
        self._record("house-update-failed", f"The update goes to no more stages. {why}", "error")

    def _offer(self, name: str, package: Path) -> None:
        arrived = send(self._link, f"member/{name}/package", package)
        self._link.ask(f"member/{name}/update", arrived, type(None))

    # -- backups

    def _newest_backup(self, name: str) -> float | None:
        folder = self._settings.backups
        if folder is None:
            return None
        ours = [one for one in (self._stage / folder / name).glob("*") if OURS.fullmatch(one.name)]
        return max((one.stat().st_mtime for one in ours), default=None)

    def _look_after(self) -> None:
        while not self._ended.wait(_LOOK_S):
            with contextlib.suppress(OSError):
                self.roll_out()
            for name in list(self._stages) if self._settings.backups is not None else ():
                if self._backup_due(name, time.time()):
                    self._fetch_backup(name)

    def _backup_due(self, name: str, now_s: float) -> bool:
        """Within some hours after ``backup_at``, if there is none since."""
        hour, minute = map(int, self._settings.backup_at.split(":"))
        now = datetime.fromtimestamp(now_s)
        late_s = ((now.hour - hour) * 3600 + (now.minute - minute) * 60) % 86400
        newest = self._newest_backup(name) or 0.0
        stage = self._stages[name]
        return late_s < _BACKUP_WINDOW_S and newest < now_s - late_s - 60 and stage.linked and (
            not 0 < stage.backup_again_s - now_s <= _AGAIN_S
        )  # fmt: skip

    def _fetch_backup(self, name: str) -> None:
        try:
            self.fetch_backup(name)
        except (VelaturaError, OSError) as error:
            self._stages[name].backup_again_s = time.time() + _AGAIN_S
            what = error.what if isinstance(error, VelaturaError) else f"A disk failed: {error.strerror}."
            self._record("house-backup-failed", f"No backup of {name} was made. {what}", "error")

    def fetch_backup(self, name: str) -> Path:
        """Make a backup of a stage now, in the house's folder. Minutes.

        Raises UsageError("house-no-backups"), WorkError, OSError; what was there before is then unchanged.
        """
        self._known(name)
        if self._settings.backups is None:
            raise UsageError("house-no-backups", what="house.toml names no folder for backups.",
                             remedy='Add backups = "FOLDER".')  # fmt: skip
        root = self._stage / self._settings.backups
        if not root.is_dir():
            raise WorkError("backup-folder-missing", what=f"The folder for backups, {root}, does not exist.",
                            remedy="Plug the disk in, mount it, or correct house.toml.")  # fmt: skip
        folder = root / name
        folder.mkdir(mode=0o700, exist_ok=True)
        made = self._link.ask(f"member/{name}/backup", b"", Offer, within_s=_BACKUP_S)
        coming = folder / ".coming"
        try:
            arrivals = Arrivals(coming, lambda file: None)  # it is checked where it is stored
            for number in arrivals.offered(made):
                arrivals.part(self._link.ask(f"member/{name}/part", number, bytes))
            arrivals.offered(made)
            day = f"{datetime.fromtimestamp(time.time()):%Y%m%d}"
            stored = BackupFolder(folder, self._stage).store(arrivals.path(made.name), day, self._settings.keep)
        finally:
            shutil.rmtree(coming, ignore_errors=True)
        self._record(stored.code, f"{name}: {stored.what}", "info")
        return folder / f"velatura-{day}.tar.gz"
