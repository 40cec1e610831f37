"""Faults by a script on the emulated USB bus: the events of ``scenario``, played on a device's USB faults."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any, Final

from plugins.emulated import scenario as scripts
from plugins.emulated.scenario import Scenario, ScenarioPlayer
from plugins.emulated.usb.device import EmulatedUsbDevice

USB_ACTIONS: Final = tuple(deed for deed in scripts.ACTIONS if deed not in scripts.LAMP_ACTIONS)
"""Those of ``scenario.DEEDS`` that can happen to a USB device."""
_FOR_GOOD: Final = 1_000_000_000
_TICK_S: Final = 0.02
_COUNTS: Final = {"busy": "stalls", "garbage": "garble", "cut": "cut", "drop": "drop", "garble": "garble"}
"""Knobs of a wire, and the counts of ``UsbFaults`` that do the same."""


class UsbScenario:
    """Plays the events of ``device`` (its name in the script is ``name``) until ``close``.

    A busy device stalls what it is asked; "on_byte" and "on_message" count control requests with their eight bytes of
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
