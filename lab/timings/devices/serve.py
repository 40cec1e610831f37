"""The kiosk's service as systemd starts it: from the command to a picture, over a player that hangs, and at rest."""

from __future__ import annotations

import contextlib
import itertools
import json
import os
import signal
import socket
import statistics
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from controller.bundle.install import install
from controller.bundle.signing import load_signing_key
from controller.bundle.writer import NewAppearance, NewBundle, write_bundle
from controller.core.errors import VelaturaError
from controller.core.storage import runtime_folder
from controller.kiosk.api.control import call_kiosk
from controller.kiosk.schedule import WEEKDAYS
from controller.stage.sessions.bench import BenchProcess
from controller.stage.sessions.calibrations import KEY_FILE, output_sizes
from controller.stage.sessions.check import check_stage
from lab.timings import Row, at_most
from lab.timings.tools.panels import OpenPanels, log_in, make_account
from lab.timings.tools.stage import FIRST_SEED, prepared_stage
from tests.controller.play.wire import Wire
from tests.waiting import meanwhile

STARTS = 5
HANGS = 3
LONGEST_S = 60.0
REST_S = 5.0
PACED_S = 20.0
RATE_HZ = 30.0
PAGES = 15
OPEN = 50
CHANGES, LISTEN_S = 10, 2.0
PORT = 18377
NAME = "grey"


def measure(size: str) -> list[Row]:
    """Boots with warm lamps, restarts of a player that was stopped, and the service's processor time while it plays."""
    with prepared_stage(size, FIRST_SEED) as stage:
        install_grey(stage)
        cancel = threading.Event()
        with BenchProcess(stage, cancel=cancel):
            with service(stage) as warm:
                wait_for(stage, "playing")
                warm.send_signal(signal.SIGKILL)  # lamps stay lit, as after a crash
                warm.wait()
            boots = [_boot(stage) for _ in range(STARTS)]
            with service(stage) as served:
                wait_for(stage, "playing")
                hangs = [_hang(stage) for _ in range(HANGS)]
                share = _at_rest(served.pid)
                served.terminate()
                served.wait()
            panels = _panels(stage)
    return [
        at_most("boot to pictures, lamps warm", statistics.median(boots), 3.0, unit="s", how=_spread(boots)),
        at_most("player stopped by SIGSTOP, until a picture", max(hangs), 5.0, unit="s", how=_spread(hangs)),
        at_most("service while playing", 100 * share, 10.0, unit="% of a core", how=f"over {REST_S:g} s"),
        *panels,
    ]


def _panels(stage: Path) -> list[Row]:
    """The first page, and what open panels cost: nothing to tell, and four changes a second (the closing hour)."""
    make_account(stage)
    with service(stage, "--panel", f"127.0.0.1:{PORT}") as served:
        wait_for(stage, "playing")
        browser = log_in(PORT)
        pages = [browser.first_page() for _ in range(PAGES)]
        alone, nobody = _at_rest(served.pid), _busy(stage, served.pid)
        with OpenPanels(browser, OPEN) as panels:
            time.sleep(2.0)
            resting = _at_rest(served.pid)
            before = panels.received
            busy = _busy(stage, served.pid)
            told = (panels.received - before) / OPEN / REST_S
            busy_paced = _paced(stage)
            told_s = _told_after(stage, panels)
        quiet_paced = _paced(stage, changes=False)
    seconds = [seconds for seconds, _ in pages]
    return [
        at_most("first page with all it loads", max(size for _, size in pages) / 1e3, 100.0, unit="kB",
                how="page, style sheet, script, icon"),
        at_most("first page with all it loads, time", 1e3 * statistics.median(seconds), 150.0, unit="ms",
                how=_spread(seconds)),
        at_most(f"{OPEN} open panels, nothing changes", 100 * (resting - alone), 10.0, unit="% of a core",
                how=f"processor time over {REST_S:g} s, less that without them"),
        at_most(f"{OPEN} open panels, something changes all the time", 100 * (busy - nobody), 10.0,
                unit="% of a core", how=f"as above; {told:.0f} bytes a second to each"),
        at_most(f"swaps late at {RATE_HZ:g} Hz, {OPEN} open panels, something changes", float(busy_paced.late), 0.0,
                unit="", how=f"more than a tick late, over {PACED_S:g} s; {quiet_paced.late} with no panel"),
        at_most(f"a change of the state on {OPEN} open pages", max(told_s), 1.0, unit="s", how=_spread(told_s)),
        at_most(f"p99 at {RATE_HZ:g} Hz, {OPEN} open panels, something changes", busy_paced.p99_ms, None, unit="ms",
                how=f"{quiet_paced.p99_ms:.1f} ms with no panel"),
    ]  # fmt: skip


@dataclass(frozen=True, slots=True)
class Pace:
    """The player's own figures of a sequence."""

    late: int
    p99_ms: float


def _paced(stage: Path, *, changes: bool = True) -> Pace:
    """Have the kiosk's player swap at ``RATE_HZ``, while the service's state changes or does not."""
    with _changing(stage) if changes else contextlib.nullcontext(), Wire(runtime_folder(stage) / "player.sock") as wire:
        wire.ask("sequence", items=[[NAME, 1 / RATE_HZ]], rate_hz=RATE_HZ)
        time.sleep(PACED_S)
        status = wire.ask("status")
        assert status["sequence_running"], "somebody else asked for another picture"
        return Pace(status["late"], 1e3 * status["interval_p99_s"])


def _busy(stage: Path, pid: int) -> float:
    """As ``_at_rest``, while the state changes as often as panels are updated."""
    with _changing(stage):
        return _at_rest(pid)


@contextlib.contextmanager
def _changing(stage: Path) -> Iterator[None]:
    """Inside, the hour at which the stage closes changes, which leaves what is played as it is."""
    closing = itertools.cycle(("23:58", "23:59"))
    with meanwhile(lambda: _close_at(stage, next(closing)), every_s=0.25):
        yield


def _close_at(stage: Path, closes: str) -> None:
    hours = {"opens": "00:00", "closes": closes, "appearance": NAME}
    call_kiosk(stage, "set-schedule", time_zone="UTC", rows=[{"day": day, **hours} for day in WEEKDAYS])


def _told_after(stage: Path, panels: OpenPanels) -> list[float]:
    """Seconds from a change of the kiosk's state until the last of the open pages has heard of it, over several."""
    spans = []
    for minute in range(10, 10 + CHANGES):
        heard, began_s, last_s = panels.received, time.perf_counter(), float("inf")
        _close_at(stage, f"23:{minute}")
        while time.perf_counter() < began_s + LISTEN_S:
            if panels.received > heard:
                heard, last_s = panels.received, time.perf_counter()
            time.sleep(0.001)
        spans.append(last_s - began_s)
    return spans


def install_grey(stage: Path) -> None:
    """Install a signed bundle of one grey appearance, so that there is something to play without a calibration."""
    checked = check_stage(stage)
    outputs = list(output_sizes(checked).values())
    frames = {name: np.full((height, width, 3), 96, np.uint8) for name, (width, height) in outputs}
    built, key_file = stage / "grey.vel", stage / KEY_FILE
    key = load_signing_key(key_file) if key_file.exists() else None
    write_bundle(
        built,
        NewBundle(
            stage=checked.stage.tables.stage.name,
            calibration="none",
            created_unix_s=int(time.time()),
            outputs=[(name, *pixels) for name, pixels in outputs],
        ),
        appearances=[NewAppearance(NAME, frames)],
        key=key,
    )
    trusted = () if key is None else (bytes(key.verify_key),)
    install(built, stage / "bundles", trusted=trusted, allow_unsigned=key is None)


@contextlib.contextmanager
def service(stage: Path, *options: str) -> Iterator[subprocess.Popen[bytes]]:
    """``velatura kiosk serve`` in its own process (without options without panel), its lamps left lit at the end."""
    options = options or ("--no-panel",)
    command = [sys.executable, "-m", "controller", "kiosk", "serve", str(stage), "--leave-lit", *options]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL) as process:
        try:
            yield process
        finally:
            process.terminate()


def wait_for(stage: Path, state: str) -> dict[str, Any]:
    """The status once the kiosk is in this state; TimeoutError with the last one."""
    until_s, last = time.monotonic() + LONGEST_S, {}
    while time.monotonic() < until_s:
        with contextlib.suppress(VelaturaError):
            last = dict(call_kiosk(stage, "status", timeout_s=2.0))
            if last["state"] == state:
                return last
        time.sleep(0.02)
    raise TimeoutError(last)


def _boot(stage: Path) -> float:
    before = _player_pid(stage)
    began_s = time.perf_counter()
    with service(stage) as process:
        # The player of the service before plays on; its picture does not count.
        while _player_pid(stage) in (0, before):
            time.sleep(0.01)
        _wait_for_picture(stage)
        seconds = time.perf_counter() - began_s
        process.send_signal(signal.SIGKILL)
        process.wait()
    return seconds


def _wait_for_picture(stage: Path) -> None:
    """Until the player that runs now shows the appearance: asked of the player itself."""
    path, until_s = runtime_folder(stage) / "player.sock", time.monotonic() + LONGEST_S
    while time.monotonic() < until_s:
        with contextlib.suppress(OSError, ValueError), socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as channel:
            channel.settimeout(0.5)
            channel.connect(str(path))
            channel.sendall(b'{"op":"status"}\n')
            answer = json.loads(channel.makefile().readline())
            if answer.get("appearance") == NAME:
                return
        time.sleep(0.01)
    raise TimeoutError("no picture")


def _hang(stage: Path) -> float:
    pid = _player_pid(stage)
    os.kill(pid, signal.SIGSTOP)
    began_s = time.perf_counter()
    while _player_pid(stage) in (0, pid):
        time.sleep(0.02)
    _wait_for_picture(stage)
    seconds = time.perf_counter() - began_s
    time.sleep(1.0)
    return seconds


def _player_pid(stage: Path) -> int:
    """Of the process that owns the player's socket; 0 while there is none."""
    with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as channel:
        channel.settimeout(0.2)
        channel.connect(str(runtime_folder(stage) / "player.sock"))
        return int(struct.unpack("3i", channel.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, 12))[0])
    return 0


def _at_rest(pid: int) -> float:
    def used_s() -> float:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")

    before_s = used_s()
    time.sleep(REST_S)
    return (used_s() - before_s) / REST_S


def _spread(values: list[float]) -> str:
    return f"{min(values):.2f} to {max(values):.2f} s over {len(values)}"
