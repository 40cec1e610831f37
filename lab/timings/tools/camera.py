"""``python -m lab.timings.tools.camera BYTES FLAVOUR``: an emulated camera in its own process; ends with its input.

Prints its address. Every picture is the same file of that many bytes, so that no optics are in the figures.
"""

from __future__ import annotations

import sys
from typing import cast

import numpy as np

from lab.emulated.cameras.camera import EmulatedPtpCamera, Flavour
from plugins.emulated.core.shot import ShotFiles, ShotSettings


def main(size: str, flavour: str) -> None:
    """Serve until standard input closes."""
    file = np.random.default_rng(0).integers(0, 256, int(size), dtype=np.uint8).tobytes()

    def expose(settings: ShotSettings) -> ShotFiles:
        return ShotFiles(raw=file if settings.raw else None, jpeg=file if settings.jpeg else None)

    with EmulatedPtpCamera(expose, flavour=cast("Flavour", flavour), time_scale=0.0) as camera:
        print(camera.address, flush=True)
        sys.stdin.buffer.read()


if __name__ == "__main__":
    main(*sys.argv[1:])
