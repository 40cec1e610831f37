"""What goes wrong on the USB of a kiosk: every knob and deed of the emulated relay board, light sensor, keys, camera.

The lists are the emulators' own: ``UsbFaults``, the ``wrongs`` of each kind of device, ``CameraFaults`` and
``UsbCameraFaults``, and what a script may do on USB.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import Any, Final

from lab.emulated.scenario import ONCE
from lab.emulated.usb.device import EmulatedUsbDevice, UsbFaults
from lab.emulated.usb.process import KINDS, USB_ACTIONS, UsbBusProcess
from tests.campaigns.wired_faults import FOR_S, SLOW_S, Fault, Turn, goes_on, how_long, mend_projectors, values_of
from tests.campaigns.wired_kiosk import TETHER, TETHER_KNOBS, USB, WiredKiosk

WORDS: Final = {"board": "relay", "light": "light sensor", "keys": "key panel"}
"""What a technician calls each of them."""
ASKED: Final = ("board", "light")
"""The devices that are asked something again and again, so that one which does not answer is noticed at any step."""


def usb_faults() -> Iterator[Fault]:
    """Every knob and deed of every device of the kiosk's bus."""
    for name in USB:
        yield from _wire(name)
        yield from _wrongs(name)
        yield from _deeds(name)


def tether_faults() -> Iterator[Fault]:
    """Every knob and deed of a camera on USB. A kiosk plays on without it, and looks at it once a minute."""
    yield from (dataclasses.replace(fault, tethered=True) for fault in (*_wire(TETHER), *_deeds(TETHER)))
    for path, kind in TETHER_KNOBS.items():
        for knob in dataclasses.fields(kind):
            for value in values_of(knob):
                turn = _turn(TETHER, f"{path}.{knob.name}", value)
                yield Fault(f"{TETHER} {knob.name}={value}", turn, mend_usb, lasts=False, tethered=True)

    def off_and_on(kiosk: WiredKiosk) -> None:
        _bus(kiosk).call(TETHER, "camera_off_and_on")

    yield Fault(f"{TETHER} off and on", off_and_on, mend_usb, lasts=False, tethered=True)


def _wire(name: str) -> Iterator[Fault]:
    for knob in dataclasses.fields(UsbFaults):
        if knob.name == "lingers_s":  # nothing by itself
            yield _lingering(name)
            continue
        for value in values_of(knob):
            blocks = goes_on(value) and not isinstance(value, float) and name in ASKED
            turn, told = _turn(name, f"faults.{knob.name}", value), WORDS[name] if blocks else ""
            words = f"{name} wire" if name == TETHER else name
            # The person who was informed has noticed.
            yield Fault(f"{words} {knob.name}={value}", turn, mend_usb, goes_on(value) and not blocks, told)


def _lingering(name: str) -> Fault:
    """Its cable is pulled, and the machine is slow to notice."""

    def strike(kiosk: WiredKiosk) -> None:
        _bus(kiosk).set(name, "faults.lingers_s", SLOW_S)
        _bus(kiosk).unplug(name)

    return Fault(f"unplug of {name} lingering", strike, mend_usb, True, WORDS.get(name, "camera"))


def _wrongs(name: str) -> Iterator[Fault]:
    kind = KINDS[USB[name]["kind"]]
    assert isinstance(kind, type)
    assert issubclass(kind, EmulatedUsbDevice)
    for knob, values in kind.wrongs.items():
        for value in values:
            yield Fault(f"{name} {knob}={value}", _turn(name, knob, value), mend_usb)


def _deeds(name: str) -> Iterator[Fault]:
    for deed in USB_ACTIONS:
        for for_s in (FOR_S, 0.0):
            event = f'[[event]]\ndo = "{deed}"\nat_s = 0.0\nfor_s = {for_s}\ndelay_s = {SLOW_S}\n'

            def strike(kiosk: WiredKiosk, name: str = name, event: str = event) -> None:
                _bus(kiosk).play(name, event)

            lasts = not for_s and deed not in ONCE
            told = WORDS.get(name, "camera") if lasts and (name in ASKED or deed == "unplug") else ""
            yield Fault(f"{deed} of {name} {how_long(deed, for_s)}", strike, mend_usb, lasts, told)


def _turn(name: str, knob: str, value: Any) -> Turn:
    return lambda kiosk: _bus(kiosk).set(name, knob, value)


def mend_usb(kiosk: WiredKiosk) -> None:
    """Whole cables, boards, sensors and cameras. Nothing on a kiosk without USB."""
    if kiosk.bus is None:
        return
    for name in kiosk.well:
        kiosk.bus.rest(name)
        for knob in dataclasses.fields(UsbFaults):
            kiosk.bus.set(name, f"faults.{knob.name}", knob.default)
        for knob_name, value in kiosk.well[name].items():
            kiosk.bus.set(name, knob_name, value)
        kiosk.bus.plug(name)
    mend_projectors(kiosk)  # the mains went with the board


def usb_well(kiosk: WiredKiosk) -> str:
    """What is not in use again on a playing kiosk; "" for nothing."""
    if kiosk.bus is None:
        return ""
    devices = kiosk.service.devices
    supervisors = [devices.mains, devices.sensor, *([devices.camera] if TETHER in kiosk.well else [])]
    wrong = [supervisor.problem.text for supervisor in supervisors if supervisor and supervisor.problem]
    assert kiosk.service.keys is not None
    wrong.append(kiosk.service.keys.row.problem or "")
    if kiosk.bus.get("board", "state") != [True, True]:
        wrong.append("A projector has no mains.")
    if not kiosk.bus.call("keys", "picture_of", 0):
        wrong.append("The keys are dark.")
    return " ".join(filter(None, wrong))


def _bus(kiosk: WiredKiosk) -> UsbBusProcess:
    assert kiosk.bus is not None, "this kiosk has no USB"
    return kiosk.bus
