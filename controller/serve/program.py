"""What ``velatura serve`` runs: the service, its socket and the panel, until it is told to end."""

from __future__ import annotations

import base64
import contextlib
import threading
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

from controller.errors import UsageError, VelaturaError
from controller.panel.accounts import Accounts
from controller.panel.broker import BrokerOptions
from controller.panel.kiosk import ComputeSettings, Schedule, ScheduleRow
from controller.serve.account_ops import FOLDER, account_operations, stage_accounts
from controller.serve.control import NAME, ControlServer, Operation
from controller.serve.kiosk import StageKiosk
from controller.serve.service import serving
from controller.session.progress import Level, Reporter
from controller.storage import runtime_folder
from hal.errors import DeviceError

RETRY_S: Final = 5.0
PORT: Final = 8377


@dataclass(frozen=True, slots=True)
class PanelAddress:
    """Where the panel listens. ``names``: under which browsers may reach it, besides the host; ``broker``: of the
    building's control.
    """

    host: str = "127.0.0.1"
    port: int = PORT
    certificate: Path | None = None
    key: Path | None = None
    names: tuple[str, ...] = ()
    broker: BrokerOptions | None = None


def parse_address(text: str) -> tuple[str, int]:
    """``HOST:PORT`` or ``PORT``. Raises UsageError("address-wrong")."""
    host, _, port = text.rpartition(":")
    if not port.isdecimal() or not 0 < int(port) < 65536:
        raise UsageError("address-wrong", what=f"{text[:64]!r} is no address.", remedy="Write HOST:PORT.")
    return host.strip("[]") or "127.0.0.1", int(port)


def serve(
    *,
    stage: Path,
    panel: PanelAddress | None,
    leave_lit: bool,
    setup: bool,
    reporter: Reporter,
    cancel: threading.Event,
) -> Mapping[str, Any]:
    """Run the stage until ``cancel``; the settings are read again when somebody saves them.

    ``setup``: go on without a valid stage.toml, for the panel's first page.
    Raises what ``serving`` raises at the first start, unless ``setup``.
    """
    stage = stage.resolve()
    kiosk = StageKiosk(stage)
    with contextlib.ExitStack() as stack:
        first, socket_served = True, False
        while not cancel.is_set():
            kiosk.reload.clear()
            try:
                with serving(stage, cancel, leave_lit=leave_lit) as service:
                    kiosk.attach(service)
                    if not socket_served:
                        socket_served = True
                        path = runtime_folder(stage) / NAME
                        stack.enter_context(ControlServer(path, operations(kiosk)))
                    if first:
                        _open_panel(stack, kiosk, panel, reporter)
                        reporter.say(f"{stage.name} is served.")
                        first = False
                    _wait(kiosk, cancel)
                kiosk.detach()
            except (VelaturaError, DeviceError) as error:
                if first and not setup:
                    raise
                kiosk.attach(None, f"{error.what} {error.remedy}" if (stage / "stage.toml").exists() else "")
                reporter.say(f"{error.what} {error.remedy}", Level.ERROR)
                if first:
                    _open_panel(stack, kiosk, panel, reporter)
                    first = False
                kiosk.reload.wait(RETRY_S)
    return {"served": str(stage)}


def _wait(kiosk: StageKiosk, cancel: threading.Event) -> None:
    while not cancel.is_set() and not kiosk.reload.is_set():
        cancel.wait(0.2)


def _open_panel(stack: contextlib.ExitStack, kiosk: StageKiosk, panel: PanelAddress | None, reporter: Reporter) -> None:
    if panel is not None:
        stack.enter_context(_panel(kiosk, panel, reporter))


@contextlib.contextmanager
def _panel(kiosk: StageKiosk, where: PanelAddress, reporter: Reporter) -> Iterator[None]:
    """The panel in a thread of its own. The player is another process, so that no page delays a picture."""
    from controller.panel.accounts import FIRST_ACCOUNT
    from controller.panel.app import make_panel
    from controller.panel.context import PanelOptions
    from controller.panel.server import PanelServer

    options = PanelOptions(
        folder=kiosk.stage / FOLDER, host=where.host, port=where.port,
        tls_certificate=where.certificate, tls_key=where.key, broker=where.broker,
    )  # fmt: skip
    options = replace(options, hosts=(*options.hosts, where.host, *where.names))
    accounts = _accounts(kiosk)
    password = accounts.first_start()
    app = make_panel(kiosk, accounts, options)
    kiosk.sessions_ended = app.state.panel.sessions.end_all
    server = PanelServer(app, options)
    address = server.start()
    reporter.say(f"The panel is at {address}.")
    if password is not None:
        reporter.say(f"First login: {FIRST_ACCOUNT}, password {password} (once).", Level.WARNING)
        # Only capitals can be shown, and the one-time password is taken in capitals, too.
        kiosk.announce(("velatura", address, FIRST_ACCOUNT, password), lambda: accounts.entered)
    try:
        yield
    finally:
        server.stop()


def operations(kiosk: StageKiosk) -> dict[str, Operation]:
    """What the socket offers: the kiosk's own methods, their arguments as JSON has them."""

    def set_schedule(time_zone: str, rows: list[dict[str, str]], drift_check: str = "") -> None:
        kiosk.set_schedule(Schedule(time_zone, tuple(ScheduleRow(**row) for row in rows), drift_check))

    def compute(name: str, target: str, brightness: float | None = None) -> object:
        return kiosk.compute(name, Path(target), ComputeSettings(brightness))

    def restore(backup: str) -> None:
        kiosk.restore(Path(backup))

    def sessions_ended(name: str) -> None:
        kiosk.sessions_ended(name)

    def feasibility(target: str) -> Path:
        return kiosk.feasibility(Path(target))

    def camera_picture() -> str | None:
        jpeg = kiosk.camera_picture()
        return None if jpeg is None else base64.b64encode(jpeg).decode()

    same = (
        kiosk.recalibrate, kiosk.cancel, kiosk.play, kiosk.stop, kiosk.start, kiosk.appearances, kiosk.events,
        kiosk.remove_appearance, kiosk.schedule, kiosk.lamp_history, kiosk.identify, kiosk.doctor, kiosk.backup,
        kiosk.diagnostics, kiosk.settings, kiosk.validate_settings, kiosk.save_settings, kiosk.runs, kiosk.results,
        kiosk.report, kiosk.compare, kiosk.comparisons, kiosk.aiming, kiosk.test_shots, kiosk.find_devices,
        kiosk.try_device, kiosk.job,
    )  # fmt: skip
    table: dict[str, Operation] = {method.__name__.replace("_", "-"): method for method in same}
    return table | {
        "status": kiosk.snapshot, "set-schedule": set_schedule, "compute": compute, "restore": restore,
        "feasibility": feasibility, "camera-picture": camera_picture,
        **account_operations(lambda: _accounts(kiosk), sessions_ended),
    }  # fmt: skip


_opening_accounts: Final = threading.Lock()


def _accounts(kiosk: StageKiosk) -> Accounts:
    """The one that the panel and everybody at the socket change: another would write over what they have written."""
    with _opening_accounts:
        if kiosk.accounts is None:
            kiosk.accounts = stage_accounts(kiosk.stage)
        return kiosk.accounts
