from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from controller.demo.bench_process import BenchProcess
from hal.deadline import Cancelled
from hal.errors import DeviceError

ENDS_WITH_INPUT = """
import signal, sys
from controller.demo.bench_process import terminated_when_input_ends
# It ends in the handler: the signal may come before the pause.
signal.signal(signal.SIGTERM, lambda *_: (print("asked to end", flush=True), sys.exit(0)))
terminated_when_input_ends()
print("ready", flush=True)
signal.pause()
"""


def test_what_the_bench_refuses_is_raised_as_it_tells_it(tmp_path: Path) -> None:
    said: list[str] = []
    with pytest.raises(DeviceError) as refused, BenchProcess(tmp_path, cancel=threading.Event(), tell=said.append):
        pytest.fail("there is no stage to serve")
    assert refused.value.code == "bench-file-missing"
    assert "velatura demo --prepare-only" in refused.value.remedy
    assert said == ["Starting the bench: an emulated stage in a process of its own."]


def test_a_stop_while_it_starts_ends_it(tmp_path: Path) -> None:
    cancel = threading.Event()
    cancel.set()
    with pytest.raises((Cancelled, DeviceError)), BenchProcess(tmp_path, cancel=cancel):
        pytest.fail("there is no stage to serve")


@pytest.mark.parametrize("way", ["closed", "killed"])
def test_a_child_is_asked_to_end_when_its_input_closes(way: str) -> None:
    """``killed``: the parent is gone without a word, as after SIGKILL; the system closes its end of the pipe."""
    reading, writing = os.pipe()
    parent = subprocess.Popen([sys.executable, "-c", "import signal; signal.pause()"], pass_fds=[writing])
    child = subprocess.Popen(
        [sys.executable, "-c", ENDS_WITH_INPUT], stdin=reading, stdout=subprocess.PIPE, text=True, close_fds=True
    )
    os.close(reading)
    assert child.stdout is not None
    assert child.stdout.readline() == "ready\n"
    if way == "killed":
        os.close(writing)
        parent.kill()
    else:
        parent.kill()
        parent.wait(10)
        os.close(writing)
    assert child.communicate(timeout=20)[0] == "asked to end\n"
    assert child.returncode == 0
    parent.wait(10)
    assert parent.returncode == -signal.SIGKILL
