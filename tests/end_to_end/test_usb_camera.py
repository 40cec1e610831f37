"""The stage's camera on USB: a calibration through the real libusb, with a cable that is pulled again and again.

On the stage is a painting with one projector, of which a calibration gives no shape.
"""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from plugins.emulated.core.truth import USB_FILE, read_truth
from tests.campaigns.mini_stage import prepare_mini
from tests.campaigns.wired_kiosk import tether
from tests.end_to_end.program import Command, velatura, wrong_code

pytestmark = [pytest.mark.long, pytest.mark.timeout(600)]
PULLED_AT_S = range(4, 240, 6)


def test_a_painting_is_calibrated_by_a_camera_on_usb_whose_cable_is_pulled(tmp_path: Path) -> None:
    stage = prepare_mini(tmp_path, thing="painting", projectors=1)
    tether(stage)
    (stage / USB_FILE).write_text('[[device]]\nname = "camera"\nkind = "stage-camera"\n')
    script = tmp_path / "cable.toml"
    events = (f'[[event]]\ndo = "unplug"\ndevice = "camera"\nat_s = {at_s}\nfor_s = 0.5\n' for at_s in PULLED_AT_S)
    script.write_text("".join(events))
    assert wrong_code(velatura("calibrate", stage), code=3)
    with Command("emulate", stage, "--scenario", script) as bench:
        sees = bench.wait_for_key("environment")["environment"]
        bench.wait_for_key("ready")
        assert not any("ptpip" in record.get("address", "") for record in bench.records), "it is on the network, too"
        done = Command("calibrate", stage, more=sees).outcome()
        assert done.code == 0, done.error
    assert velatura("report", done.result["run"]).code == 0
    report = json.loads((Path(done.result["run"]) / "report.json").read_text())
    assert report["shape"]["shape"] == "plane"
    assert report["shape"]["code"] == "one-projector"
    errors = dict(part.split(" ")[:2] for part in done.result["error"].split(", "))
    assert sorted(errors) == sorted(projector.name for projector in read_truth(stage).projectors)
    assert max(map(float, errors.values())) < 2
