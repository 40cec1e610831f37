"""The processes by which a house solves: Dask's scheduler on the house, and a worker on each stage while it is closed.

A kiosk says when, by what it leaves in ``peer_folder``. The service `velatura-worker` sees that folder and nothing else
of the stage, because a worker runs code of other computers. It is ended before the stage opens; Dask then solves
elsewhere what it was solving.
"""

from __future__ import annotations

import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Final

from controller.kiosk.state import KioskState
from controller.stage.link.membership import Membership
from controller.stage.link.peers import PORT, peer, scheduler_at, tls_files

BEFORE_S: Final = 600.0
"""So long before the stage opens its computer is free again."""
YOUNG_S: Final = 60.0
"""A kiosk that has not said for so long that its stage is closed does not say so any more."""
_CLOSED: Final = "closed"
_LOOK_S: Final = 1.0
_AGAIN_S: Final = 10.0
_END_S: Final = 5.0
_LOCAL: Final = ("--no-dashboard", "--dashboard-address", "127.0.0.1:0")
_MEMORY: Final = "0.5"
"""Of this computer's, from which on Dask's worker uses its disk; the service has a limit above it."""


def may_solve(state: KioskState, now_s: float) -> bool:
    """Whether a stage leaves its computer to solves: it is closed, and does not open soon."""
    soon = state.next_event
    opens = soon is not None and soon.what == "opens" and soon.at_unix_s - now_s < BEFORE_S
    return state.state == "off" and not opens


def say_closed(folder: Path, closed: bool) -> None:
    """To be said again and again while the stage is closed. Raises OSError."""
    if closed:
        (folder / _CLOSED).touch(mode=0o640)
    else:
        (folder / _CLOSED).unlink(missing_ok=True)


def work(folder: Path, cancel: threading.Event) -> None:
    """Run what this computer is to run now, until ``cancel``. Raises OSError."""
    process: subprocess.Popen[bytes] | None = None
    running, again_s = None, 0.0
    try:
        while not cancel.is_set():
            wanted = _wanted(folder)
            if process is not None and (wanted != running or process.poll() is not None):
                _end(process)
                process = None
            if process is None and wanted is not None and time.monotonic() >= again_s:
                # Not at once after one that has ended by itself: its scheduler may be off.
                running, again_s = wanted, time.monotonic() + _AGAIN_S
                process = _begun(wanted[1])
            cancel.wait(_LOOK_S)
    finally:
        if process is not None:
            _end(process)


def _wanted(folder: Path) -> tuple[float, Membership] | None:
    """None if nothing is to run, else who this is, and when its certificate changed: it is started again after that."""
    try:
        here = peer(folder)
        if here is None:
            return None
        file = folder / _CLOSED
        if here.endpoints and (not file.exists() or abs(time.time() - file.stat().st_mtime) > YOUNG_S):
            return None
        return here.folder.stat().st_ctime, here
    except OSError:  # it is being exchanged
        return None


def _begun(here: Membership) -> subprocess.Popen[bytes] | None:
    files = [str(file) for file in tls_files(here)]
    tls = [word for pair in zip(("--tls-ca-file", "--tls-cert", "--tls-key"), files, strict=True) for word in pair]
    if not here.endpoints:
        words = ["scheduler", "--protocol", "tls", "--port", str(PORT)]
    elif (address := scheduler_at(here)) is not None:
        words = ["worker", address, "--name", here.name, "--nthreads", "1", "--no-nanny", "--memory-limit", _MEMORY]
    else:
        return None
    return subprocess.Popen([sys.executable, "-m", "dask", *words, *tls, *_LOCAL])  # noqa: S603 - words of ours


def _end(process: subprocess.Popen[bytes]) -> None:
    process.terminate()
    try:
        process.wait(_END_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
