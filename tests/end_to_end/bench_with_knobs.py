"""The bench as a process, with its fault knobs on standard input: one line a knob, answered by ``{"knob": LINE}``.

Usage: python -m tests.end_to_end.bench_with_knobs STAGE. Lines: ``unplug left``, ``replug left``, ``silent left``,
``answering left``, ``camera off``.
"""

from __future__ import annotations

import json
import os
import sys
import threading
import traceback
from pathlib import Path
from typing import Any

from plugins.emulated import bench
from plugins.emulated.cameras.camera import PtpIpCamera
from plugins.emulated.projectors.lamp import EmulatedLamp
from plugins.emulated.projectors.serial import EmulatedSerialProjector

PROJECTORS: dict[str, EmulatedSerialProjector] = {}
CAMERAS: list[PtpIpCamera] = []


class KnownProjector(EmulatedSerialProjector):
    def __init__(self, port: Path, lamp: EmulatedLamp, **settings: Any) -> None:
        super().__init__(port, lamp, **settings)
        PROJECTORS[port.name.removeprefix("tty-")] = self


class KnownCamera(PtpIpCamera):
    def __init__(self, *arguments: Any, **settings: Any) -> None:
        super().__init__(*arguments, **settings)
        CAMERAS.append(self)


def turn(knob: str, name: str) -> None:
    if knob == "camera":
        CAMERAS[0].stop()
        return
    projector = PROJECTORS[name]
    if knob == "unplug":
        projector.unplug()
    elif knob == "replug":
        projector.replug()
    else:
        projector.faults.set(silent=knob == "silent")


def listen() -> None:
    for line in sys.stdin:
        try:
            turn(*line.split())
        except BaseException:  # noqa: BLE001 - a test that waits for the knob would wait for its timeout
            traceback.print_exc()
            os._exit(1)
        print(json.dumps({"knob": line.strip()}), flush=True)


if __name__ == "__main__":
    vars(bench).update(PtpIpCamera=KnownCamera, EmulatedSerialProjector=KnownProjector)
    threading.Thread(target=listen, daemon=True).start()
    sys.exit(bench.EmulatedBench().serve(Path(sys.argv[1]), json_lines=True))
