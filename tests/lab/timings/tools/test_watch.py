"""The reader beside the player must notice a mixed set, or its zero means nothing."""

from __future__ import annotations

import json
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np

from controller.play.frames import FrameFile, FrameSet, OutputSize
from lab.timings.tools.watch import digest

OUTPUTS = (OutputSize("P1", 40, 30), OutputSize("P2", 40, 30))
SETS = 6


def _set(first: int, second: int) -> FrameSet:
    return FrameSet(tuple(np.full((30, 40, 3), value, np.uint8) for value in (first, second)))


def _digest(shown: FrameSet) -> str:
    return digest({output.name: image for output, image in zip(OUTPUTS, shown.pixels, strict=True)})


def _watch(path: Path, shown: list[FrameSet], known: list[FrameSet]) -> dict[str, Any]:
    """Present ``shown`` in turn until the reader, which knows ``known``, has its sets."""
    file, ended = FrameFile(path, OUTPUTS), threading.Event()
    file.write(known[0])

    def present() -> None:
        number = 0
        while not ended.is_set():
            file.write(shown[number % len(shown)])
            number += 1
            time.sleep(0.01)

    writer = threading.Thread(target=present)
    writer.start()
    command = [sys.executable, "-m", "lab.timings.tools.watch", str(path), str(SETS), "20", *map(_digest, known)]
    try:
        done = subprocess.run(command, stdout=subprocess.PIPE, check=True, text=True)
    finally:
        ended.set()
        writer.join()
        file.close()
    found: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return found


def test_whole_sets_are_counted_and_none_is_mixed(tmp_path: Path) -> None:
    sets = [_set(1, 1), _set(2, 2)]
    found = _watch(tmp_path / "frames", sets, sets)
    assert found["read"] == SETS
    assert found["mixed"] == 0
    assert found["passed"] >= SETS - 1


def test_a_set_of_two_appearances_is_noticed(tmp_path: Path) -> None:
    known = [_set(1, 1), _set(2, 2)]
    found = _watch(tmp_path / "frames", [_set(1, 2), known[1]], known)
    assert found["mixed"] > 0


def test_the_order_of_outputs_does_not_matter_but_their_pictures_do() -> None:
    a, b = np.zeros((2, 2, 3), np.uint8), np.ones((2, 2, 3), np.uint8)
    assert digest({"P1": a, "P2": b}) == digest({"P2": b, "P1": a})
    assert digest({"P1": a, "P2": b}) != digest({"P1": b, "P2": a})
