from __future__ import annotations

import contextlib
import queue
import time
from collections.abc import Callable, Iterator

import numpy as np
import numpy.typing as npt
import pytest

from controller.kiosk.supervisors.keys_supervisor import KeysSupervisor
from controller.run.state_machine import State
from controller.stage.rig.key_panel import KeyService
from hal.deadline import Deadline
from hal.errors import DeviceGone
from hal.notices import Notice
from hal.values import DeviceIdentity, PanelCapabilities


class Panel:
    """Keys without pictures; ``there``: whether it is plugged in."""

    capabilities = PanelCapabilities(4)

    def __init__(self) -> None:
        self.there = True
        self.closed = 0
        self.pressed = queue.SimpleQueue[int]()

    def identity(self, *, deadline: Deadline) -> DeviceIdentity:
        return DeviceIdentity("Model", "Panel")

    def show(self, key: int, picture: npt.NDArray[np.uint8], *, deadline: Deadline) -> None:
        raise AssertionError("it has no pictures")

    def wait_pressed(self, *, deadline: Deadline) -> int | None:
        self.look()
        with contextlib.suppress(queue.Empty):
            return self.pressed.get(timeout=0.01)
        deadline.sleep(0.0)
        return None

    def look(self) -> None:
        if not self.there:
            raise DeviceGone("hid-unplugged", what="No key panel is plugged in.", remedy="Check its cable.")

    def close(self) -> None:
        self.closed += 1


class Kept:
    def __init__(self) -> None:
        self.panel, self.told, self.done = Panel(), list[Notice](), queue.SimpleQueue[str]()
        self.meanwhile: Callable[[], None] = lambda: None
        presses = tuple(self._press(name) for name in ("play", "stop", "recalibrate"))
        self.supervisor = KeysSupervisor("model", self._opened, presses, lambda: State.PLAYING, self.told.append)  # type: ignore[arg-type]

    def _press(self, name: str) -> Callable[[], None]:
        return lambda: self.done.put(name)

    @contextlib.contextmanager
    def _opened(self) -> Iterator[Panel]:
        self.meanwhile()
        self.panel.look()
        with contextlib.closing(self.panel):
            yield self.panel

    @property
    def codes(self) -> list[str]:
        return [decision.code for decision in self.told]

    def until(self, true: Callable[[], bool]) -> bool:
        ends_s = time.monotonic() + 30.0
        while not true() and time.monotonic() < ends_s:
            time.sleep(0.01)
        return true()


@pytest.fixture
def kept() -> Iterator[Kept]:
    made = Kept()
    yield made
    made.supervisor.close()


def test_a_panel_that_is_missing_at_the_start_is_told_of_once_and_is_used_when_it_comes(kept: Kept) -> None:
    kept.panel.there = False
    for _ in range(3):
        kept.supervisor.step()
    assert kept.codes == ["hid-unplugged"]
    assert (kept.supervisor.row.problem, kept.supervisor.row.remedy) == (
        "No key panel is plugged in.",
        "Check its cable.",
    )
    kept.panel.there = True
    kept.supervisor.step()
    assert kept.codes == ["hid-unplugged", "keys-back"]
    assert kept.supervisor.row.problem is None
    kept.panel.pressed.put(2)
    assert kept.done.get(timeout=30) == "stop"


def test_a_panel_that_leaves_is_shown_as_away_until_it_is_back(kept: Kept) -> None:
    kept.supervisor.step()
    kept.panel.there = False
    assert kept.until(lambda: kept.supervisor.row.problem is not None)
    kept.panel.there = True
    assert kept.until(lambda: kept.supervisor.row.problem is None)
    assert kept.codes == ["hid-unplugged", "keys-back"]


def test_closing_closes_the_panel_and_one_that_never_came_needs_none(kept: Kept) -> None:
    kept.supervisor.close()
    assert kept.panel.closed == 0
    kept.supervisor.step()
    kept.supervisor.close()
    assert kept.panel.closed == 1


def test_a_panel_that_opens_after_its_keeper_was_closed_is_let_go_of(kept: Kept) -> None:
    kept.meanwhile = kept.supervisor.close
    kept.supervisor.step()
    assert kept.panel.closed == 1


def test_a_panel_that_leaves_at_once_is_shown_as_away(kept: Kept, monkeypatch: pytest.MonkeyPatch) -> None:
    begin = KeyService.start

    def start(service: KeyService) -> None:
        kept.panel.there = False
        begin(service)
        assert kept.until(lambda: "hid-unplugged" in kept.codes)

    monkeypatch.setattr(KeyService, "start", start)
    kept.supervisor.step()
    assert kept.supervisor.row.problem == "No key panel is plugged in."
