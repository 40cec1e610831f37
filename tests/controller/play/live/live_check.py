"""Run by test_live_gl.py in a process of its own: frames by shaders, without a window, as an .npz file.

Arguments: a bundle, an .npz file with "target" and "brightness", and the file to write.
"""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path
from typing import Any

os.environ["LIBGL_ALWAYS_SOFTWARE"] = "1"

import numpy as np
import pyglet

pyglet.options["headless"] = True
pyglet.options["debug_gl"] = False
pyglet.options["shadow_window"] = False

from pyglet import gl  # noqa: E402

from controller.bundle.live_maps import LiveMaps  # noqa: E402
from controller.bundle.reader import Bundle  # noqa: E402
from controller.play.display.live_targets import LiveRenderer  # noqa: E402


def main(bundle: Path, asked: Path, out: Path) -> None:
    config = gl.Config(red_size=8, green_size=8, blue_size=8, major_version=3, minor_version=3)  # type: ignore[abstract]
    window = pyglet.window.Window(16, 16, config=config)
    window.switch_to()
    for state in (gl.GL_DITHER, gl.GL_BLEND, gl.GL_DEPTH_TEST):
        gl.glDisable(state)
    with Bundle.open(bundle, allow_unsigned=True) as opened, np.load(asked) as values:
        renderer = LiveRenderer(LiveMaps.read(opened))
        target, brightness = values["target"], float(values["brightness"])
        renderer.frames(target[:, ::-1], brightness)
        began = time.perf_counter()
        frames = renderer.frames(target, brightness)
        seconds = time.perf_counter() - began
        again = renderer.frames(target, brightness)
        same = all(np.array_equal(a, b) for a, b in zip(frames.pixels, again.pixels, strict=True))
        renderer.close()
    parts: dict[str, Any] = {str(number): image for number, image in enumerate(frames.pixels)}
    np.savez(out, seconds=seconds, same=same, error=gl.glGetError(), **parts)
    window.close()


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
