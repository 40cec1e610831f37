"""Live frames in the player's real window: what the X server holds is the reference, to one device value.

Needs Xvfb (package xvfb) and software OpenGL (libgl1-mesa-dri); a machine without them fails here.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np

from controller.bundle.live_maps import compensate
from tests.controller.play.test_live_gl import OUTPUTS, TARGET, maps_of, random_live, write
from tests.controller.play.test_windows import Framebuffer, framebuffer

__all__ = ["framebuffer"]


def test_a_live_target_reaches_the_screen_and_ordinary_pictures_follow(
    framebuffer: Framebuffer,
    tmp_path: Path,
) -> None:
    arrays = random_live(5)
    bundle = write(tmp_path / "live.vel", arrays)
    target = np.random.default_rng(5).integers(0, 256, (*TARGET[::-1], 3), dtype=np.uint8)
    np.savez(tmp_path / "asked.npz", target=target, brightness=1.1)
    wanted = compensate(maps_of(bundle), target, 1.1)
    script = Path(__file__).with_name("live_window_check.py")
    with subprocess.Popen(
        [sys.executable, str(script), bundle, tmp_path / "asked.npz"],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=Path(__file__).parents[3],
        env={**os.environ, "PYTHONPATH": str(Path(__file__).parents[3])},
    ) as process:  # fmt: skip
        assert process.stdin is not None
        assert process.stdout is not None
        assert process.stdout.readline() == "on the screen\n"
        screen = framebuffer.picture()
        left = 0
        read = np.load(tmp_path / "read.npz")
        for number, (image, (_, columns, rows)) in enumerate(zip(wanted, OUTPUTS, strict=True)):
            shown = screen[: min(rows, len(screen)), left : left + columns]
            away = np.abs(shown.astype(int) - image[: len(shown)])
            assert away.max() <= 1
            np.testing.assert_array_equal(read[f"arr_{number}"][: len(shown)], shown)
            assert np.mean(away > 0) < 0.002
            left += columns
        process.stdin.write("\n")
        process.stdin.flush()
        assert process.stdout.readline() == "on the screen\n"
        assert (framebuffer.picture()[:29, :60] == 77).all()
        process.communicate("\n", timeout=20)
        assert process.returncode == 0
