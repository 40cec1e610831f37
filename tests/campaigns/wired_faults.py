"""What goes wrong on the wires of a kiosk: every knob and deed of the emulated projectors, the camera and the player.

The lists are the emulators' own. ``usb_faults`` has those of the devices on USB.
"""

from __future__ import annotations

import dataclasses
import signal
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Final

from lab.emulated.scenario import ACTIONS, ONCE, FaultEvent, Scenario, ScenarioPlayer
from plugins.emulated.cameras.body import CameraFaults
from plugins.emulated.core.faults import WireFaults
from tests.campaigns.wired_kiosk import WiredKiosk

FOR_S: Final = 8.0
"""How long a deed lasts that ends by itself."""
SLOW_S: Final = 2.0
MANY: Final = 1_000_000
TARGET: Final = "left"
Turn = Callable[[WiredKiosk], None]


@dataclass(frozen=True, slots=True)
class Fault:
    """``lasts``: until it is repaired; ``told``: words in what the technician must then be informed of at every step.

    ``tethered``: strikes only where the camera is on USB.
    """

    name: str
    strike: Turn
    repair: Turn
    lasts: bool = True
    told: str = ""
    tethered: bool = False


def values_of(knob: dataclasses.Field[Any]) -> tuple[Any, ...]:
    """What a knob is turned to, by its kind: a switch on, seconds, a count of one and one that does not end."""
    default = knob.default
    if isinstance(default, bool):
        return (not default,)
    return (SLOW_S,) if isinstance(default, float) else (1, MANY)


def goes_on(value: object) -> bool:
    """Whether what a knob is turned to lasts; a count of one is used up."""
    return value is True or value != 1


def wire_faults() -> Iterator[Fault]:
    """The knobs of a projector's wire."""
    for knob in dataclasses.fields(WireFaults):
        for value in values_of(knob):

            def strike(kiosk: WiredKiosk, name: str = knob.name, value: object = value) -> None:
                kiosk.projectors[TARGET].faults.set(**{name: value})

            yield Fault(f"wire {knob.name}={value}", strike, mend_projectors, goes_on(value))


def camera_faults() -> Iterator[Fault]:
    """The knobs of the camera."""
    for knob in dataclasses.fields(CameraFaults):
        for value in values_of(knob):

            def turn(kiosk: WiredKiosk, name: str = knob.name, value: object = value) -> None:
                setattr(kiosk.camera.faults, name, value)

            def back(kiosk: WiredKiosk, name: str = knob.name, value: object = knob.default) -> None:
                setattr(kiosk.camera.faults, name, value)

            yield Fault(f"camera {knob.name}={value}", turn, back, lasts=False)


def how_long(deed: str, for_s: float) -> str:
    return f"for {for_s:g} s" if for_s else "once" if deed in ONCE else "for good"


def deeds() -> Iterator[Fault]:
    """What a script may do to a projector, for a while and for good; and to all of them at once."""
    for deed in ACTIONS:
        for who in (TARGET, ""):
            for for_s in (FOR_S, 0.0):

                def strike(kiosk: WiredKiosk, do: str = deed, who: str = who, for_s: float = for_s) -> None:
                    for name, wire in kiosk.projectors.items():
                        scenario = Scenario((FaultEvent(do, who, at_s=0.0, for_s=for_s, delay_s=SLOW_S),))
                        wire.scenario = ScenarioPlayer(
                            scenario, device=name, faults=wire.faults, lamp=kiosk.lamps[name], plug=wire
                        )

                name = f"{deed} of {who or 'everyone'} {how_long(deed, for_s)}"
                yield Fault(name, strike, mend_projectors, not for_s and deed not in ONCE)


def mend_projectors(kiosk: WiredKiosk) -> None:
    """New lamps, whole cables, and a technician who says so."""
    for name, wire in kiosk.projectors.items():
        wire.scenario = None
        wire.faults.clear()
        wire.replug()
        if wire.wedged:
            wire.cut_mains()
            wire.restore_mains()
        kiosk.lamps[name].repair()
    for supervisor in kiosk.service.devices.projectors:
        supervisor.forgive()


def processes() -> Iterator[Fault]:
    """The camera that is switched off, and the player that hangs or dies."""

    def nothing(kiosk: WiredKiosk) -> None:
        """It is started again by the service."""

    yield Fault("camera off", lambda kiosk: kiosk.camera.stop(), lambda kiosk: (kiosk.camera.start(), None)[1])
    yield Fault("camera connection lost", lambda kiosk: kiosk.camera.drop_connection(), nothing, lasts=False)
    yield Fault("player hung", lambda kiosk: kiosk.signal_player(signal.SIGSTOP), nothing, lasts=False)
    yield Fault("player killed", lambda kiosk: kiosk.signal_player(signal.SIGKILL), nothing, lasts=False)
