"""Players that follow one clock: each shows by itself what is due, from the moment that was agreed on."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import ExitStack
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from controller.bundle.format import PlaylistEntry
from controller.play.control.launch import PlayerSettings, start_player
from controller.play.playlist import Playlist, Timetable
from tests.controller.play.conftest import OUTPUTS, START, write_noise
from tests.controller.play.wire import Frames, Wire, dark, noise, same
from tests.waiting import eventually

AHEAD_S = 1.7e9
"""Of the common clock before the monotonic one, as a wall clock is."""
ITEMS = [["0", 0.05], ["1", 0.1], ["2", 0.05]]


def now() -> float:
    return time.monotonic() + AHEAD_S


@pytest.fixture
def two(tmp_path: Path) -> Iterator[list[Wire]]:
    """Two players with the same bundle, in folders "0" and "1", which have the clock."""
    bundle = write_noise(tmp_path / "b.vel")
    with ExitStack() as stack:
        wires = []
        for name in "01":
            folder = tmp_path / name
            folder.mkdir()
            settings = PlayerSettings(OUTPUTS, folder / "out.frame", bundle, allow_unsigned=True, rate_hz=100)
            stack.enter_context(start_player(folder, settings))
            wires.append(stack.enter_context(Wire(folder / "player.sock")))
            assert wires[-1].ask("clock", ahead_s=AHEAD_S)["ok"]
        yield wires


def reports(wire: Wire, after: int = 0) -> dict[float, str]:
    """What was presented, by the moment at which it was due; not before that."""
    rows: list[list[Any]] = wire.ask("reports", after=after)["reports"]
    assert all(at_s > due_s - 0.001 for _, due_s, at_s, _ in rows)
    return {round(due_s, 3): appearance for _, due_s, _, appearance in rows}


def test_two_players_show_the_same_at_the_same_deadlines_and_one_that_comes_later_joins_in(two: list[Wire]) -> None:
    at = now() + 0.2
    assert two[0].ask("sequence", items=ITEMS, repeat=0, at=at)["ok"]
    time.sleep(0.3)  # the first has shown more than one picture
    assert two[1].ask("sequence", items=ITEMS, repeat=0, at=at)["ok"]
    eventually(lambda: len(reports(two[1])) > 8)
    late, first = reports(two[1]), reports(two[0])
    begin = min(first)
    joined = min(late)
    assert first[begin] == "0"
    assert begin == pytest.approx(at, abs=0.011)
    assert joined > begin
    for due_s, appearance in late.items():
        in_round = round(due_s - begin, 2) % 0.2
        assert appearance == ("0" if in_round < 0.049 or in_round > 0.199 else "1" if in_round < 0.149 else "2")
        assert first.get(due_s, appearance) == appearance


def test_what_plays_goes_on_until_the_moment_that_was_agreed_on_and_no_picture_is_left_out(two: list[Wire]) -> None:
    wire = two[0]
    begin = now() + 0.3
    assert wire.ask("sequence", items=[["0", 0.15], ["1", 0.15]], at=begin)["ok"]
    change = begin + 0.8
    assert wire.ask("play", appearance="5", at=change)["ok"]
    shown = reports(wire)
    dues = sorted(shown)
    assert shown[dues[-1]] == "5"
    assert dues[-1] == pytest.approx(change, abs=0.011)
    assert [round(b - a, 3) for a, b in pairwise(dues[:-1])] == [0.15] * (len(dues) - 2)
    assert len(dues) == 7
    assert wire.ask("status")["appearance"] == "5"


def test_another_bundle_takes_over_at_its_moment(two: list[Wire], tmp_path: Path) -> None:
    other = write_noise(tmp_path / "other.vel", schedule=[PlaylistEntry("3", 1000, 0)])
    before = two[0].ask("hello")["bundle"]
    assert two[0].ask("sequence", items=[["0", 0.02], ["1", 0.02]], at=now())["ok"]
    moment = now() + 0.4
    two[0].send(b'{"id": 1, "op": "play", "appearance": "3", "at": %f, "bundle": "%s"}\n' % (moment, bytes(other)))
    with Wire(tmp_path / "0" / "player.sock") as second:
        assert second.ask("status")["bundle"] == before
        assert two[0].receive()["ok"]
        assert second.ask("status")["bundle"] != before
        assert second.ask("status")["appearance"] == "3"
    assert same(Frames(tmp_path / "0" / "out.frame").read(), noise(OUTPUTS, 3))


def test_a_clock_that_is_set_moves_the_deadlines_and_the_show_goes_on(two: list[Wire]) -> None:
    wire = two[0]
    assert wire.ask("sequence", items=ITEMS, at=now())["ok"]
    eventually(lambda: len(reports(wire)) > 3)
    count = wire.ask("status")["reported"]
    assert wire.ask("clock", ahead_s=AHEAD_S + 5)["ok"]
    eventually(lambda: len(wire.ask("reports", after=count + 1)["reports"]) > 3)
    assert all(due_s > now() + 4 for due_s in reports(wire, count + 1))
    assert wire.ask("status")["sequence_running"]


@pytest.mark.parametrize("then", ["black", "still", "on"])
def test_a_player_that_nobody_tells_the_clock_goes_on_by_its_rule(then: str, two: list[Wire], tmp_path: Path) -> None:
    wire = two[0]
    assert wire.ask("clock", ahead_s=AHEAD_S, keep_s=0.25, then=then)["ok"]
    assert wire.ask("sequence", items=ITEMS, at=now())["ok"]
    assert not wire.ask("status")["alone"]
    eventually(lambda: wire.ask("status")["alone"])
    at = wire.ask("status")
    assert at["sequence_running"] == (then == "on")
    if then == "black":
        eventually(lambda: wire.ask("status")["showing"] == "black")
    assert dark(Frames(tmp_path / "0" / "out.frame").read()) == (then == "black")
    assert wire.ask("clock", ahead_s=AHEAD_S, keep_s=5, then=then)["ok"]
    assert not wire.ask("status")["alone"]


def test_a_player_that_starts_again_joins_in_once_it_is_told_the_clock(start: START, tmp_path: Path) -> None:
    settings = {"bundle": write_noise(tmp_path / "b.vel"), "allow_unsigned": True, "resume": True}
    player = start(**settings)
    with Wire(player.socket) as wire:
        refused = wire.ask("play", appearance="1", at=now())
        assert refused["error"]["code"] == "clock-unknown"
        assert wire.ask("clock", ahead_s=AHEAD_S)["ok"]
        assert wire.ask("sequence", items=[["0", 0.1], ["4", 600.0]], at=now() - 5)["ok"]
        assert wire.ask("status")["appearance"] == "4"
    player.kill()
    player.restart()
    with Wire(player.socket) as wire:
        assert wire.ask("status")["showing"] == "black"
        assert wire.ask("clock", ahead_s=AHEAD_S)["ok"]
        eventually(lambda: wire.ask("status")["appearance"] == "4")


def test_patterns_and_black_come_at_their_moments(two: list[Wire], tmp_path: Path) -> None:
    pictures = noise(OUTPUTS, 9)
    for number, wire in enumerate(two):
        sequence = Frames(tmp_path / str(number) / "player.sock.inbox").write(pictures)
        wire.send(b'{"id": 1, "op": "show", "sequence": %d, "at": %f}\n' % (sequence, at := now() + 0.2))
    answers = [wire.receive() for wire in two]
    assert all(answer["presented_at"] + AHEAD_S > at - 0.05 for answer in answers)
    assert same(Frames(tmp_path / "1" / "out.frame").read(), pictures)
    assert two[0].ask("stop", at=now() + 0.05)["ok"]
    assert dark(Frames(tmp_path / "0" / "out.frame").read())


@given(
    lengths=st.lists(st.integers(1, 5), min_size=1, max_size=4),
    first=st.integers(-5, 5),
    rounds=st.sampled_from([None, 1, 3]),
)
def test_a_timetable_is_what_counting_gives(lengths: list[int], first: int, rounds: int | None) -> None:
    table = Timetable(first, lengths, rounds)
    counted = [
        number for number, length in enumerate(lengths * (rounds or 5)) for _ in range(length)
    ]  # of each tick from the first on
    assert [table.number_at(first + tick) for tick in range(len(counted))] == counted
    assert [first + counted.index(number) for number in sorted(set(counted))] == [
        table.start(number) for number in sorted(set(counted))
    ]
    assert table.number_at(first - 1) == 0
    if rounds is not None:
        assert table.number_at(first + len(counted) + 7) == counted[-1]


def test_a_playlist_that_is_looked_up_comes_in_as_it_says_but_for_the_first_time() -> None:
    playlist = Playlist([("a", 1.0, 0.5), ("b", 1.0, 0.5)], 0, first_fade_s=3.0)
    assert playlist.fade_s == 3.0
    playlist.seek(5)
    assert (playlist.appearance, playlist.fade_s) == ("b", 0.5)
