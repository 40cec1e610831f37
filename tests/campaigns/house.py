"""What a house costs with many stages: how soon all are linked, the page, and the processor.

    python -m tests.campaigns.house [STAGES]

The stages are kiosks in memory in a process of their own, which really join and change as lit stages do. The short
version, with three stages, is tests/controller/kiosk/house.
"""

from __future__ import annotations

import random
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from controller.kiosk.house.house import House, HouseSettings
from controller.kiosk.house.member import Member
from controller.kiosk.operations import house as operations
from tests.controller.kiosk.vase import vase
from tests.controller.panel.memory_kiosk import MemoryKiosk
from tests.controller.panel.served import served
from tests.ports import free_port
from tests.waiting import wait_for

MEASURED_S = 15.0


def stages(folder: Path, count: int) -> None:
    """Print port and code of each; after a line of input, each changes once in five seconds."""
    kiosks = []
    for number in range(count):
        own = folder / f"stage-{number:02}"
        kiosk, port = MemoryKiosk(own / "pictures"), free_port()
        member = Member(kiosk, vase(own / "stage"), host="127.0.0.1", port=port)
        kiosks.append((kiosk, member.__enter__()))
        print(port, member.invite(own.name).code, flush=True)
    sys.stdin.readline()
    chance = random.Random(1)
    while True:
        time.sleep(1.0)
        for kiosk, _ in kiosks:
            if chance.random() < 0.2:
                kiosk.change(reason=f"It is {chance.random():.3f}.")


def measure(folder: Path, count: int) -> None:
    command = [sys.executable, "-m", "tests.campaigns.house", "stages", str(folder), str(count)]
    settings = HouseSettings(name="City museum", addresses=["127.0.0.1"], port=free_port())
    with (
        subprocess.Popen(command, stdout=subprocess.PIPE, stdin=subprocess.PIPE, text=True) as child,
        House(folder / "house", settings, lambda *_: None, host="127.0.0.1") as house,
    ):
        try:
            assert child.stdout is not None
            assert child.stdin is not None
            for _ in range(count):
                port, code = child.stdout.readline().split()
                house.admit(f"127.0.0.1:{port}", code)
            began_s = time.monotonic()
            wait_for(lambda: all(one.linked and one.state for one in house.now().stages), within_s=120)
            print(f"all {count} linked after {time.monotonic() - began_s:.1f} s")
            child.stdin.write("\n")
            child.stdin.flush()
            cpu_s, wall_s = time.process_time(), time.monotonic()
            time.sleep(MEASURED_S)
            print(f"one core: {100 * (time.process_time() - cpu_s) / (time.monotonic() - wall_s):.1f} %")
            page(folder, house)
        finally:
            child.kill()


def page(folder: Path, house: House) -> None:
    own = operations.House(open=lambda: house)
    kiosk = MemoryKiosk(folder / "pictures")
    with served(kiosk, folder / "private", house=own) as panel, panel.entered("otto") as otto:
        times_ms, text = [], ""
        for _ in range(20):
            began_s = time.perf_counter()
            text = otto.get("/house").text
            times_ms.append(1000 * (time.perf_counter() - began_s))
        pictures = [otto.get(one).content for one in re.findall(r'src="(/see/[^"]+)"', text)]
        files = [otto.get(f"/static/{name}").content for name in ("style.css", "panel.js", "icon.svg")]
        files += [otto.get(f"/static/velatura-sans-{weight}.woff").content for weight in (400, 700)]
        sizes = [len(text.encode()), sum(map(len, pictures)), sum(map(len, files))]
        print(f"page: median {sorted(times_ms)[10]:.0f} ms, worst {max(times_ms):.0f} ms")
        print(f"bytes: text {sizes[0]}, {len(pictures)} pictures {sizes[1]}, files {sizes[2]}; in all {sum(sizes)}")


if __name__ == "__main__":
    if sys.argv[1:2] == ["stages"]:
        stages(Path(sys.argv[2]), int(sys.argv[3]))
    else:
        with tempfile.TemporaryDirectory() as name:
            measure(Path(name), int((sys.argv[1:] or ["50"])[0]))
