"""Runs the tests of ``on_usb_bus`` in processes that see an emulated USB bus instead of this machine's."""

from __future__ import annotations

import ctypes
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from plugins.emulated.usb_bus import PRELOAD, environment

FOLDER = Path(__file__).parent / "on_usb_bus"
ROOT = FOLDER.parents[2]


@pytest.mark.parametrize("name", sorted(path.name for path in FOLDER.glob("test_*.py")))
def test_under_the_preload_library(name: str) -> None:
    try:
        ctypes.CDLL(PRELOAD)
    except OSError as error:
        pytest.fail(f"{PRELOAD} is missing: run `make test`, whose set-up installs it (Debian: umockdev): {error}")
    # A unix socket's path is short, and pytest's own folders are not.
    with tempfile.TemporaryDirectory(prefix="usb", dir="/tmp") as bus:
        done = subprocess.run(
            [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-p", "no:xdist", str(FOLDER / name)],
            env={**os.environ, **environment(Path(bus))},
            cwd=ROOT,
            capture_output=True,
            text=True,
            timeout=240,
            check=False,
        )
    assert done.returncode == 0, done.stdout[-8000:] + done.stderr[-4000:]
