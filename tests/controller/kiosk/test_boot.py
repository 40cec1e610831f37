"""What a kiosk loads before its first picture."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Final

HEAVY: Final = ("scipy", "numba", "cv2", "skimage", "OpenEXR", "rawpy", "trimesh", "matplotlib")
STAGE: Final = """
[stage]
name = "demo"
[[projectors]]
name = "left"
output = "P1"
driver = "serial"
profile = "optoma-later"
port = "/dev/ttyUSB0"
[camera]
driver = "ptp"
address = "ptpip:127.0.0.1:15740:15741"
iso = 100
focal_length_px = 5200.0
[display]
driver = "player"
frames = "run/outputs.frame"
[[display.outputs]]
name = "P1"
width_px = 280
height_px = 210
"""
PROBE: Final = """
import sys
from pathlib import Path
from controller.stage.sessions.check import check_stage
from controller.kiosk.store.event_log import EventLog
from controller.kiosk.api.kiosk import StageKiosk
from controller.cli.kiosk_process import serve
from controller.kiosk.service import Service
stage = Path(sys.argv[1])
kiosk = StageKiosk(stage)
service = Service(check_stage(stage), EventLog(stage / EventLog.FILE))
kiosk.attach(service)
service.reconciler.step()
service.changed()
assert kiosk.snapshot().state == "off", kiosk.snapshot()
print(*[name for name in sys.argv[2:] if name in sys.modules])
"""


def test_nothing_that_calibrates_is_loaded_before_the_first_picture(tmp_path: Path) -> None:
    (tmp_path / "stage.toml").write_text(STAGE)
    probe = subprocess.run(
        [sys.executable, "-c", PROBE, str(tmp_path), *HEAVY], capture_output=True, text=True, check=False
    )
    assert (probe.returncode, probe.stdout.split()) == (0, []), probe.stderr
