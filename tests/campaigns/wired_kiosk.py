"""A kiosk's service on real drivers: pseudo terminals, TCP, a player process; every device an emulator with knobs."""

from __future__ import annotations

import contextlib
import os
import signal
import threading
import time
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Final, Self

from benchmarks.serve import install_grey
from controller.serve.service import Service, serving
from controller.session.machine import State
from plugins.emulated.lamp import LampTiming
from plugins.emulated.ptp_body import CameraNames
from plugins.emulated.ptp_camera import EmulatedPtpCamera
from plugins.emulated.serial_projector import EmulatedSerialProjector
from plugins.emulated.truth import read_truth
from tests.campaigns.kills import children
from tests.campaigns.mini_stage import HonestLamp, SteadyWorld, prepare_mini

POLL_S: Final = 0.02
STEADY_S: Final = 3.0
"""A state that has lasted so long is settled."""


def prepare_wired(out: Path) -> Path:
    """A stage with a bundle to play and its rays cast, to be copied for as many kiosks as there shall be."""
    stage = prepare_mini(out)
    install_grey(stage)
    truth = read_truth(stage)
    with SteadyWorld(stage, truth, [HonestLamp(LampTiming(1.0, 1.0)) for _ in truth.projectors]):
        return stage


class WiredKiosk:
    """One kiosk. Knobs: ``projectors`` and ``lamps`` by name, ``camera``, and the player's process."""

    def __init__(self, stage: Path) -> None:
        self.stage = stage
        truth = read_truth(stage)
        self.sins: list[str] = []
        self.lamps = {
            one.name: HonestLamp(LampTiming(one.lamp.warm_up_s, one.lamp.cool_down_s)) for one in truth.projectors
        }
        for name, lamp in self.lamps.items():
            lamp.told = lambda sin, name=name: self.sins.append(f"{name} {sin}")  # type: ignore[misc]
        self._world = SteadyWorld(stage, truth, list(self.lamps.values()))
        self.projectors = {
            one.name: EmulatedSerialProjector(stage / one.port, self.lamps[one.name]) for one in truth.projectors
        }
        self.camera = EmulatedPtpCamera(
            self._world.expose, command_port=truth.camera.command_port, event_port=truth.camera.event_port,
            names=CameraNames(serial=truth.camera.serial_number), time_scale=0.0, raw=truth.camera.raw,
        )  # fmt: skip
        self._stack = contextlib.ExitStack()
        self._beaten_s, self.longest_gap_s = time.monotonic(), 0.0
        self.service: Service

    def __enter__(self) -> Self:
        with contextlib.ExitStack() as stack:
            stack.enter_context(self._world)
            for projector in self.projectors.values():
                stack.enter_context(projector)
            stack.enter_context(self.camera)
            self.service = stack.enter_context(serving(self.stage, threading.Event()))
            self.service.changed = self._beat
            self._stack = stack.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.close()

    def _beat(self) -> None:
        now_s = time.monotonic()
        self.longest_gap_s = max(self.longest_gap_s, now_s - self._beaten_s)
        self._beaten_s = now_s

    @property
    def silent_s(self) -> float:
        """Since the conductor's last step."""
        return time.monotonic() - self._beaten_s

    @property
    def state(self) -> State:
        return self.service.conductor.machine.state

    @property
    def reason(self) -> str:
        return self.service.conductor.machine.reason

    def signal_player(self, number: signal.Signals) -> None:
        for pid in children(os.getpid()):
            with contextlib.suppress(OSError):
                if b"controller.play" in Path(f"/proc/{pid}/cmdline").read_bytes():
                    os.kill(pid, number)

    def until(self, reached: Callable[[], bool], within_s: float) -> bool:
        """Wait; whether it was reached."""
        until_s = time.monotonic() + within_s
        while not reached():
            if time.monotonic() > until_s:
                return False
            time.sleep(POLL_S)
        return True

    def until_settled(self, states: tuple[State, ...], within_s: float) -> bool:
        """Wait until one of these states has lasted for ``STEADY_S``; whether that came."""
        until_s, since_s, last = time.monotonic() + within_s, time.monotonic(), self.state
        while time.monotonic() < until_s:
            if self.state is not last:
                last, since_s = self.state, time.monotonic()
            if last in states and time.monotonic() - since_s > STEADY_S:
                return True
            time.sleep(POLL_S)
        return False
