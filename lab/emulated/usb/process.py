"""The emulated USB bus as a process of its own, and the handle that starts and commands it.

The bus must not live in the process that uses it: hidapi waits while it holds Python's interpreter lock. Commands and
answers are lines of JSON on the child's standard input and output: ``python -m lab.emulated.usb.process DIR``.
"""

from __future__ import annotations

import contextlib
import importlib
import json
import os
import subprocess
import sys
import threading
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import IO, Any, Final, Self

from lab.emulated.scenario import ACTIONS, LAMP_ACTIONS, Scenario, ScenarioPlayer, parse_scenario
from lab.emulated.usb.bus import UsbBus
from lab.emulated.usb.camera import STAGE_CAMERA, numbered_camera, stage_camera
from lab.emulated.usb.device import EmulatedUsbDevice
from lab.emulated.usb.hid_devices import EmulatedKeyPanel, EmulatedLightSensor, EmulatedRelayBoard

USB_ACTIONS: Final = tuple(deed for deed in ACTIONS if deed not in LAMP_ACTIONS)
"""Those of ``scenario.ACTIONS`` that can happen to a USB device."""
_FOR_GOOD: Final = 1_000_000_000
_TICK_S: Final = 0.02
_COUNTS: Final = {"busy": "stalls", "garbage": "garble", "cut": "cut", "drop": "drop", "garble": "garble"}
"""Knobs of a wire, and the counts of ``UsbFaults`` that do the same."""


class UsbScenario:
    """Plays the events of ``device`` (its name in the script is ``name``) until ``close``.

    A busy device stalls requests; "on_byte" and "on_message" count control requests with their eight bytes of
    set-up; a lamp it has not.
    """

    def __init__(
        self,
        scenario: Scenario,
        device: EmulatedUsbDevice,
        *,
        name: str,
        plug: Callable[[], None],
        unplug: Callable[[], None],
    ) -> None:
        self._device = device
        self._plug, self._unplug = plug, unplug
        self._player = ScenarioPlayer(scenario, device=name, faults=self, plug=self)
        self._lock = threading.Lock()
        self._due: list[Callable[[], None]] = []
        self._stopped = threading.Event()
        device.on_control = self._heard
        self._thread = threading.Thread(target=self._run, name=f"scenario of {name}", daemon=True)
        self._thread.start()

    @property
    def happened(self) -> list[tuple[float, str]]:
        """What happened, as (seconds since the start, deed)."""
        return self._player.happened

    def set(self, **knobs: Any) -> None:
        """Turn knobs by the names of ``faults.WireFaults``."""
        faults = self._device.faults
        for knob, value in knobs.items():
            if knob in _COUNTS:
                setattr(faults, _COUNTS[knob], _FOR_GOOD if value is True else int(value))
            elif knob == "late_s":
                # One late answer is, to who asks by control requests, one that never comes.
                faults.drop = 1
            else:
                setattr(faults, knob, value)
        if not faults.silent:
            self._later(self._device.on_ready)

    def unplug(self) -> None:
        self._later(self._unplug)

    def replug(self) -> None:
        self._later(self._plug)

    def close(self) -> None:
        self._device.on_control = lambda count: None
        self._stopped.set()
        self._thread.join()

    def _later(self, deed: Callable[[], None]) -> None:
        # Not here: a program's call may be running, under the device's lock.
        self._due.append(deed)

    def _heard(self, count: int) -> None:
        with self._lock:
            self._player.heard(count)

    def _run(self) -> None:
        while not self._stopped.wait(_TICK_S):
            with self._lock:
                self._player.tick()
                due, self._due = self._due, []
            for deed in due:
                deed()


KINDS: Final[Mapping[str, Callable[..., EmulatedUsbDevice]]] = {
    "relay": EmulatedRelayBoard,
    "light": EmulatedLightSensor,
    "keys": EmulatedKeyPanel,
    "camera": numbered_camera,
    STAGE_CAMERA: stage_camera,
}
_PATIENCE_S: Final = 10.0


class UsbBusProcess:
    """Runs a bus in ``folder`` in another process; also a context. Raises RuntimeError where a command fails there."""

    def __init__(self, folder: Path) -> None:
        self._turn = threading.Lock()
        hidden = {"LD_PRELOAD", "UMOCKDEV_DIR"}
        environment = {name: value for name, value in os.environ.items() if name not in hidden}
        self._process = subprocess.Popen(  # noqa: S603 - this very module
            [sys.executable, "-m", __name__, os.fspath(folder)],
            env=environment,
            cwd=Path(__file__).parents[3],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def add(self, name: str, kind: str, **settings: Any) -> None:
        """Make a device and plug it in; ``kind``: one of ``KINDS``, or the place of a class, ``module:Class``."""
        self._request({"do": "add", "name": name, "kind": kind, "settings": settings})

    def play(self, name: str, scenario: str) -> None:
        """Play the events of a TOML scenario (see ``lab.emulated.scenario``) on a device."""
        self._request({"do": "play", "name": name, "scenario": scenario})

    def rest(self, name: str) -> None:
        """End the scenario of a device; what it has done stays done."""
        self._request({"do": "rest", "name": name})

    def happened(self, name: str) -> list[list[Any]]:
        """What a scenario has done so far: [seconds, deed] each."""
        happened: list[list[Any]] = self._request({"do": "happened", "name": name})
        return happened

    def plug(self, name: str) -> None:
        self._request({"do": "plug", "name": name})

    def unplug(self, name: str) -> None:
        self._request({"do": "unplug", "name": name})

    def forget(self, name: str) -> None:
        """Unplug a device for good."""
        self._request({"do": "forget", "name": name})

    def clear(self) -> None:
        """Unplug every device for good."""
        self._request({"do": "clear", "name": ""})

    def set(self, name: str, knob: str, value: Any) -> None:
        """Turn a knob, e.g. ``faults.silent`` or ``lux``."""
        self._request({"do": "set", "name": name, "knob": knob, "value": value})

    def get(self, name: str, knob: str) -> Any:
        return self._request({"do": "get", "name": name, "knob": knob})

    def call(self, name: str, method: str, *arguments: Any) -> Any:
        return self._request({"do": "call", "name": name, "method": method, "arguments": arguments})

    def bus(self, question: str, name: str) -> Any:
        """``address_of`` or ``driver_bound``."""
        return self._request({"do": "bus", "name": name, "question": question})

    def close(self) -> None:
        if self._process.stdin is not None:
            self._process.stdin.close()
        try:
            self._process.wait(_PATIENCE_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        if self._process.stdout is not None:
            self._process.stdout.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _request(self, command: Mapping[str, Any]) -> Any:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        try:
            with self._turn:
                self._process.stdin.write(json.dumps(command) + "\n")
                self._process.stdin.flush()
                line = self._process.stdout.readline()
        except BrokenPipeError:
            line = ""
        if not line:
            raise RuntimeError("the process with the emulated USB bus has ended")
        answer = json.loads(line)
        if "error" in answer:
            raise RuntimeError(answer["error"])
        return answer["value"]


class _Commands:
    """What the child does with each line."""

    def __init__(self, bus: UsbBus) -> None:
        self._bus = bus
        self._devices: dict[str, EmulatedUsbDevice] = {}
        self._scenarios: dict[str, UsbScenario] = {}

    def close(self) -> None:
        for scenario in self._scenarios.values():
            scenario.close()

    def obey(self, command: Mapping[str, Any]) -> Any:
        name = command["name"]
        if command["do"] == "clear":
            self._clear()
        elif command["do"] == "add":
            self._devices[name] = _kind(command["kind"])(**command["settings"])
            self._bus.plug(self._devices[name])
        else:
            return self._obey(command, name, self._devices[name])
        return None

    def _obey(self, command: Mapping[str, Any], name: str, device: EmulatedUsbDevice) -> Any:
        match command["do"]:
            case "play":
                self._play(name, device, command["scenario"])
            case "rest":
                self._rest(name)
            case "happened":
                return self._scenarios[name].happened
            case "plug":
                self._bus.plug(device)
            case "unplug":
                self._bus.unplug(device)
            case "forget":
                self._bus.unplug(self._devices.pop(name))
            case "set":
                holder, knob = _find(device, command["knob"])
                is_set = isinstance(getattr(holder, knob), frozenset)
                setattr(holder, knob, frozenset(command["value"]) if is_set else command["value"])
                device.on_ready()  # what a fault has held back may continue
            case "get":
                holder, knob = _find(device, command["knob"])
                return getattr(holder, knob)
            case "call":
                return getattr(device, command["method"])(*command["arguments"])
            case "bus":
                return getattr(self._bus, command["question"])(device)
            case unknown:
                raise ValueError(f"no command {unknown}")
        return None

    def _clear(self) -> None:
        self.close()
        self._scenarios.clear()
        for device in self._devices.values():
            self._bus.unplug(device)
        self._devices.clear()

    def _rest(self, name: str) -> None:
        if name in self._scenarios:
            self._scenarios.pop(name).close()

    def _play(self, name: str, device: EmulatedUsbDevice, text: str) -> None:
        self._rest(name)
        self._scenarios[name] = UsbScenario(
            parse_scenario(text, file=name),
            device,
            name=name,
            plug=lambda: self._bus.plug(device),
            unplug=lambda: self._bus.unplug(device),
        )


def _kind(name: str) -> Callable[..., EmulatedUsbDevice]:
    module, separator, attribute = name.partition(":")
    if not separator:
        return KINDS[name]
    factory: Callable[..., EmulatedUsbDevice] = getattr(importlib.import_module(module), attribute)
    return factory


def _find(device: EmulatedUsbDevice, dotted: str) -> tuple[Any, str]:
    """The object that has the last name of ``dotted``, and that name. Raises AttributeError."""
    *path, last = dotted.split(".")
    holder: Any = device
    for part in path:
        holder = getattr(holder, part)
    getattr(holder, last)
    return holder, last


def serve(folder: Path, commands: IO[str], answers: IO[str]) -> None:
    """Serve a bus until ``commands`` ends."""
    with UsbBus(folder) as bus, contextlib.closing(_Commands(bus)) as table:
        for line in commands:
            try:
                answer = {"value": table.obey(json.loads(line))}
            except Exception as error:  # noqa: BLE001 - any error goes to the program that gave the command
                answer = {"error": f"{type(error).__name__}: {error}"}
            answers.write(json.dumps(answer, default=sorted) + "\n")  # JSON has no sets
            answers.flush()


if __name__ == "__main__":
    serve(Path(sys.argv[1]), sys.stdin, sys.stdout)
