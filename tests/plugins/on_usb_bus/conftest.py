"""Tests in this folder run inside a process under the umockdev preload library: see ``test_on_usb_bus.py``."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from lab.emulated.usb.process import UsbBusProcess

collect_ignore_glob = [] if "UMOCKDEV_DIR" in os.environ else ["test_*.py"]


@pytest.fixture(scope="session")
def bus_process() -> Iterator[UsbBusProcess]:
    with UsbBusProcess(Path(os.environ["UMOCKDEV_DIR"])) as bus:
        yield bus


@pytest.fixture
def bus(bus_process: UsbBusProcess) -> Iterator[UsbBusProcess]:
    """An emulated USB bus without devices, which this very process sees."""
    yield bus_process
    bus_process.clear()
