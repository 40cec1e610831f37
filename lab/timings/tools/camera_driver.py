"""``python -m lab.timings.tools.camera_driver BUS FLAVOUR BYTES FOLDER``: time captures, and print them as JSON.

BUS is ``ptpip``, or ``usb`` under the preload library on the emulated bus in FOLDER. The camera has its own process.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import count
from pathlib import Path
from statistics import median

from hal.deadline import in_seconds
from hal.registry import OpenContext
from hal.values import ExposureSettings
from lab.emulated.usb.process import UsbBusProcess
from lab.timings import timed
from plugins.ptp.camera import open_camera

EXPOSURE_S = 1 / 30
REPEATS = 7


@contextmanager
def serving(bus: str, flavour: str, size: int, folder: Path) -> Iterator[str]:
    """An emulated camera whose every RAW file has ``size`` bytes or a few more; its address."""
    if bus == "usb":
        with UsbBusProcess(folder) as process:
            process.add("camera", "camera", flavour=flavour, size=size, time_scale=0.0)
            yield "usb:"
        return
    command = [sys.executable, "-m", "lab.timings.tools.camera", str(size), flavour]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as camera:
        assert camera.stdout is not None
        try:
            yield camera.stdout.readline().strip()
        finally:
            camera.terminate()


def peak_here() -> int:
    """The most memory of this very program in bytes; what rusage tells includes the one that started it."""
    status = Path("/proc/self/status").read_text()
    return 1024 * next(int(line.split()[1]) for line in status.splitlines() if line.startswith("VmHWM"))


def main(bus: str, flavour: str, size: str, folder: str) -> None:
    """Take pictures, and tell how long one took and how much memory this process had."""
    number, spent_s = count(), list[float]()
    with serving(bus, flavour, int(size), Path(folder)) as address, tempfile.TemporaryDirectory() as pictures:
        camera = open_camera({"address": address}, OpenContext(Path(pictures)), in_seconds(10))
        try:
            camera.configure(ExposureSettings(EXPOSURE_S, 100), deadline=in_seconds(10))

            def capture() -> None:
                began_s = time.process_time()
                for file in camera.capture(Path(pictures) / f"{next(number)}", deadline=in_seconds(60)):
                    if abs(file.size - int(size)) > 8:
                        raise AssertionError(f"the camera sent {file.size} bytes instead of {size}")
                    file.path.unlink()
                spent_s.append(time.process_time() - began_s)

            timing = timed(capture, repeats=REPEATS)
        finally:
            camera.close()
    told = {"words": str(timing), "median": timing.median, "cpu": median(spent_s), "peak": peak_here()}
    print(json.dumps(told))


if __name__ == "__main__":
    main(*sys.argv[1:])
