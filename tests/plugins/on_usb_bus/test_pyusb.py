"""Unchanged pyusb on Debian's libusb takes the emulated bus for a real one."""

from __future__ import annotations

import errno
import threading
import time
from collections.abc import Iterator
from typing import Any

import pytest
import usb.core
import usb.util

from lab.emulated.usb.process import UsbBusProcess

ECHO = "tests.plugins.on_usb_bus.echo:EchoDevice"
VENDOR_OUT, VENDOR_IN = 0x40, 0xC0


def found() -> Any:
    return usb.core.find(idVendor=0x1209, idProduct=0x0001)


@pytest.fixture
def echo(bus: UsbBusProcess) -> Iterator[Any]:
    bus.add("echo", ECHO)
    device = found()
    assert device is not None
    device.set_configuration()
    yield device
    usb.util.dispose_resources(device)


def test_a_device_is_listed_with_its_names_and_pipes(bus: UsbBusProcess, echo: Any) -> None:
    bus.add("other", ECHO, serial="E-2")
    assert (echo.manufacturer, echo.product, echo.serial_number) == ("Tests", "Echo", "E-1")
    assert (echo.bus, echo.address) == (1, bus.bus("address_of", "echo"))
    pipes = list(echo.get_active_configuration()[(0, 0)])
    assert [(pipe.bEndpointAddress, pipe.wMaxPacketSize) for pipe in pipes] == [(0x81, 512), (0x02, 512), (0x83, 64)]
    listed = usb.core.find(find_all=True, idVendor=0x1209)
    assert sorted(usb.util.get_string(one, one.iSerialNumber) for one in listed) == ["E-1", "E-2"]


def test_control_requests_carry_bytes_both_ways_and_an_unknown_one_is_stalled(echo: Any) -> None:
    assert echo.ctrl_transfer(VENDOR_OUT, 1, 0, 0, b"stored") == 6
    assert bytes(echo.ctrl_transfer(VENDOR_IN, 1, 0, 0, 64)) == b"stored"
    assert bytes(echo.ctrl_transfer(VENDOR_IN, 1, 0, 0, 3)) == b"sto"
    with pytest.raises(usb.core.USBError) as caught:
        echo.ctrl_transfer(VENDOR_IN, 2, 0, 0, 64)
    assert caught.value.errno == errno.EPIPE


@pytest.mark.parametrize("count", [1, 511, 512, 513, 65_536, 70_000])
def test_bulk_transfers_of_any_length_come_back_whole(echo: Any, count: int) -> None:
    data = bytes(index * 7 & 0xFF for index in range(count))
    assert echo.write(0x02, data, 2000) == count
    # Longer than the data, so that only the short packet, or the empty one, can end it.
    assert bytes(echo.read(0x81, 131_072, 2000)) == data


def test_a_silent_pipe_times_out_and_loses_nothing(bus: UsbBusProcess, echo: Any) -> None:
    started = time.monotonic()
    with pytest.raises(usb.core.USBTimeoutError):
        echo.read(0x83, 64, 100)
    assert 0.09 < time.monotonic() - started < 10
    bus.call("echo", "say", "late")
    assert bytes(echo.read(0x83, 64, 2000)) == b"late"


def test_a_halted_pipe_stalls_until_it_is_cleared(bus: UsbBusProcess, echo: Any) -> None:
    bus.call("echo", "halt")
    with pytest.raises(usb.core.USBError) as caught:
        echo.read(0x81, 512, 1000)
    assert caught.value.errno == errno.EPIPE
    echo.clear_halt(0x81)
    echo.write(0x02, b"again", 1000)
    assert bytes(echo.read(0x81, 512, 1000)) == b"again"


def test_a_slow_device_is_waited_for(bus: UsbBusProcess, echo: Any) -> None:
    bus.set("echo", "faults.slow_s", 0.2)
    started = time.monotonic()
    echo.ctrl_transfer(VENDOR_OUT, 1, 0, 0, b"x", 2000)
    assert 0.19 < time.monotonic() - started < 10


def test_unplugging_ends_a_waiting_read_and_a_replugged_device_has_another_address(
    bus: UsbBusProcess, echo: Any
) -> None:
    before = echo.address
    pull = threading.Timer(0.2, bus.unplug, ["echo"])
    pull.start()
    started = time.monotonic()
    with pytest.raises(usb.core.USBError) as caught:
        echo.read(0x81, 512, 10_000)
    assert time.monotonic() - started < 10
    assert not isinstance(caught.value, usb.core.USBTimeoutError)
    pull.join()
    with pytest.raises(usb.core.USBError) as gone:
        echo.write(0x02, b"x", 500)
    assert gone.value.errno in (errno.ENODEV, errno.EIO)
    assert found() is None
    bus.plug("echo")
    again = found()
    assert again is not None
    assert again.address == bus.bus("address_of", "echo") != before
    again.set_configuration()
    again.write(0x02, b"back", 1000)
    assert bytes(again.read(0x81, 512, 1000)) == b"back"
    usb.util.dispose_resources(again)


def test_only_one_program_has_an_interface(bus: UsbBusProcess, echo: Any) -> None:
    usb.util.claim_interface(echo, 0)
    other = found()
    with pytest.raises(usb.core.USBError) as caught:
        usb.util.claim_interface(other, 0)
    assert caught.value.errno == errno.EBUSY
    usb.util.dispose_resources(other)
    usb.util.release_interface(echo, 0)


def test_the_kernels_driver_is_detached_and_attached_again(bus: UsbBusProcess) -> None:
    bus.add("relay", "relay", channels=1)
    board = usb.core.find(idVendor=0x16C0)
    assert board.is_kernel_driver_active(0)
    with pytest.raises(usb.core.USBError):
        usb.util.claim_interface(board, 0)
    board.detach_kernel_driver(0)
    assert not bus.bus("driver_bound", "relay")
    usb.util.claim_interface(board, 0)
    usb.util.release_interface(board, 0)
    board.attach_kernel_driver(0)
    assert bus.bus("driver_bound", "relay")
    usb.util.dispose_resources(board)


def test_a_scenario_pulls_the_plug_at_its_time_and_puts_it_back(bus: UsbBusProcess, echo: Any) -> None:
    bus.play("echo", '[[event]]\ndo = "unplug"\nat_s = 0.1\nfor_s = 0.3\n')
    deadline = time.monotonic() + 30.0
    while found() is not None and time.monotonic() < deadline:
        time.sleep(0.01)
    assert found() is None
    while found() is None and time.monotonic() < deadline:
        time.sleep(0.01)
    assert found() is not None
    assert [deed for _, deed in bus.happened("echo")] == ["unplug"]


def test_a_scenario_stalls_just_the_message_it_names(bus: UsbBusProcess, echo: Any) -> None:
    bus.play("echo", '[[event]]\ndo = "cut"\non_message = 2\n')
    echo.ctrl_transfer(VENDOR_OUT, 1, 0, 0, b"12345678")
    assert bytes(echo.ctrl_transfer(VENDOR_IN, 1, 0, 0, 64)) == b"1234"
    assert bytes(echo.ctrl_transfer(VENDOR_IN, 1, 0, 0, 64)) == b"12345678"
