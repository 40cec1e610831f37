"""Cross-fades and identification of a player process, seen through its socket and its memory output only."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from controller.bundle.writer import NewAppearance, NewBundle, write_bundle
from controller.play.control.launch import PlayerProcess
from tests.controller.play.wire import Frames, Pictures, Wire, dark, noise, same

Outputs = list[tuple[str, int, int]]


def flat(pictures: Pictures) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    return np.concatenate([picture.ravel() for picture in pictures.values()]).astype(float)


def share_of(shown: Pictures, before: Pictures, after: Pictures) -> float:
    """How much of ``after``, in light, is in what is shown; fails if that is not a mixture of both."""
    old, new, now = flat(before) ** 2, flat(after) ** 2, flat(shown)
    share = float(np.vdot(now**2 - old, new - old) / np.vdot(new - old, new - old))
    mixed = np.sqrt(np.clip((1 - share) * old + share * new, 0, None))
    # The first steps vanish in the rounding of bright values but show in dark ones, so their share is known worse.
    assert np.abs(now - mixed).max() < (1.2 if share > 0.02 else 8), "not a mixture"
    return share


def shares_until_answer(wire: Wire, frames: Frames, before: Pictures, after: Pictures) -> Iterator[tuple[float, float]]:
    """(monotonic seconds, share) of each set that is presented, to the one that is ``after``."""
    last, share = 0, 0.0
    while share < 1:
        sequence = frames.sequence
        shown, moment = frames.read(), frames.presented_at
        # A set that came while this one was read would lend it its number.
        if sequence != last and frames.sequence == sequence:
            last, share = sequence, share_of(shown, before, after)
            yield moment, share
    assert same(frames.read(), after)
    assert wire.receive()["ok"]


def test_an_appearance_comes_in_evenly_in_light_and_is_exact_at_the_end(
    wire: Wire, outputs: Outputs, folder: Path
) -> None:
    wire.ask("play", appearance="0")
    begins = time.monotonic()
    wire.send(b'{"id": 1, "op": "play", "appearance": "1", "fade_s": 0.5}\n')
    shown = Frames(folder / "out.frame")
    seen = [*shares_until_answer(wire, shown, noise(outputs, 0), noise(outputs, 1))]
    moments, shares = np.array(seen).T
    assert 0.45 < moments[-1] - begins < 0.9
    assert len(shares) > 8
    assert (np.diff(shares) > 0).all()
    # By the clock: two seconds' share a second, wherever a step was left out.
    assert np.abs(np.polyfit(moments[1:], shares[1:], 1)[0] - 2) < 0.4
    status = wire.ask("status")
    assert (status["appearance"], status["fading"]) == ("1", False)


def test_patterns_and_black_fade_too(wire: Wire, outputs: Outputs, folder: Path) -> None:
    shown = Frames(folder / "out.frame")
    pattern = noise(outputs, 70)
    wire.ask("show", sequence=Frames(Path(wire.ask("hello")["inbox"])).write(pattern))
    wire.send(b'{"id": 1, "op": "play", "appearance": "2", "fade_s": 0.3}\n')
    assert len([*shares_until_answer(wire, shown, pattern, noise(outputs, 2))]) > 3
    wire.send(b'{"id": 1, "op": "stop", "fade_s": 0.3}\n')
    black = {name: np.zeros_like(picture) for name, picture in pattern.items()}
    assert len([*shares_until_answer(wire, shown, noise(outputs, 2), black)]) > 3
    assert dark(shown.read())


def test_a_fade_that_is_superseded_goes_on_from_where_it_was(wire: Wire, outputs: Outputs, folder: Path) -> None:
    shown = Frames(folder / "out.frame")
    wire.ask("play", appearance="0")
    wire.send(b'{"id": 1, "op": "play", "appearance": "1", "fade_s": 20}\n')
    while share_of(shown.read(), noise(outputs, 0), noise(outputs, 1)) < 0.01:
        time.sleep(0.01)
    assert wire.ask("status")["fading"]
    halfway = shown.read()
    wire.send(b'{"id": 2, "op": "play", "appearance": "3", "fade_s": 20}\n')
    assert wire.receive()["error"]["code"] == "superseded"
    time.sleep(0.1)
    assert np.abs(flat(shown.read()) - flat(halfway)).max() < 60, "no jump"
    assert wire.ask("status")["appearance"] == "3"
    wire.send(b'{"id": 3, "op": "stop"}\n')
    assert {wire.receive()["id"], wire.receive()["id"]} == {2, 3}
    assert dark(shown.read())


def test_a_sequence_keeps_its_times_with_fades_in_them(wire: Wire, folder: Path, outputs: Outputs) -> None:
    shown = Frames(folder / "out.frame")
    first = wire.ask("sequence", items=[["1", 0.3, 0.2], ["2", 0.4, 0.1], ["3", 0.3, 0.3]], repeat=1)
    whole: dict[str, float] = {}
    ends = first["presented_at"] + 3
    while "3" not in whole and time.monotonic() < ends:
        now, at_s = shown.read(), shown.presented_at
        for name in ("2", "3"):
            if same(now, noise(outputs, int(name))):
                whole.setdefault(name, at_s)
    # Whole 0.2 s after its begin, then 0.3 - 0.2 + 0.1 and 0.4 - 0.1 + 0.3.
    assert 0.1 < whole["2"] - first["presented_at"] < 0.35
    assert 0.5 < whole["3"] - whole["2"] < 0.75


@pytest.mark.parametrize("items", [[["1", 1, 2]], [["1", 1, -1]], [["1", 1, True]], [["1", 1, 1, 1]]])
def test_a_fade_that_does_not_fit_is_not_understood(wire: Wire, items: object) -> None:
    assert wire.ask("sequence", items=items)["error"]["code"] == "request-wrong"


def test_a_new_bundle_comes_in_over_the_old_one(
    start: Callable[..., PlayerProcess], bundle: Path, outputs: Outputs, tmp_path: Path
) -> None:
    new = noise(outputs, 33)
    write_bundle(
        tmp_path / "new.vel",
        NewBundle(stage="s", calibration="c2", created_unix_s=0, outputs=outputs),
        appearances=[NewAppearance("0", new)],
    )
    with Wire(start(bundle=bundle, allow_unsigned=True).socket) as wire:
        wire.ask("play", appearance="0")
        assert wire.ask("load-bundle", path=str(tmp_path / "new.vel"))["ok"]
        wire.send(b'{"id": 1, "op": "play", "appearance": "0", "fade_s": 0.3}\n')
        frames = Frames(tmp_path / "out.frame")
        assert len([*shares_until_answer(wire, frames, noise(outputs, 0), new)]) > 3


def test_every_output_tells_its_number_apart_from_the_others(wire: Wire, folder: Path) -> None:
    assert wire.ask("identify")["ok"]
    assert wire.ask("status")["showing"] == "identification"
    pictures = list(Frames(folder / "out.frame").read().values())
    for picture in pictures:
        assert (picture[[0, -1]] == 255).all()
        assert (picture[:, [0, -1]] == 255).all()
    inside = [picture[2:27, 8:31].tobytes() for picture in pictures]
    assert len(set(inside)) == len(inside)


def test_a_share_of_the_light_is_shown_and_all_of_it_again(wire: Wire, outputs: Outputs, folder: Path) -> None:
    shown = Frames(folder / "out.frame")
    whole = noise(outputs, 1)
    black = {name: np.zeros_like(picture) for name, picture in whole.items()}
    wire.ask("play", appearance="1", brightness=0.25)
    assert abs(share_of(shown.read(), black, whole) - 0.25) < 0.005
    assert wire.ask("status")["brightness"] == 0.25
    wire.ask("sequence", items=[["1", 60], ["2", 60]], brightness=0.5, first_fade_s=0.2)
    assert abs(share_of(shown.read(), black, whole) - 0.5) < 0.005
    wire.ask("play", appearance="1", brightness=0)
    assert dark(shown.read())
    wire.ask("play", appearance="1")
    assert same(shown.read(), whole)
