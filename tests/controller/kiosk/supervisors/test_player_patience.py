"""A player whose answers are lost is ended a few times only; one that hangs is ended each time."""

from __future__ import annotations

import json
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any, cast

from controller.kiosk.decide.interfaces import BLACK, Showing
from controller.kiosk.supervisors.player_supervisor import PlayerSupervisor
from controller.play.control.launch import PlayerSettings
from hal.notices import Notice
from hal.player import PlayerClient

MARBLE = Showing(Path("b.vel"), "marble")
STEP_S = 0.25


class Computer:
    """Players in virtual time. ``loses``: of the n-th question of a process whether its answer is lost."""

    def __init__(self, loses: Callable[[int], bool]) -> None:
        self.loses, self.now_s = loses, 0.0
        self.told: list[Notice] = []
        self.ended_s: list[float] = []
        self.process = Player(self)
        self.supervisor = PlayerSupervisor(
            Path(), lambda _: PlayerSettings([("P1", 8, 8)], Path("f")), self.told.append,
            monotonic=lambda: self.now_s, launch=lambda *_: cast("Any", self._launched()),
            channel=PlayerClient(lambda *_: cast("Any", self.process), self),
        )  # fmt: skip
        self.supervisor.want = BLACK

    def monotonic(self) -> float:
        return self.now_s

    def sleep(self, seconds: float, /) -> None:
        self.now_s += seconds

    def _launched(self) -> Player:
        self.process = Player(self)
        return self.process

    def run(self, for_s: float) -> None:
        until_s = self.now_s + for_s
        while self.now_s < until_s:
            self.supervisor.step()
            self.now_s += STEP_S

    def hang(self) -> float:
        """The player answers nothing any more; after how many seconds it is ended."""
        loses, began_s, before = self.loses, self.now_s, len(self.ended_s)
        self.loses = lambda _: True
        while len(self.ended_s) == before:
            self.run(STEP_S)
        self.loses = loses
        return self.ended_s[-1] - began_s


class Player:
    """A process and its socket."""

    socket, pid = Path("player.sock"), 1

    def __init__(self, computer: Computer) -> None:
        self._computer, self._questions, self._timeout_s = computer, 0, 0.0
        self.alive, self.showing, self._answers = True, "black", b""

    def wait_until_ready(self, timeout_s: float) -> dict[str, Any]:
        self._computer.now_s += 0.5
        return {"bundle": None}

    def kill(self) -> None:
        self.alive = False
        self._computer.ended_s.append(self._computer.now_s)

    def terminate(self) -> int:
        self.alive = False
        return 0

    def settimeout(self, seconds: float) -> None:
        self._timeout_s = seconds

    def close(self) -> None:
        self._answers = b""

    def sendall(self, data: bytes) -> None:
        request = json.loads(data)
        if request["op"] in ("play", "stop"):
            self.showing = "appearance" if request["op"] == "play" else "black"
        self._questions += 1
        if not self._computer.loses(self._questions):
            answer = {
                "id": request["id"], "ok": True, "bundle": "b", "showing": self.showing, "appearance": "marble",
                "brightness": 1.0, "sequence_running": False, "skipped": 0,
            }  # fmt: skip
            self._answers += json.dumps(answer).encode() + b"\n"

    def recv(self, _: int) -> bytes:
        if not self._answers:
            self._computer.now_s += self._timeout_s
            raise TimeoutError
        answers, self._answers = self._answers, b""
        return answers


def test_a_player_that_loses_two_answers_of_three_is_not_ended_again_and_again() -> None:
    computer = Computer(lambda question: question > 4 and question % 3 != 1)
    computer.supervisor.want = MARBLE
    computer.run(600.0)
    # Once in each five minutes, and perhaps once more where these begin.
    assert 1 <= len(computer.ended_s) <= 3
    assert [one.code for one in computer.told].count("player-hung") == len(computer.ended_s)
    assert computer.process.showing == "appearance"


def test_a_player_that_hangs_again_and_again_is_ended_each_time_and_has_at_most_twenty_seconds() -> None:
    computer = Computer(lambda question: question > 40)
    computer.supervisor.want = MARBLE
    computer.run(900.0)
    assert len(computer.ended_s) > 15
    pauses_s = [after - before for before, after in pairwise(computer.ended_s)]
    assert max(pauses_s) < 40 * STEP_S + 20.0


def test_a_player_that_hangs_with_a_picture_is_ended_soon_when_the_stage_closes() -> None:
    computer = Computer(lambda _: False)
    computer.supervisor.want = MARBLE
    for _ in range(4):
        computer.run(10.0)
        computer.hang()
    computer.run(10.0)
    assert computer.process.showing == "appearance"
    computer.supervisor.want = BLACK
    assert computer.hang() < 3.0


def test_after_five_quiet_minutes_a_silent_player_is_ended_as_soon_as_at_first() -> None:
    computer = Computer(lambda _: False)
    took_s = []
    for pause_s in (10.0, 30.0, 30.0, 30.0, 310.0):
        computer.run(pause_s)
        took_s.append(computer.hang())
    assert took_s[0] < 3.0
    assert took_s[1] > 1.5 * took_s[0]
    assert 10.0 < took_s[3] < 20.0
    assert took_s[4] < 3.0
