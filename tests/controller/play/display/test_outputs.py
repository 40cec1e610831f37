"""Real windows on an X server with three outputs: found by name or serial number, refused, gone, back, and plain.

Needs Xorg with the dummy driver and xrandr (.ci/system-packages); a machine without them fails here.
"""

from __future__ import annotations

import os
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from controller.bundle.writer import NewAppearance, NewBundle, write_bundle
from controller.core.errors import WorkError
from controller.play.control.launch import PlayerProcess
from controller.play.display.window import unfit
from controller.play.display.x11 import Connector
from controller.play.frames import OutputSize
from hal.deadline import in_seconds
from hal.finding import SearchScope
from plugins.finding.outputs import find, parse_outputs
from tests.controller.play.conftest import write_noise
from tests.controller.play.display.xorg import CONNECTORS, HEIGHT, WIDTH, Outputs, edid, running_server
from tests.controller.play.wire import Frames, Pictures, Wire, noise

Start = Callable[..., PlayerProcess]
NAMES = ("P1", "P2", "Prój3")
SIZES = [(name, WIDTH, HEIGHT) for name in NAMES]
WHERE = dict(zip(NAMES, CONNECTORS, strict=True))
APPEARANCES = 4


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Outputs]:
    with running_server(tmp_path_factory.mktemp("xorg")) as outputs:
        yield outputs


@pytest.fixture
def outputs(server: Outputs) -> Outputs:
    server.reset()
    return server


@pytest.fixture
def play(start: Start, tmp_path: Path) -> Callable[..., PlayerProcess]:
    """Start a player with windows and a bundle of noise in the appearances "0" to "3"."""
    path = tmp_path / "windows.vel"
    made = [NewAppearance(str(seed), noise(SIZES, seed)) for seed in range(APPEARANCES)]
    write_bundle(path, NewBundle(stage="s", calibration="c", created_unix_s=0, outputs=SIZES), appearances=made)

    def started(**changes: Any) -> PlayerProcess:
        settings = {"outputs": SIZES, "frames": None, "where": WHERE, "bundle": path, "allow_unsigned": True, **changes}
        return start(**settings)

    return started


def shown(outputs: Outputs, lefts: tuple[int, ...] = (0, WIDTH, 2 * WIDTH)) -> Pictures:
    return {name: outputs.picture(left) for name, left in zip(NAMES, lefts, strict=True)}


def same(found: Pictures, expected: Pictures) -> bool:
    return all(np.array_equal(found[name], expected[name]) for name in NAMES)


def comes_true(condition: Callable[[], object]) -> bool:
    ends = time.monotonic() + 60
    while not (true := condition()) and time.monotonic() < ends:
        time.sleep(0.02)
    return bool(true)


def test_each_output_shows_its_own_picture_byte_for_byte(outputs: Outputs, play: Start) -> None:
    outputs.set_edid("DUMMY2", edid("SN-0815 b", 77))
    with Wire(play(where={"P1": "DUMMY1", "P2": "SN-0815 b", "Prój3": "DUMMY0"}).socket) as wire:
        lefts = (WIDTH, 2 * WIDTH, 0)
        inbox = Frames(Path(wire.ask("hello")["inbox"]))
        for seed in range(APPEARANCES):
            assert wire.ask("play", appearance=str(seed))["ok"]
            assert same(shown(outputs, lefts), noise(SIZES, seed))
            assert wire.ask("show", sequence=inbox.write(noise(SIZES, 50 + seed)))["ok"]
            assert same(shown(outputs, lefts), noise(SIZES, 50 + seed))
        assert wire.ask("identify")["ok"]
        pictures = list(shown(outputs, lefts).values())
        assert all(picture[0].all() and picture[:, -1].all() for picture in pictures)
        assert not np.array_equal(pictures[0], pictures[1])
        assert wire.ask("stop")["ok"]
        assert not any(picture.any() for picture in shown(outputs, lefts).values())


@pytest.mark.parametrize("serial", ["77", "OTM-77"])
def test_the_serial_number_may_be_given_as_the_projector_says_it(outputs: Outputs, play: Start, serial: str) -> None:
    outputs.set_edid("DUMMY1", edid("x", 77))
    with Wire(play(where={**WHERE, "P2": serial}).socket) as wire:
        assert wire.ask("play", appearance="1")["ok"]
    assert same(shown(outputs), noise(SIZES, 1))


def refusal(play: Start, **changes: Any) -> str:
    with pytest.raises(WorkError) as caught:
        play(**changes)
    return caught.value.what


def test_what_can_not_be_right_is_refused_with_its_reason(outputs: Outputs, play: Start) -> None:
    nowhere = dict.fromkeys(WHERE, "DP-9")
    assert "no output DP-9; it has DUMMY0, DUMMY1, DUMMY2" in refusal(play, where=nowhere)
    for number, connector in enumerate(CONNECTORS):
        outputs.place(connector, number * WIDTH, "other")
    told = refusal(play)
    assert "P1 is 120x100" in told
    assert "160x120" in told
    for number, connector in enumerate(CONNECTORS):
        outputs.place(connector, number * WIDTH)
    outputs.place("DUMMY1", WIDTH, "quick")
    assert "P1 runs at 60.150 Hz and P2 at 120.301 Hz" in refusal(play)
    for connector in ("DUMMY0", "DUMMY1"):
        outputs.set_edid(connector, edid("twin"))
    assert "DUMMY0 and DUMMY1 have the same serial number twin" in refusal(play, where={**WHERE, "P2": "twin"})


@pytest.mark.parametrize("left", [0, WIDTH // 2])
def test_outputs_that_show_one_part_of_the_screen_are_named_at_the_start_and_later(
    outputs: Outputs, play: Start, left: int
) -> None:
    outputs.place("DUMMY1", left)
    problems = [notice for found in find(SearchScope(Path()), in_seconds(20)) for notice in found.problems]
    assert "DUMMY1 shows the same part of the screen as DUMMY0" in problems[0].what
    with Wire(play().socket) as wire:
        assert wire.ask("status")["missing_outputs"] == ["P1", "P2"]
        assert wire.ask("play", appearance="3")["ok"]
        assert not outputs.picture(0).any(), "rather dark than the picture of another projector"
        assert np.array_equal(outputs.picture(2 * WIDTH), noise(SIZES, 3)["Prój3"])
        outputs.reset()
        assert comes_true(lambda: same(shown(outputs), noise(SIZES, 3)))
        assert wire.ask("status")["missing_outputs"] == []
        outputs.place("DUMMY1", left)
        assert comes_true(lambda: wire.ask("status")["missing_outputs"] == ["P1", "P2"])


def test_outputs_that_all_show_the_same_are_refused(outputs: Outputs, play: Start) -> None:
    for connector in CONNECTORS:
        outputs.place(connector, 0)
    assert "P1 shows the same part of the screen as P2, Prój3" in refusal(play)


@pytest.mark.parametrize("how", ["turned", "scaled"])
def test_an_output_that_the_server_turns_or_scales_is_named(how: str) -> None:
    """The dummy driver can do neither."""
    upright = Connector("DP-1", (), 0, 0, WIDTH, HEIGHT, 60.0, 1, 1)
    sizes, where = [OutputSize("P1", WIDTH, HEIGHT)], {"P1": "DP-1"}
    assert unfit(sizes, where, {"P1": upright}, [upright]) == {}
    changed = replace(upright, changed=how)
    error = unfit(sizes, where, {"P1": changed}, [changed])["P1"]
    assert (error.code, how in error.what, "DP-1" in error.remedy) == ("output-changed", True, True)


def test_the_doctor_names_an_output_that_is_turned_or_scaled() -> None:
    lines = [
        "DP-1 connected primary 1920x1080+0+0 (0x48) {} (normal left inverted right x axis y axis) 0mm x 0mm",
        "\tTransform:  {} 0.000000 0.000000",
        "\t            0.000000 1.000000 0.000000",
        "\t            0.000000 0.000000 1.000000",
        "\t           filter: ",
    ]

    def told(rotation: str, scale: str) -> list[str]:
        text = "\n".join(lines).format(rotation, scale)
        return [notice.what.split()[3] for one in parse_outputs(text) for notice in one.problems]

    assert told("normal", "1.000000") == []
    assert told("left", "1.000000") == ["turned"]
    assert told("normal X axis", "1.000000") == ["turned"]
    assert told("normal", "0.500000") == ["scaled"]


def test_a_gamma_ramp_that_another_program_sets_meanwhile_is_taken_away(outputs: Outputs, play: Start) -> None:
    with Wire(play().socket) as wire:
        wire.ask("play", appearance="2")
        outputs.xrandr("--output", "DUMMY2", "--gamma", "1:1:2")
        assert comes_true(lambda: gammas() == ["1.0:1.0:1.0"] * 3)


def test_an_output_that_goes_is_named_and_shows_the_picture_when_it_is_back(outputs: Outputs, play: Start) -> None:
    with Wire(play().socket) as wire:
        wire.ask("play", appearance="2")
        outputs.xrandr("--output", "DUMMY1", "--off")
        assert comes_true(lambda: wire.ask("status")["missing_outputs"] == ["P2"])
        assert wire.ask("play", appearance="3")["ok"]
        expected = noise(SIZES, 3)
        assert np.array_equal(outputs.picture(0), expected["P1"])
        assert np.array_equal(outputs.picture(2 * WIDTH), expected["Prój3"])
        outputs.place("DUMMY1", WIDTH, "other")
        time.sleep(0.3)
        assert wire.ask("status")["missing_outputs"] == ["P2"], "another size is not what was calibrated"
        outputs.place("DUMMY1", WIDTH)
        assert comes_true(lambda: same(shown(outputs), expected))
        assert wire.ask("status")["missing_outputs"] == []


def test_all_outputs_that_go_are_named_and_show_the_picture_when_they_are_back(outputs: Outputs, play: Start) -> None:
    with Wire(play().socket) as wire:
        wire.ask("play", appearance="2")
        for connector in CONNECTORS:
            outputs.xrandr("--output", connector, "--off")
        assert comes_true(lambda: wire.ask("status")["missing_outputs"] == list(NAMES))
        assert wire.ask("play", appearance="3")["ok"]
        for number, connector in enumerate(CONNECTORS):
            outputs.place(connector, number * WIDTH)
        assert comes_true(lambda: same(shown(outputs), noise(SIZES, 3)))
        assert wire.ask("status")["missing_outputs"] == []


@pytest.mark.parametrize("wrong", ["off", "another size"])
def test_an_output_that_is_missing_at_the_start_keeps_no_other_dark_and_shows_the_picture_when_it_comes(
    outputs: Outputs, play: Start, wrong: str
) -> None:
    outputs.xrandr("--output", "DUMMY1", "--off")
    if wrong == "another size":
        outputs.place("DUMMY1", WIDTH, "other")
    with Wire(play().socket) as wire:
        assert wire.ask("status")["missing_outputs"] == ["P2"]
        assert wire.ask("play", appearance="3")["ok"]
        expected = noise(SIZES, 3)
        assert np.array_equal(outputs.picture(0), expected["P1"])
        assert np.array_equal(outputs.picture(2 * WIDTH), expected["Prój3"])
        outputs.place("DUMMY1", WIDTH)
        assert comes_true(lambda: same(shown(outputs), expected))
        assert wire.ask("status")["missing_outputs"] == []


def test_outputs_that_are_all_away_at_the_start_show_their_pictures_when_they_come(
    outputs: Outputs, start: Start, tmp_path: Path
) -> None:
    """Named as their connectors, so nothing else tells them from outputs that no one gave a name."""
    sizes = [(name, WIDTH, HEIGHT) for name in CONNECTORS[1:]]
    path = write_noise(tmp_path / "named.vel", outputs=sizes)
    settings = {"outputs": sizes, "frames": None, "bundle": path, "allow_unsigned": True}
    for name, _, _ in sizes:
        outputs.xrandr("--output", name, "--off")
    with Wire(start(**settings).socket) as wire:
        assert wire.ask("play", appearance="1")["ok"]
        assert np.array_equal(outputs.picture(0), noise(sizes, 1)["DUMMY1"]), "beside each other on what there is"
        outputs.place("DUMMY2", 2 * WIDTH)
        assert comes_true(lambda: np.array_equal(outputs.picture(2 * WIDTH), noise(sizes, 1)["DUMMY2"]))
        assert wire.ask("status")["missing_outputs"] == ["DUMMY1"]
        outputs.place("DUMMY1", WIDTH)
        assert comes_true(lambda: np.array_equal(outputs.picture(WIDTH), noise(sizes, 1)["DUMMY1"]))
        assert wire.ask("status")["missing_outputs"] == []


def test_a_server_without_any_output_is_refused(outputs: Outputs, start: Start, tmp_path: Path) -> None:
    sizes = [(CONNECTORS[0], WIDTH, HEIGHT)]
    path = write_noise(tmp_path / "named.vel", outputs=sizes)
    for name in CONNECTORS:
        outputs.xrandr("--output", name, "--off")
    told = refusal(start, outputs=sizes, frames=None, bundle=path, allow_unsigned=True)
    assert "no output DUMMY0; it has none" in told


def test_outputs_that_are_moved_keep_their_pictures(outputs: Outputs, play: Start) -> None:
    with Wire(play().socket) as wire:
        wire.ask("play", appearance="1")
        outputs.xrandr("--output", "DUMMY0", "--pos", f"{WIDTH}x0", "--output", "DUMMY1", "--pos", "0x0")
        assert comes_true(lambda: same(shown(outputs, (WIDTH, 0, 2 * WIDTH)), noise(SIZES, 1)))


def gammas() -> list[str]:
    ramps = subprocess.run(["xrandr", "--verbose"], check=True, capture_output=True, text=True).stdout
    return [line.split()[-1] for line in ramps.splitlines() if "Gamma:" in line][:3]


def test_an_output_that_is_back_with_a_gamma_ramp_loses_it(outputs: Outputs, play: Start) -> None:
    player = play()
    with Wire(player.socket) as wire:
        wire.ask("play", appearance="2")
        # Stopped meanwhile, so that it finds the output as its driver left it, however quick it is.
        os.kill(player.pid, signal.SIGSTOP)
        outputs.xrandr("--output", "DUMMY1", "--off")
        outputs.place("DUMMY1", WIDTH)
        outputs.xrandr("--output", "DUMMY1", "--gamma", "2:1:1")
        assert gammas() != ["1.0:1.0:1.0"] * 3
        os.kill(player.pid, signal.SIGCONT)
        assert comes_true(lambda: gammas() == ["1.0:1.0:1.0"] * 3)
        assert comes_true(lambda: same(shown(outputs), noise(SIZES, 2)))
        assert wire.ask("status")["missing_outputs"] == []


def test_a_gamma_ramp_is_taken_away_and_nothing_blanks(outputs: Outputs, play: Start) -> None:
    outputs.xrandr("--output", "DUMMY1", "--gamma", "2:1:1")
    play()
    assert gammas() == ["1.0:1.0:1.0"] * 3
    asked = subprocess.run(["xset", "q"], check=True, capture_output=True, text=True).stdout
    assert "timeout:  0 " in asked


def test_a_fade_goes_through_mixtures_of_light_and_ends_exactly(outputs: Outputs, play: Start) -> None:
    before, after = (noise(SIZES, seed)["P2"].astype(float) ** 2 for seed in (0, 1))

    def share(picture: npt.NDArray[np.uint8]) -> float:
        """How much of the second is in it, if it is a mixture."""
        best = float(
            np.vdot(picture.astype(float) ** 2 - before, after - before) / np.vdot(after - before, after - before)
        )
        mixed = np.sqrt(np.clip((1 - best) * before + best * after, 0, None))
        assert np.abs(picture - mixed).max() < 1.2, "not a mixture"
        return best

    with Wire(play().socket) as wire:
        wire.ask("play", appearance="0")
        wire.send(b'{"id": 1, "op": "play", "appearance": "1", "fade_s": 0.8}\n')
        shares: list[float] = []
        while not shares or shares[-1] < 1:
            shares.append(share(outputs.picture(WIDTH)))
        assert wire.receive()["ok"]
    assert shares == sorted(shares)
    assert sum(0 < value < 1 for value in shares) > 3
    assert same(shown(outputs), noise(SIZES, 1))


def test_no_screen_mixes_two_appearances(outputs: Outputs, play: Start) -> None:
    expected = [np.hstack(list(noise(SIZES, seed).values())) for seed in range(APPEARANCES)]
    seen: set[int] = set()
    with Wire(play().socket) as wire:
        wire.ask("sequence", items=[[str(seed), 1 / 60] for seed in range(APPEARANCES)])
        read, ends = 0, time.monotonic() + 60
        while (read < 100 or len(seen) < APPEARANCES) and time.monotonic() < ends:
            read += 1
            now = outputs.picture(0, 3 * WIDTH)
            matches = [seed for seed in range(APPEARANCES) if np.array_equal(now, expected[seed])]
            assert len(matches) == 1
            seen |= set(matches)
    assert len(seen) == APPEARANCES
