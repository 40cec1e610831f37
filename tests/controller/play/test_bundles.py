"""Bundles that are exchanged while a picture is shown, and damaged ones."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

from controller.bundle.signing import generate_key, load_signing_key
from controller.bundle.writer import NewAppearance, NewBundle, write_bundle
from controller.play.control.launch import PlayerProcess
from tests.controller.play.wire import Frames, Wire, noise, same

Outputs = list[tuple[str, int, int]]
Start = Callable[..., PlayerProcess]


def test_bundles_are_swapped_without_a_black_frame_and_only_if_ours(
    start: Start, outputs: Outputs, tmp_path: Path
) -> None:
    keys = [tmp_path / "ours", tmp_path / "theirs"]
    for path in keys:
        generate_key(path)
    small = [(name, 8, 8) for name, _, _ in outputs]
    for file, key, sizes in (("a", 0, outputs), ("b", 0, outputs), ("foreign", 1, outputs), ("small", 0, small)):
        appearance = NewAppearance("x", noise(sizes, ord(file[0])))
        signer = load_signing_key(keys[key])
        write_bundle(tmp_path / file, NewBundle("s", "c", 0, sizes), [appearance], key=signer)
    shown = start(bundle=tmp_path / "a", trusted=[tmp_path / "ours.pub"])
    frames = Frames(tmp_path / "out.frame")
    with Wire(shown.socket) as wire:
        wire.ask("play", appearance="x")
        swaps = frames.sequence
        for file, code in (("foreign", "bundle-untrusted"), ("small", "bundle-outputs-differ")):
            assert wire.ask("load-bundle", path=str(tmp_path / file))["error"]["code"] == code
        before = wire.ask("hello")["bundle"]
        assert wire.ask("load-bundle", path=str(tmp_path / "b"))["bundle"] != before
        assert frames.sequence == swaps
        assert same(frames.read(), noise(outputs, ord("a")))
        wire.ask("play", appearance="x")
        assert frames.sequence == swaps + 2
        assert same(frames.read(), noise(outputs, ord("b")))


def test_a_damaged_appearance_is_skipped_and_the_others_play_on(
    start: Start, bundle: Path, outputs: Outputs, tmp_path: Path
) -> None:
    data = bytearray(bundle.read_bytes())
    data[4096 + 20] ^= 1  # in the first stripe of "0"
    bundle.write_bytes(data)
    with Wire(start(bundle=bundle, allow_unsigned=True).socket) as wire:
        wire.ask("play", appearance="1")
        assert wire.ask("play", appearance="0")["error"]["code"] == "bundle-damaged"
        assert same(Frames(tmp_path / "out.frame").read(), noise(outputs, 1))
        first = wire.ask("sequence", items=[["2", 0.02], ["0", 0.02], ["3", 0.02]], repeat=3)
        ends = time.monotonic() + 60
        while (status := wire.ask("status"))["sequence_running"] and time.monotonic() < ends:
            time.sleep(0.02)
        assert status["sequence"] - first["sequence"] == 5
        assert status["skipped"] == 4
