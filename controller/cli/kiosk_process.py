"""Runs ``velatura kiosk serve``: the service, its socket and the panel, until it is asked to stop."""

from __future__ import annotations

import contextlib
import os
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from controller.config.loader import FILE
from controller.core import kiosk_places
from controller.core.errors import UsageError, VelaturaError
from controller.core.storage import runtime_folder
from controller.kiosk.api.control import NAME, ControlServer
from controller.kiosk.api.kiosk import StageKiosk
from controller.kiosk.building import protocol as building
from controller.kiosk.building.protocol import Configured
from controller.kiosk.building.protocol import read as read_protocols
from controller.kiosk.operations.dispatch import socket_table
from controller.kiosk.operations.house import HOUSE_FILE, MEMBERSHIP, House, Stagehouse, no_link
from controller.kiosk.panel_address import PanelAccess, addresses, bracketed, keep_first_login
from controller.kiosk.service import Service
from controller.kiosk.serving import serving
from controller.kiosk.store.accounts import FOLDER
from controller.panel.mqtt.options import BrokerOptions, check_broker
from controller.play.control.notify import Notifier
from controller.run.progress import Reporter
from controller.stage.sessions.run import leave_runtime_folder, stage_lock
from hal.errors import CodedError, DeviceError
from hal.links import host_and_port
from hal.notices import Level

if TYPE_CHECKING:
    from controller.kiosk.house.house import House as OpenHouse
    from controller.kiosk.house.member import Member

RETRY_S: Final = 5.0
_NO_STAGE: Final = "There is no stage yet. Set it up in the panel."
PORT: Final = 8377


@dataclass(frozen=True, slots=True)
class PanelAddress:
    """Where the panel listens. ``names``: under which browsers may reach it, beside the host; ``broker``: of the
    building's control.
    """

    host: str = "127.0.0.1"
    port: int = PORT
    certificate: Path | None = None
    key: Path | None = None
    names: tuple[str, ...] = ()
    broker: BrokerOptions | None = None


def parse_address(text: str, usual_port: int = 0) -> tuple[str, int]:
    """``HOST:PORT`` or ``PORT``, with a ``usual_port`` ``HOST`` alone, too; an IPv6 host in brackets.

    Raises UsageError("address-wrong").
    """
    try:
        port = text.removeprefix(":")
        return host_and_port(f"127.0.0.1:{port}" if port.isdecimal() and not usual_port else text, usual_port)
    except DeviceError as error:
        raise UsageError(
            "address-wrong",
            what=f"{text[:64]!r} is not a valid address.",
            remedy="Write HOST:PORT, for example 127.0.0.1:8377 or [::1]:8377.",
        ) from error


def serve(
    *,
    stage: Path,
    panel: PanelAddress | None,
    leave_lit: bool,
    setup: bool,
    reporter: Reporter,
    cancel: threading.Event,
) -> Mapping[str, Any]:
    """Run the stage until ``cancel``; changed settings are read again.

    ``setup``: start without a valid stage.toml, for set-up in the panel.
    Raises what ``serving`` raises at the first start, unless ``setup``.
    """
    stage = stage.resolve()
    if panel is not None:
        _check_panel(panel)
    kiosk = StageKiosk(stage)
    protocols = _protocols(kiosk, reporter)
    notifier = Notifier()
    with contextlib.ExitStack() as stack:

        def open_to_others() -> PanelAccess | None:
            opened = _open_panel(stack, kiosk, panel, reporter)
            stack.enter_context(building.serving(kiosk, protocols))
            notifier.ready()
            return opened

        kiosk.house = _linked(stack, kiosk, reporter)
        stack.callback(_leave_runtime_folder, stage)
        stack.callback(notifier.stopping)
        first, socket_served, entrance, reported = True, False, None, ""
        while not cancel.is_set():
            kiosk.reload.clear()
            try:
                with serving(stage, cancel, leave_lit=leave_lit, alive=notifier.alive) as service:
                    reported = ""
                    kiosk.attach(service)
                    if not socket_served:
                        socket_served = True
                        path = runtime_folder(stage) / NAME
                        stack.enter_context(ControlServer(path, socket_table(kiosk.holders())))
                    if first:
                        first, entrance = False, open_to_others()
                        reporter.say(f"The kiosk {stage.name} is running.")
                    _wait(kiosk, cancel, over=_Correction(kiosk, service))
                kiosk.detach()
            except CodedError as error:
                if first and not setup:
                    raise
                missing = not (stage / FILE).exists()
                before, reported = reported, _NO_STAGE if missing else f"{error.what} {error.remedy}"
                kiosk.attach(None, "" if missing else reported)
                if reported != before:  # it is tried again every few seconds
                    # A new kiosk without a stage is no error.
                    reporter.say(reported, Level.INFO if missing else Level.ERROR)
                if first:
                    first, entrance = False, open_to_others()
                again_s = time.monotonic() + RETRY_S
                with _set_up_picture(kiosk, entrance):
                    _wait(kiosk, cancel, notifier.alive, partial(_may_begin, stage, missing=missing, again_s=again_s))
    return {"served": str(stage)}


def _leave_runtime_folder(stage: Path) -> None:
    # Another program that has the stage by now uses the folder, too.
    with contextlib.suppress(UsageError), stage_lock(stage):
        leave_runtime_folder(stage)


def _linked(stack: contextlib.ExitStack, kiosk: StageKiosk, reporter: Reporter) -> House:
    """This kiosk as a house (where it has a house.toml), and as a member of one; only then Zenoh is loaded. What is
    wrong with either must not keep the stage dark, so it is only reported.
    """
    members: list[Member] = []

    def member() -> Member:
        try:
            from controller.kiosk.house.member import Member
        except ImportError as error:
            raise no_link() from error
        if not members:
            members.append(stack.enter_context(Member(kiosk, kiosk.stage)))
        return members[0]

    def house() -> Stagehouse:
        if problem is not None:
            raise problem
        return opened[0]

    problem: VelaturaError | None = None
    opened: list[Stagehouse] = []
    is_house = (kiosk.stage / HOUSE_FILE).exists()
    try:
        if (kiosk.stage / MEMBERSHIP).exists():
            member()
        if is_house:
            opened.append(stack.enter_context(_house(kiosk)))
    except VelaturaError as error:
        problem = error
        kiosk.record(error.code, f"{error.what} {error.remedy}", "error")
        reporter.say(f"{error.what} {error.remedy} The stage runs without its house.", Level.ERROR)
    return House(house, member) if is_house else House(member=member)


def _house(kiosk: StageKiosk) -> OpenHouse:
    """Raises UsageError("no-house-link") and as ``house_settings`` and ``OpenHouse``."""
    try:
        from controller.kiosk.house.house import House as OpenHouse
        from controller.kiosk.house.house import house_settings
    except ImportError as error:
        raise no_link() from error
    settings = house_settings(kiosk.stage)
    assert settings is not None
    return OpenHouse(kiosk.stage, settings, kiosk.record)


def _protocols(kiosk: StageKiosk, reporter: Reporter) -> Sequence[Configured]:
    """Those of building.toml. A damaged one must not keep the stage dark, so it is only reported."""
    try:
        return read_protocols(kiosk.stage)
    except VelaturaError as error:
        kiosk.record(error.code, f"{error.what} {error.remedy}", "error")
        reporter.say(f"{error.what} {error.remedy} The stage runs without show control.", Level.ERROR)
        return ()


def _signature(stage: Path) -> tuple[int, int]:
    """Which changes with stage.toml."""
    with contextlib.suppress(OSError):
        found = (stage / FILE).stat()
        return found.st_mtime_ns, found.st_size
    return 0, 0


class _Correction:
    """Takes over a stage.toml that was damaged when the service started, once it is in order; always False."""

    def __init__(self, kiosk: StageKiosk, service: Service) -> None:
        self._kiosk, self._service, self._seen = kiosk, service, _signature(kiosk.stage)

    def __call__(self) -> bool:
        now = _signature(self._kiosk.stage)
        if self._service.problem is not None and now != self._seen:
            self._seen = now
            with contextlib.suppress(VelaturaError):
                self._kiosk.take_over()
        return False


def _check_panel(where: PanelAddress) -> None:
    """Before any device is opened. Raises what the panel's start would raise, and UsageError("file-unreadable")."""
    from controller.core.files import require_regular
    from controller.panel.server import check_port
    from controller.panel.tls import check_certificates, check_server_files

    broker = where.broker
    files = (where.certificate, where.key, *((broker.password_file, broker.certificates) if broker is not None else ()))
    for file in filter(None, files):
        try:
            require_regular(file)
            file.read_bytes()
        except OSError as error:
            raise UsageError("file-unreadable", what=f"{file} can't be read: {error.strerror}.",
                             remedy="Check the path, or omit the option.") from error  # fmt: skip
    check_server_files(where.certificate, where.key)
    if broker is not None:
        check_broker(broker)
        if broker.certificates is not None:
            check_certificates(broker.certificates)
    check_port(where.host, where.port)


def _may_begin(stage: Path, *, missing: bool, again_s: float) -> bool:
    """Whether it is time to try the stage again: once there is one, or after a while."""
    return (stage / FILE).exists() if missing else time.monotonic() > again_s


def _wait(
    kiosk: StageKiosk,
    cancel: threading.Event,
    alive: Callable[[], None] = lambda: None,
    over: Callable[[], bool] = lambda: False,
) -> None:
    while not (cancel.is_set() or kiosk.reload.is_set() or over()):
        alive()
        cancel.wait(0.2)


def _set_up_picture(kiosk: StageKiosk, entrance: PanelAccess | None) -> contextlib.AbstractContextManager[None]:
    """How to reach the panel, on the projectors of an installed kiosk that has no stage yet."""
    if entrance is None or (kiosk.stage / FILE).exists() or not kiosk_places.is_installed(kiosk.stage):
        return contextlib.nullcontext()
    from controller.kiosk.serving import setup_picture

    return setup_picture(entrance.lines)


def _open_panel(
    stack: contextlib.ExitStack, kiosk: StageKiosk, panel: PanelAddress | None, reporter: Reporter
) -> PanelAccess | None:
    return None if panel is None else stack.enter_context(_panel(kiosk, panel, reporter))


def _journalled() -> bool:
    """Whether what is printed is kept in systemd's journal, where a password must not stand (systemd.exec(5))."""
    output = os.fstat(sys.stdout.fileno())
    return os.environ.get("JOURNAL_STREAM") == f"{output.st_dev}:{output.st_ino}"


@contextlib.contextmanager
def _panel(kiosk: StageKiosk, where: PanelAddress, reporter: Reporter) -> Iterator[PanelAccess]:
    """The panel in its own thread. The player is another process, so that no page delays a picture."""
    from controller.kiosk.store.accounts import FIRST_ACCOUNT
    from controller.panel.app import make_panel
    from controller.panel.context import PanelOptions
    from controller.panel.server import PanelServer
    from controller.panel.tls import out_of_date

    options = PanelOptions(
        folder=kiosk.stage / FOLDER, host=where.host, port=where.port,
        tls_certificate=where.certificate, tls_key=where.key, broker=where.broker,
    )  # fmt: skip
    options = replace(options, names=tuple(bracketed(name).lower() for name in where.names))
    options = replace(options, hosts=(*options.hosts, bracketed(where.host), *options.names))
    if where.certificate is not None and (problem := out_of_date(where.certificate)):
        kiosk.record("panel-certificate-date", problem, "warning")
        kiosk.warn("certificate", problem)
    accounts = kiosk.held_accounts()
    password = accounts.first_start()
    app = make_panel(kiosk, accounts, options, house=kiosk.house)
    kiosk.sessions_ended = app.state.panel.sessions.end_all
    server = PanelServer(app, options)
    address = server.start()
    for one in addresses(address) or (address,):
        reporter.say(f"The panel is at {one}.")
    entrance = PanelAccess(address, () if password is None else (FIRST_ACCOUNT, password), lambda: accounts.entered)
    if password is not None:
        if _journalled():
            keep_first_login(runtime_folder(kiosk.stage), FIRST_ACCOUNT, password)
        else:
            reporter.say(f"First login: {FIRST_ACCOUNT}, password {password} (once).", Level.WARNING)
        # Only capitals can be shown, and the one-time password is taken in capitals, too.
        kiosk.announce(entrance.lines(), lambda: accounts.entered)
    try:
        yield entrance
    finally:
        server.stop()
