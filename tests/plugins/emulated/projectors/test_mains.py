"""What [[mains]] of bench.toml may say; what relays then do is shown in on_usb_bus/test_mains.py."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest

from hal.errors import DeviceError
from lab.emulated.usb.bench import UsbDeviceTruth
from lab.emulated.usb.mains import check_mains
from plugins.emulated.core.truth import BenchTruth, MainsTruth, read_truth, write_truth

BOARD = UsbDeviceTruth("cupboard", "relay", channels=2)
LIGHT = UsbDeviceTruth("dark", "light")
LEFT = MainsTruth("cupboard", 1, ("left", "right"), 12.0)


def test_it_is_kept_in_bench_toml(tiny_truth: BenchTruth, tmp_path: Path) -> None:
    for mains in ((), (LEFT, MainsTruth("cupboard", 2, ("above",)))):
        truth = dataclasses.replace(tiny_truth, mains=mains)
        write_truth(tmp_path, truth)
        assert read_truth(tmp_path) == truth
    check_mains(mains, tiny_truth.projectors, (BOARD, LIGHT))


@pytest.mark.parametrize(
    "second",
    [
        MainsTruth("cupboard", 3, ("above",)),
        MainsTruth("elsewhere", 1, ("above",)),
        MainsTruth("dark", 1, ("above",)),
        MainsTruth("cupboard", 1, ("above",)),
        MainsTruth("cupboard", 2, ("left",)),
        MainsTruth("cupboard", 2, ("nobody",)),
    ],
)
def test_a_wrong_wiring_is_named_by_its_table(tiny_truth: BenchTruth, second: MainsTruth) -> None:
    with pytest.raises(DeviceError, match=r"\[\[mains\]\] table 2") as caught:
        check_mains((LEFT, second), tiny_truth.projectors, (BOARD, LIGHT))
    assert caught.value.code == "mains-wrong"
