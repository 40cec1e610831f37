"""Which way live pictures become light: shaders of a player with windows, or finished frames, without being asked."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from controller.bundle.live_maps import compensate
from controller.optics.capture.acquire import Acquirer
from controller.play.control.launch import PlayerSettings, start_player
from controller.run.runner import Context
from controller.stage.live import LivePicture
from controller.stage.rig.rig import Rig
from controller.stage.services.live import Ready, live_mode
from hal.deadline import in_seconds
from hal.interfaces import Camera
from hal.registry import OpenContext
from plugins.display.player import DRIVER, PlayerDisplay
from tests.controller.play.display.test_window import Framebuffer, framebuffer
from tests.controller.play.live.test_gl import OUTPUTS, TARGET, maps_of, random_live, write
from tests.controller.play.live.test_window import is_on_the_screen
from tests.controller.play.wire import Frames
from tests.waiting import eventually

__all__ = ["framebuffer"]


@contextlib.contextmanager
def display_of(folder: Path, *, windows: bool) -> Iterator[PlayerDisplay]:
    settings = PlayerSettings(OUTPUTS, None if windows else folder / "out.frame", allow_unsigned=True)
    with start_player(folder, settings):
        display = DRIVER.open({}, OpenContext(stage=folder, runtime=folder), in_seconds(20))
        assert isinstance(display, PlayerDisplay)
        with contextlib.closing(display):
            yield display


@pytest.mark.parametrize("windows", [False, True], ids=["memory", "windows"])
@pytest.mark.parametrize("in_bundle", [False, True], ids=["bundle without", "bundle with"])
def test_targets_go_to_shaders_where_there_are_any_and_finished_frames_otherwise(
    framebuffer: Framebuffer, tmp_path: Path, windows: bool, in_bundle: bool
) -> None:
    (tmp_path / "bundles").mkdir()
    maps = maps_of(write(tmp_path / "bundles" / "current", random_live(5)))
    target = np.random.default_rng(5).integers(0, 256, (*TARGET[::-1], 3), dtype=np.uint8)
    context = cast("Context", SimpleNamespace(deadline=in_seconds(100)))
    with display_of(tmp_path, windows=windows) as display:
        rig = Rig(tmp_path, (), cast("Camera", None), display, cast("Acquirer", None))
        with live_mode(rig, context, Ready(maps, 1.1, shaded=in_bundle)) as mode:
            made = mode.maker.blank()
            mode.maker.make(LivePicture(target, 0, 0), made)
            mode.write(made)

            def status() -> str | None:
                live = display.playing(deadline=in_seconds(20)).live
                return live.by if live is not None and live.shown else None

            assert eventually(lambda: status() is not None)
            shaded = windows and in_bundle
            assert status() == ("shaders" if shaded else "frames")
            if windows and shaded:
                assert is_on_the_screen(framebuffer.picture(), compensate(maps, target, 1.1))
            elif not windows:
                shown = Frames(tmp_path / "out.frame").read()
                for frame, output in zip(made, maps.outputs, strict=True):
                    np.testing.assert_array_equal(shown[output.name], frame)
