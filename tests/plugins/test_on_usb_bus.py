"""Runs the tests of ``on_usb_bus`` in processes that see an emulated USB bus instead of this machine's.

They wait more than they work, so a few of them run side by side; each test here is the outcome of one.
"""

from __future__ import annotations

import ctypes
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

import pytest

from lab.emulated.usb.bus import PRELOAD, environment

FOLDER = Path(__file__).parent / "on_usb_bus"
ROOT = FOLDER.parents[2]
NAMES = sorted(path.name for path in FOLDER.glob("test_*.py"))
RECOVERY = "test_ptp_usb_recovery.py"
"""Waits for the time limits of a cable that is pulled and of a camera that hangs: for `make test-long`."""
LONG = (RECOVERY, "test_ptp_usb.py", "test_hid.py")
SIDE_BY_SIDE = 3

Outcome = subprocess.CompletedProcess[str]


def _run(name: str) -> Outcome:
    # A unix socket's path is short, and pytest's own folders are not.
    with (
        tempfile.TemporaryDirectory(prefix="usb", dir="/tmp") as bus,
        tempfile.TemporaryDirectory(prefix="velatura-") as base,  # pytests that share one clear it up at the same time
    ):
        return subprocess.run(
            [
                sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-p", "no:xdist",
                "-p", "no:schemathesis",
                f"--basetemp={base}/pytest", str(FOLDER / name),
            ],
            env={**os.environ, **environment(Path(bus))},
            cwd=ROOT,
            capture_output=True,
            text=True,
            timeout=600,
            check=False,
        )  # fmt: skip


@pytest.fixture(scope="module")
def outcomes(request: pytest.FixtureRequest) -> Iterator[Mapping[str, Future[Outcome]]]:
    """The files whose tests were asked for, the long ones first."""
    try:
        ctypes.CDLL(PRELOAD)
    except OSError as error:
        pytest.fail(f"{PRELOAD} is missing: run `make test`, whose set-up installs it (Debian: umockdev): {error}")
    wanted = {item.callspec.params["name"] for item in request.session.items if item.path == Path(__file__)}  # type: ignore[attr-defined]
    with ThreadPoolExecutor(SIDE_BY_SIDE) as pool:
        yield {name: pool.submit(_run, name) for name in sorted(wanted, key=lambda name: name not in LONG)}
        pool.shutdown(cancel_futures=True)


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.long) if name == RECOVERY else name for name in NAMES]
)
def test_under_the_preload_library(outcomes: Mapping[str, Future[Outcome]], name: str) -> None:
    done = outcomes[name].result()
    assert done.returncode == 0, done.stdout[-8000:] + done.stderr[-4000:]
