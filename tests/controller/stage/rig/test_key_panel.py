"""The technician's keys: what they show, what they call, and what they do not."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable

import numpy as np
import numpy.typing as npt
import pytest

from controller.run.state_machine import State
from controller.stage.rig import key_panel as keys
from controller.stage.rig.key_panel import KeyService, key_picture, technicians_keys
from hal.deadline import Deadline
from hal.errors import DeviceError, DeviceGone
from hal.values import DeviceIdentity, PanelCapabilities
from tests.waiting import wait_for


class Panel:
    """Fifteen keys without a cable."""

    def __init__(self) -> None:
        self.capabilities = PanelCapabilities(15, (72, 72))
        self.pressed: queue.Queue[int] = queue.Queue()
        self.shown: dict[int, npt.NDArray[np.uint8]] = {}
        self.gone = False

    def identity(self, *, deadline: Deadline) -> DeviceIdentity:
        return DeviceIdentity("Model", "Panel")

    def close(self) -> None:
        """Nothing to release."""

    def show(self, key: int, picture: npt.NDArray[np.uint8], *, deadline: Deadline) -> None:
        self.check()
        self.shown[key] = picture

    def wait_pressed(self, *, deadline: Deadline) -> int | None:
        self.check()
        deadline.sleep(0.0)
        try:
            return self.pressed.get(timeout=0.02)
        except queue.Empty:
            return None

    def check(self) -> None:
        if self.gone:
            raise DeviceGone("hid-unplugged", what="No panel.", remedy="Plug it in.")


class Desk:
    """A running service, and what it called."""

    def __init__(self, state: State) -> None:
        self.panel, self.state = Panel(), state
        self.called: list[str] = []
        self.troubles: list[DeviceError | None] = []
        commands = technicians_keys(*(self.command(name) for name in ("play", "stop", "recalibrate")))
        self.service = KeyService(self.panel, commands, state=lambda: self.state, trouble=self.troubles.append)

    def command(self, name: str) -> Callable[[], None]:
        return lambda: self.called.append(name)

    def __enter__(self) -> Desk:
        self.service.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.service.stop()


def test_keys_call_what_the_state_allows_and_nothing_else() -> None:
    with Desk(State.READY) as desk:
        for key in (0, 1, 3, 2, 14):
            desk.panel.pressed.put(key)
        wait_for(lambda: len(desk.called) == 3)
        assert desk.called == ["play", "recalibrate", "stop"]
        desk.state = State.CALIBRATING
        for key in (1, 3, 2):
            desk.panel.pressed.put(key)
        wait_for(lambda: len(desk.called) == 4)
        wait_for(desk.panel.pressed.empty)
        assert desk.called[3:] == ["stop"]


def test_pictures_follow_the_state() -> None:
    with Desk(State.OFF) as desk:
        wait_for(lambda: len(desk.panel.shown) == 4)
        off = desk.panel.shown[0].copy()
        desk.state = State.FAULT
        wait_for(lambda: not np.array_equal(desk.panel.shown[0], off))
        assert desk.panel.shown[0][2, 2].tolist() == [230, 50, 40]


def test_every_state_looks_unlike_another_and_dim_keys_are_those_that_do_nothing() -> None:
    status, play, *_ = technicians_keys(lambda: None, lambda: None, lambda: None)
    pictures = {key_picture(status, state, (72, 72)).tobytes() for state in State}
    assert len(pictures) == len(State)
    assert key_picture(play, State.READY, (72, 72)).max() > 200
    assert key_picture(play, State.OFF, (72, 72)).max() < 120
    low = (key_picture(play, State.READY, (400, 40)) > 150).any(axis=(1, 2))
    assert 12 <= np.count_nonzero(low) <= 20, "capital letters in 60 % of the height"


def test_an_unplugged_panel_is_told_once_and_used_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(keys, "RETRY_S", 0.1)
    with Desk(State.READY) as desk:
        wait_for(lambda: len(desk.panel.shown) == 4)
        desk.panel.gone = True
        wait_for(lambda: desk.troubles)
        desk.panel.shown.clear()
        desk.panel.gone = False
        wait_for(lambda: len(desk.troubles) == 2)
        assert desk.troubles[1] is None
        assert len(desk.panel.shown) == 4
        desk.panel.pressed.put(1)
        wait_for(lambda: desk.called)


def test_an_unknown_error_of_a_panel_is_told_and_its_keys_work_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(keys, "RETRY_S", 0.01)
    desk, errors = Desk(State.READY), [ValueError("a driver's own")]

    def check() -> None:
        if errors:
            raise errors.pop()

    monkeypatch.setattr(desk.panel, "check", check)
    with desk:
        desk.panel.pressed.put(1)
        wait_for(lambda: desk.called)
    told, well = desk.troubles
    assert told is not None
    assert (told.code, well) == ("crash", None)
    assert "ValueError" in told.what


def test_stopping_ends_the_thread_at_once() -> None:
    with Desk(State.READY):
        pass
    assert not [thread for thread in threading.enumerate() if thread.name == "keys"]
