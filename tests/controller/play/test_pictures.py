"""Patterns and appearances of a player process, seen through its socket and its memory output only."""

from __future__ import annotations

import stat
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from controller.play.control.launch import PlayerProcess
from tests.controller.play.wire import Frames, Wire, dark, noise, same

Outputs = list[tuple[str, int, int]]
Start = Callable[..., PlayerProcess]


def test_it_says_who_it_is_and_begins_black(wire: Wire, outputs: Outputs, folder: Path) -> None:
    hello = wire.ask("hello")
    assert hello["ok"] is True
    assert hello["protocol"] == 1
    assert [(o["name"], o["width_px"], o["height_px"]) for o in hello["outputs"]] == outputs
    assert dark(Frames(folder / "out.frame").read())
    for path in (folder / "player.sock", Path(hello["inbox"]), folder / "out.frame"):
        assert stat.S_IMODE(path.stat().st_mode) == 0o600


def test_a_pattern_appears_byte_for_byte_and_the_answer_comes_after_it(
    wire: Wire, outputs: Outputs, folder: Path
) -> None:
    shown, inbox = Frames(folder / "out.frame"), Frames(Path(wire.ask("hello")["inbox"]))
    last = 0.0
    for seed in range(100, 105):
        pattern = noise(outputs, seed)
        asked = time.monotonic()
        answer = wire.ask("show", sequence=inbox.write(pattern))
        assert same(shown.read(), pattern)
        assert asked <= answer["presented_at"] <= time.monotonic()
        assert shown.presented_at == answer["presented_at"] > last
        last = answer["presented_at"]
    assert wire.ask("status")["showing"] == "pattern"


def test_an_appearance_appears_byte_for_byte(wire: Wire, outputs: Outputs, folder: Path) -> None:
    shown = Frames(folder / "out.frame")
    for seed in (3, 0, 5, 3):
        assert wire.ask("play", appearance=str(seed))["ok"]
        assert same(shown.read(), noise(outputs, seed))
    assert wire.ask("status")["appearance"] == "3"
    assert wire.ask("stop")["ok"]
    assert dark(shown.read())


def test_pictures_come_on_the_grid_of_the_rate(start: Start, tmp_path: Path) -> None:
    with Wire(start(rate_hz=10.0).socket) as wire:
        moments = np.array([wire.ask("stop")["presented_at"] for _ in range(5)])
    phase = (moments * 10) % 1
    assert np.median(np.minimum(phase, 1 - phase)) < 0.2


def test_swaps_never_mix_two_appearances(wire: Wire, outputs: Outputs, folder: Path) -> None:
    shown = Frames(folder / "out.frame")
    expected = [noise(outputs, seed) for seed in range(6)]
    first = wire.ask("sequence", items=[[str(seed), 0.002] for seed in range(6)], rate_hz=500)
    seen = set()
    began = time.monotonic()
    while (passed := time.monotonic() - began) < 2 or (passed < 60 and shown.sequence < 500):
        now = shown.read()
        matches = [seed for seed in range(6) if same(now, expected[seed])]
        assert len(matches) == 1, "a set that is no appearance"
        seen |= set(matches)
    status = wire.ask("status")
    assert seen == set(range(6))
    assert status["sequence_running"]
    assert status["skipped"] == 0
    assert status["sequence"] - first["sequence"] > 200
    assert 0 < status["interval_p50_s"] <= status["interval_p99_s"]


def test_a_sequence_ends_with_its_last_item_after_its_repeats(wire: Wire, outputs: Outputs, folder: Path) -> None:
    first = wire.ask("sequence", items=[["1", 0.02], ["2", 0.05], ["1", 0.02], ["4", 0.02]], repeat=2)
    ends = time.monotonic() + 60
    while wire.ask("status")["sequence_running"] and time.monotonic() < ends:
        time.sleep(0.02)
    status = wire.ask("status")
    assert status["sequence"] - first["sequence"] == 7
    assert status["presented_at"] - first["presented_at"] > 0.15
    assert same(Frames(folder / "out.frame").read(), noise(outputs, 4))


def test_what_is_not_yet_presented_is_superseded_and_said_so(start: Start, bundle: Path) -> None:
    with Wire(start(bundle=bundle, allow_unsigned=True, rate_hz=2.0).socket) as wire:
        wire.ask("stop")
        wire.send(b'{"id": 1, "op": "play", "appearance": "1"}\n{"id": 2, "op": "play", "appearance": "2"}\n')
        answers = {answer["id"]: answer for answer in (wire.receive(), wire.receive())}
    assert answers[1]["error"]["code"] == "superseded"
    assert answers[2]["ok"] is True


def test_memory_stays_bounded_over_many_swaps(wire: Wire) -> None:
    items = [[str(seed), 0.001] for seed in range(6)]
    wire.ask("sequence", items=items, rate_hz=1000)
    time.sleep(0.5)
    before = wire.ask("status")
    time.sleep(1.0)
    after = wire.ask("status")
    assert after["swaps"] - before["swaps"] > 100
    assert after["rss_bytes"] - before["rss_bytes"] < 2 * 2**20
