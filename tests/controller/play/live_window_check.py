"""Run by test_live_window.py in a process of its own: a live target in the player's window, left there until told.

Arguments: a bundle, an .npz file with "target" and "brightness". Prints a line when the picture is on the screen.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from controller.bundle.live_maps import LiveMaps
from controller.bundle.reader import Bundle
from controller.play.frames import FrameSet, OutputSize
from controller.play.windows import WindowOutput


def main(bundle: Path, asked: Path) -> None:
    with Bundle.open(bundle, allow_unsigned=True) as opened, np.load(asked) as values:
        maps = LiveMaps.read(opened)
        target, brightness = values["target"], float(values["brightness"])
    output = WindowOutput([OutputSize(one.name, *one.size_px) for one in maps.outputs])
    output.load_live(maps)
    output.prepare_live(target, brightness)
    output.flip()
    np.savez(asked.with_name("read.npz"), *output.live_frames().pixels)
    print("on the screen", flush=True)
    sys.stdin.readline()
    # An ordinary picture after it: the window's own drawing is as it was.
    output.prepare(FrameSet(tuple(np.full(one.base.shape, 77, np.uint8) for one in maps.outputs)))
    output.flip()
    print("on the screen", flush=True)
    sys.stdin.readline()
    output.close()


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
