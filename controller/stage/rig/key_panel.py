"""The technician's keys: play, stop, recalibrate, and one that shows the stage's state."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from controller.core.arrays import ByteImage
from controller.core.errors import SEND_DIAGNOSTICS
from controller.core.plotting import text_size, write
from controller.run.state_machine import Event, State, allowed_events
from hal.deadline import Cancelled, Deadline, in_seconds
from hal.errors import DeviceError
from hal.interfaces import ButtonPanel

ANSWER_S: Final = 5.0
RETRY_S: Final = 2.0
"""Time between two attempts to find an unplugged panel."""

_BACKGROUND: Final = (24, 24, 24)
_POSSIBLE: Final = (240, 240, 240)
_IMPOSSIBLE: Final = (96, 96, 96)
_LIGHTS: Final[Mapping[State, tuple[int, int, int]]] = {
    State.OFF: (96, 96, 96),
    State.PLAYING: (40, 200, 80),
    State.READY: (40, 200, 80),
    State.DEGRADED: (240, 170, 30),
    State.FAULT: (230, 50, 40),
}
"""Colours of the status key; every other state is work in progress."""
_WORKING: Final = (60, 130, 240)


@dataclass(frozen=True, slots=True)
class KeyCommand:
    """A key: its text, the event that it requests, and the function to call. ``event`` None: the status key."""

    text: str
    event: Event | None
    press: Callable[[], None]


def technicians_keys(
    play: Callable[[], None], stop: Callable[[], None], recalibrate: Callable[[], None]
) -> tuple[KeyCommand, ...]:
    """The usual keys, in the order of ``hal.values.TECHNICIAN_KEYS``; the first only shows the state."""
    return (
        KeyCommand("", None, lambda: None),
        KeyCommand("PLAY", Event.PLAY, play),
        KeyCommand("STOP", Event.STOP, stop),
        KeyCommand("RECAL", Event.RECALIBRATE, recalibrate),
    )


class KeyService:
    """Shows the stage's state on a panel's keys, and calls commands for pressed keys, until it is stopped.

    ``state`` is called at each update. A command is called on the service's thread, must return soon
    and not raise; one that the state does not allow is not called. ``trouble`` is called when the panel fails (None:
    it works again); the service tries to reconnect without end.
    """

    def __init__(
        self,
        panel: ButtonPanel,
        commands: Sequence[KeyCommand],
        *,
        state: Callable[[], State],
        trouble: Callable[[DeviceError | None], None] = lambda error: None,
    ) -> None:
        self._panel, self._commands = panel, tuple(commands)
        self._state, self._trouble = state, trouble
        self._stop = threading.Event()
        self._shown: State | None = None
        self._thread = threading.Thread(target=self._run, name="keys", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def stop(self) -> None:
        """End the service; the panel stays open."""
        self._stop.set()
        self._thread.join(ANSWER_S)

    def _run(self) -> None:
        failed = False
        while not self._stop.is_set():
            try:
                self._turn()
                if failed:
                    failed = False
                    self._trouble(None)
            except Cancelled:
                return
            except Exception as error:  # noqa: BLE001 - the last boundary of this thread: reported, and it continues
                if not failed:
                    failed = True
                    self._trouble(error if isinstance(error, DeviceError) else _unknown(error))
                self._shown = None
                self._stop.wait(RETRY_S)

    def _turn(self) -> None:
        state = self._state()
        if state is not self._shown:
            self._show(state)
            self._shown = state
        key = self._panel.wait_pressed(deadline=self._deadline(0.2))
        if key is None or key >= len(self._commands):
            return
        command = self._commands[key]
        if command.event is not None and command.event in allowed_events(self._state()):
            command.press()

    def _show(self, state: State) -> None:
        size = self._panel.capabilities.picture_px
        if size is None:
            return
        for key, command in enumerate(self._commands[: self._panel.capabilities.keys]):
            picture = key_picture(command, state, size)
            self._panel.show(key, picture, deadline=self._deadline(ANSWER_S))

    def _deadline(self, seconds: float) -> Deadline:
        return in_seconds(seconds, self._stop)


def _unknown(error: Exception) -> DeviceError:
    what = f"An unexpected error occurred at the key panel ({type(error).__name__}: {error})."
    return DeviceError("crash", what=what, remedy=SEND_DIAGNOSTICS)


def key_picture(command: KeyCommand, state: State, size_px: tuple[int, int]) -> ByteImage:
    """The picture of a key in a state: (rows, columns, 3) uint8. A key without a function now is dim."""
    width, height = size_px
    picture = np.empty((height, width, 3), np.uint8)
    if command.event is None:
        picture[:] = _LIGHTS.get(state, _WORKING)
        _write(picture, state.value.upper(), (0, 0, 0))
    else:
        picture[:] = _BACKGROUND
        possible = command.event in allowed_events(state)
        _write(picture, command.text, _POSSIBLE if possible else _IMPOSSIBLE)
    return picture


def _write(picture: ByteImage, text: str, colour: tuple[int, int, int]) -> None:
    """Write ``text`` in the centre, as large as fits."""
    height, width = picture.shape[:2]
    wide, tall = text_size(text, 100)
    size_px = int(min(90 * width / max(wide, 1), 60 * height / max(tall, 1)))
    write(picture, text, ((width - text_size(text, size_px)[0]) // 2, height // 2), size_px, colour)
