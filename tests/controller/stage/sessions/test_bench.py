from __future__ import annotations

import os
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from controller.stage.sessions.bench import BenchProcess
from hal.deadline import Cancelled
from hal.errors import DeviceError

ENDS_WITH_INPUT = """
import signal, time
from controller.stage.sessions.bench import terminated_when_input_ends
asked = []
signal.signal(signal.SIGTERM, lambda *_: asked.append("asked to end"))
terminated_when_input_ends()
print("ready", flush=True)
while not asked:
    time.sleep(0.01)
print(*asked, flush=True)
"""


def test_what_the_bench_refuses_is_raised_as_it_tells_it(tmp_path: Path) -> None:
    said: list[str] = []
    with pytest.raises(DeviceError) as refused, BenchProcess(tmp_path, cancel=threading.Event(), tell=said.append):
        pytest.fail("there is no stage to serve")
    assert refused.value.code == "bench-file-missing"
    assert "velatura demo --prepare-only" in refused.value.remedy
    assert said == ["Starting the bench (the emulated stage)."]


def test_a_stop_while_it_starts_ends_it(tmp_path: Path) -> None:
    cancel = threading.Event()
    cancel.set()
    with pytest.raises((Cancelled, DeviceError)), BenchProcess(tmp_path, cancel=cancel):
        pytest.fail("there is no stage to serve")


def test_a_child_is_asked_to_end_when_its_parent_is_gone_without_a_word() -> None:
    """As after SIGKILL: the system closes the dead parent's end of the pipe."""
    reading, writing = os.pipe()
    sleeping = [sys.executable, "-c", "import time; time.sleep(600)"]
    with (
        subprocess.Popen(sleeping, pass_fds=[writing]) as parent,
        subprocess.Popen(
            [sys.executable, "-c", ENDS_WITH_INPUT], stdin=reading, stdout=subprocess.PIPE, text=True
        ) as child,
    ):
        try:
            os.close(reading)
            os.close(writing)
            assert child.stdout is not None
            assert child.stdout.readline() == "ready\n"
            time.sleep(0.1)
            assert child.poll() is None
            parent.kill()
            assert child.communicate(timeout=60)[0] == "asked to end\n"
            assert child.returncode == 0
        finally:
            parent.kill()
            child.kill()
