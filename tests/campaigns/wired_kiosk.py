"""A kiosk's service on real drivers: pseudo terminals, TCP, USB, a player process; every device an emulator with knobs.

The devices on USB are there where this very process runs under the preload library, with a bus (``usb_environment``).
"""

from __future__ import annotations

import contextlib
import os
import signal
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import fields
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Self

from controller.kiosk import service as services
from controller.kiosk.decide.stage_states import Limits
from controller.kiosk.service import Service
from controller.kiosk.serving import serving
from controller.run.state_machine import State
from lab.emulated.cameras.camera import EmulatedPtpCamera
from lab.emulated.usb.bus import environment
from lab.emulated.usb.camera import STAGE_CAMERA, ExposureServer, UsbCameraFaults
from lab.emulated.usb.mains import Mains
from lab.emulated.usb.process import KINDS, UsbBusProcess
from lab.timings.devices.serve import install_grey
from plugins.emulated.cameras.body import CameraFaults, CameraNames
from plugins.emulated.core.truth import MainsTruth, read_truth
from plugins.emulated.projectors.lamp import LampTiming
from plugins.emulated.projectors.serial import EmulatedSerialProjector
from tests.campaigns.mini_stage import HonestLamp, SteadyWorld, prepare_mini
from tests.processes import children, command_of

POLL_S: Final = 0.02
STEADY_S: Final = 3.0
"""A state that has lasted so long is settled."""
BOOT_S: Final = 0.3
COOL_S: Final = 100.0
"""For so long a lamp may not go off before that is a fault: 900 s in a kiosk, and nothing else happens in between."""
USB: Final[Mapping[str, Mapping[str, Any]]] = {
    "board": {"kind": "relay", "channels": 2, "serial": "MAINS"},
    "light": {"kind": "light", "lux": 0.5},
    "keys": {"kind": "keys"},
}
_ADDRESS: Final = "ptpip:127.0.0.1:"
TETHER: Final = "tether"
"""The stage's camera, where it is on USB."""
TETHER_KNOBS: Final[Mapping[str, type[CameraFaults] | type[UsbCameraFaults]]] = {
    "camera_faults": CameraFaults, "pipe_faults": UsbCameraFaults,
}  # fmt: skip
_TABLES: Final = """
[[relays]]
name = "board"
driver = "usb-relay"
serial = "MAINS"
boot_s = 0.5
[[relays.mains]]
channel = 1
feeds = ["left"]
[[relays.mains]]
channel = 2
feeds = ["right"]

[light_sensor]
driver = "colorhug-als"
most_lux = 2.0

[key_panel]
driver = "stream-deck"
"""


@contextlib.contextmanager
def usb_environment() -> Iterator[dict[str, str]]:
    """What a kiosk's process must have in its environment, so that it has USB devices."""
    with tempfile.TemporaryDirectory(prefix="usb", dir="/tmp") as folder:
        yield environment(Path(folder))


def prepare_wired(out: Path, *, usb: bool = False, tethered: bool = False) -> Path:
    """A stage with a bundle to play and its rays cast, to be copied for as many kiosks as are needed.

    ``tethered``: its camera is on USB, and not on the network.
    """
    stage = prepare_mini(out)
    if usb:
        with (stage / "stage.toml").open("a", encoding="utf-8") as known:
            known.write(_TABLES)
    if tethered:
        tether(stage)
    truth = read_truth(stage)
    install_grey(stage)
    with SteadyWorld(stage, truth, [HonestLamp(LampTiming(1.0, 1.0)) for _ in truth.projectors]):
        return stage


def tether(stage: Path) -> None:
    """Let ``stage.toml`` name the camera on USB."""
    known, camera = stage / "stage.toml", read_truth(stage).camera
    text, address = known.read_text(), f'"{_ADDRESS}{camera.command_port}:{camera.event_port}"'
    assert address in text
    known.write_text(text.replace(address, f'"usb:{camera.serial_number}"'))


class WiredKiosk:
    """One kiosk. Knobs: ``projectors`` and ``lamps`` by name, ``camera``, ``bus``, and the player's process.
    On a tethered stage the camera is ``TETHER`` on the bus, and ``camera`` is not there.

    ``well``: what the knobs of the USB devices' own stand at while nothing is wrong.
    """

    def __init__(self, stage: Path) -> None:
        self.stage = stage
        truth = read_truth(stage)
        self._tethered = _ADDRESS not in (stage / "stage.toml").read_text()
        self.sins: list[str] = []
        self.lamps = {
            one.name: HonestLamp(LampTiming(one.lamp.warm_up_s, one.lamp.cool_down_s)) for one in truth.projectors
        }
        for name, lamp in self.lamps.items():
            lamp.told = lambda sin, name=name: self.sins.append(f"{name} {sin}")  # type: ignore[misc]
        self._world = SteadyWorld(stage, truth, list(self.lamps.values()))
        self.projectors = {
            one.name: EmulatedSerialProjector(stage / one.port, self.lamps[one.name], boot_s=BOOT_S)
            for one in truth.projectors
        }
        self.bus: UsbBusProcess | None = None
        self.well: dict[str, dict[str, Any]] = {}
        self._damages = 0
        self.camera = EmulatedPtpCamera(
            self._world.expose, ports=(truth.camera.command_port, truth.camera.event_port),
            names=CameraNames(serial=truth.camera.serial_number), time_scale=0.0, raw=truth.camera.raw,
        )  # fmt: skip
        self._camera = truth.camera
        self._stack = contextlib.ExitStack()
        self._beaten_s, self.longest_gap_s = time.monotonic(), 0.0
        self.starved_s = 0.0
        self.service: Service

    def __enter__(self) -> Self:
        with contextlib.ExitStack() as stack:
            stack.enter_context(self._world)
            for projector in self.projectors.values():
                stack.enter_context(projector)
            if not self._tethered:
                stack.enter_context(self.camera)
            if "UMOCKDEV_DIR" in os.environ:
                self.bus = stack.enter_context(self._usb(Path(os.environ["UMOCKDEV_DIR"])))
            vars(services)["Limits"] = lambda power_up_s, cool_down_s: Limits(power_up_s, COOL_S)
            self.service = stack.enter_context(serving(self.stage, threading.Event()))
            self.service.changed = self._beat
            self._stack = stack.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.close()

    @contextlib.contextmanager
    def _usb(self, folder: Path) -> Iterator[UsbBusProcess]:
        """The bus with its devices, and mains that go through its relays."""
        with contextlib.ExitStack() as stack, UsbBusProcess(folder) as bus:
            for name, settings in USB.items():
                bus.add(name, **settings)
                own = getattr(KINDS[settings["kind"]], "wrongs", {})
                self.well[name] = {knob: bus.get(name, knob) for knob in own}
            if self._tethered:
                exposures = stack.enter_context(ExposureServer(self._world.expose))
                bus.add(TETHER, STAGE_CAMERA, **exposures.camera(self._camera))
                knobs = [f"{path}.{knob.name}" for path, kind in TETHER_KNOBS.items() for knob in fields(kind)]
                self.well[TETHER] = {knob: bus.get(TETHER, knob) for knob in knobs}
            circuits = [MainsTruth("board", channel, (name,)) for channel, name in enumerate(self.projectors, start=1)]

            def moves(relay: str, count: int) -> list[tuple[int, bool]]:
                return [(channel, closed) for channel, closed in bus.call(relay, "moves_since", count)]

            with Mains(circuits, self.projectors, moves, self._fed):
                yield bus

    def _fed(self, projector: str, on: bool, _: int) -> None:
        """A hot lamp that loses its mains is a sin of ours, unless the board was unplugged."""
        before, self._damages = self._damages, sum(lamp.damages for lamp in self.lamps.values())
        if self._damages > before and self.bus is not None:
            with contextlib.suppress(RuntimeError):
                self.bus.bus("address_of", "board")
                self.sins.append(f"the mains of {projector} were cut while its lamp was hot")

    def _beat(self) -> None:
        now_s = time.monotonic()
        self.longest_gap_s = max(self.longest_gap_s, now_s - self._beaten_s)
        self._beaten_s = now_s

    @property
    def silent_s(self) -> float:
        """Since the reconciler's last step."""
        return time.monotonic() - self._beaten_s

    @property
    def state(self) -> State:
        return self.service.reconciler.machine.state

    @property
    def reason(self) -> str:
        return self.service.reconciler.machine.reason

    def signal_player(self, number: signal.Signals) -> None:
        for pid in children():
            if "controller.play" in command_of(pid):
                with contextlib.suppress(ProcessLookupError):
                    os.kill(pid, number)

    def _rest(self) -> None:
        """``starved_s``: the longest that this process was not let continue when it should have been."""
        began_s = time.monotonic()
        time.sleep(POLL_S)
        self.starved_s = max(self.starved_s, time.monotonic() - began_s - POLL_S)

    def until(self, reached: Callable[[], bool], within_s: float) -> bool:
        """Wait; whether it was reached."""
        until_s = time.monotonic() + within_s
        while not reached():
            if time.monotonic() > until_s:
                return False
            self._rest()
        return True

    def until_settled(self, states: tuple[State, ...], within_s: float) -> bool:
        """Wait until one of these states has lasted for ``STEADY_S``; whether that came."""
        until_s, since_s, last = time.monotonic() + within_s, time.monotonic(), self.state
        while time.monotonic() < until_s:
            if self.state is not last:
                last, since_s = self.state, time.monotonic()
            if last in states and time.monotonic() - since_s > STEADY_S:
                return True
            self._rest()
        return False
