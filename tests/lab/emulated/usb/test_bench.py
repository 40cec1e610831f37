"""USB devices of an emulated stage: seen by a program in the environment that the bench tells, and faulty by script."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from hal.errors import DeviceError
from lab.emulated.usb.bench import UsbDevices, read_usb
from plugins.emulated.core.truth import USB_FILE

USB = """
[[device]]
name = "cupboard"
kind = "relay"
serial = "STAGE"
channels = 4
[[device]]
name = "dark"
kind = "light"
lux = 0.25
"""
LOOK = """
import hid
print(sorted(one["product_string"] for one in hid.enumerate()))
"""


def written(folder: Path, text: str) -> Path:
    (folder / USB_FILE).parent.mkdir(parents=True, exist_ok=True)
    (folder / USB_FILE).write_text(text)
    return folder


def products(variables: dict[str, str]) -> str:
    done = subprocess.run([sys.executable, "-c", LOOK], env={**os.environ, **variables}, capture_output=True, text=True,
                          timeout=60, check=True)  # fmt: skip
    return done.stdout.strip()


def test_a_program_with_the_told_environment_sees_the_devices_until_the_bench_ends(tmp_path: Path) -> None:
    devices = read_usb(written(tmp_path, USB))
    with UsbDevices(devices) as usb:
        assert products(usb.environment) == "['ColorHugALS', 'USBRelay4']"
        folder = Path(usb.environment["UMOCKDEV_DIR"])
    assert not folder.exists()


def test_a_scenario_unplugs_a_device(tmp_path: Path) -> None:
    script = '[[event]]\ndo = "unplug"\ndevice = "dark"\nat_s = 0.0\n'
    with UsbDevices(read_usb(written(tmp_path, USB)), script) as usb:
        # A program that looks at the very moment of unplugging may see the device half gone.
        ends_s = time.monotonic() + 30
        while (seen := products(usb.environment)) != "['USBRelay4']" and time.monotonic() < ends_s:
            time.sleep(0.1)
        assert seen == "['USBRelay4']"


def test_a_stage_without_the_file_has_none(tmp_path: Path) -> None:
    assert read_usb(tmp_path) == ()


@pytest.mark.parametrize(
    ("right", "wrong"), [('"relay"', '"toaster"'), ('"dark"', '"cupboard"'), ("channels = 4", "channels = 40")]
)
def test_a_wrong_file_is_refused(tmp_path: Path, right: str, wrong: str) -> None:
    with pytest.raises(DeviceError) as caught:
        read_usb(written(tmp_path, USB.replace(right, wrong)))
    assert "usb.toml" in caught.value.what


def test_only_one_camera_looks_at_the_stage(tmp_path: Path) -> None:
    two = "".join(f'[[device]]\nname = "{name}"\nkind = "stage-camera"\n' for name in ("one", "other"))
    with pytest.raises(DeviceError) as caught:
        read_usb(written(tmp_path, two))
    assert caught.value.code == "usb-kind"
