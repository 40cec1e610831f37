"""Live targets through a real player with a real window: what the X server holds is the reference, to one device value.

Needs Xvfb (package xvfb) and software OpenGL (libgl1-mesa-dri); a machine without them fails here.
"""

from __future__ import annotations

import contextlib
import json
from pathlib import Path

import numpy as np
import numpy.typing as npt

from controller.bundle.live_maps import compensate
from controller.play.frames import FrameFile, FrameSet, OutputSize
from tests.controller.play.conftest import START
from tests.controller.play.display.test_window import Framebuffer, framebuffer
from tests.controller.play.live.test_gl import OUTPUTS, TARGET, maps_of, random_live, write
from tests.controller.play.live.test_stream import live
from tests.controller.play.wire import Wire
from tests.waiting import eventually

__all__ = ["framebuffer"]

Image = npt.NDArray[np.uint8]


def is_on_the_screen(screen: Image, wanted: tuple[Image, ...]) -> bool:
    """Whether each output's part of the screen is its image, to one device value at a few pixels."""
    left = 0
    for image, (_, columns, _) in zip(wanted, OUTPUTS, strict=True):
        part = screen[: len(image), left : left + columns]
        away = np.abs(part.astype(int) - image[: len(part)])
        if away.max() > 1 or np.mean(away > 0) >= 0.002:
            return False
        left += columns
    return True


def test_live_targets_reach_the_screen_and_ordinary_pictures_follow(
    framebuffer: Framebuffer, start: START, tmp_path: Path
) -> None:
    bundle = write(tmp_path / "live.vel", random_live(5))
    maps = maps_of(bundle)
    targets = [np.random.default_rng(seed).integers(0, 256, (*TARGET[::-1], 3), dtype=np.uint8) for seed in (5, 6)]
    player = start(outputs=OUTPUTS, frames=None, bundle=bundle, allow_unsigned=True)
    wrong = [OutputSize("target", 7, 5)]
    FrameFile(tmp_path / "wrong", wrong).close()
    with (
        contextlib.closing(FrameFile(tmp_path / "targets", [OutputSize("target", *TARGET)])) as file,
        Wire(player.socket) as wire,
    ):
        refused = wire.ask("live", file=str(tmp_path / "wrong"), white=1.1)["error"]
        assert "target 7x5" in refused["what"]
        assert f"target {TARGET[0]}x{TARGET[1]}" in refused["remedy"]
        assert wire.ask("live", file=str(file.path), white=1.1)["by"] == "shaders"
        for shown, target in enumerate(targets, start=1):
            file.write(FrameSet((target,)))
            assert eventually(lambda shown=shown: live(wire)["shown"] == shown)  # type: ignore[misc]
            assert is_on_the_screen(framebuffer.picture(), compensate(maps, target, 1.1))
        before = framebuffer.picture().astype(int)
        # a fade begins from what the shaders made
        wire.send(b'{"op": "stop", "fade_s": 20}\n')
        assert eventually(lambda: bool((framebuffer.picture() < before - 9).any()))
        bright = before > 100
        dimmed = framebuffer.picture()[bright] / before[bright]
        assert 0.2 < np.median(dimmed) < 0.99
        assert np.abs(dimmed - np.median(dimmed)).max() < 0.03
        wire.send(json.dumps({"op": "live", "file": str(file.path), "white": 1.1}).encode() + b"\n")
        assert wire.receive()["error"]["code"] == "superseded"
        assert wire.receive()["by"] == "shaders"
        assert eventually(lambda: bool((framebuffer.picture() == before).all()))
        wire.ask("play", appearance="a")
        assert not framebuffer.picture().any(), "the appearance is black"
        assert wire.ask("status")["live"] is None
