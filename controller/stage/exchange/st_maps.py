"""ST maps: pictures whose red and green say where in another picture each pixel's colour comes from (OpenEXR)."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np

from controller.core.arrays import FloatImage
from controller.core.storage import write_atomically
from controller.optics.capture.linear_files import exr_bytes
from controller.stage.artefacts.names import safe_name
from controller.stage.exchange.content import Content

README: Final = """ST maps of a Velatura stage. All are OpenEXR files with 32-bit floats.

PROJECTOR-from-camera.exr  has the projector's size and says where in the camera's picture each projector pixel lies:
                           it warps a picture as seen from the camera into the projector's own.
camera-from-PROJECTOR.exr  has the camera's size and says where in the projector's picture each camera pixel looks.

R is s, 0 at the left border of the picture and 1 at its right border. G is t, 0 at the lower border and 1 at the upper
border. A is 1 where the place is known and 0 elsewhere; B is 0.

A warp moves a picture of one projector to its place. It knows nothing of how bright and in which colour the projector
lights the object, nor of the other projectors whose light falls on the same place. Pictures for superimposed
projectors come from `velatura appearance`, and can't be had by these maps alone.
"""


def write_maps(content: Content, folder: Path) -> dict[str, int]:
    """Write two maps for each projector, and README.txt; a map of measured places only where the run has them.

    Raises WorkError("no-space", "cannot-write").
    """
    size = content.geometry.camera.size_px
    written = 0
    for n, (name, metapixels) in enumerate(zip(content.names, content.metapixels(), strict=True)):
        plain = safe_name(name)
        known = metapixels.valid & np.isfinite(metapixels.centre_px).all(axis=2)
        places = np.where(known[..., None], metapixels.centre_px, np.float32(np.nan))
        write_atomically(folder / f"{plain}-from-camera.exr", st_map(places, size))
        written += 1
        seen = content.seen_px[n]
        if seen is not None:
            write_atomically(folder / f"camera-from-{plain}.exr", st_map(seen, content.geometry.projectors[n].size_px))
            written += 1
    write_atomically(folder / "README.txt", README.encode())
    return {"maps": written}


def st_map(places_px: FloatImage, size_px: tuple[int, int]) -> bytes:
    """An EXR file of (rows, columns, 2) places x, y in a picture of ``size_px`` (width, height); NaN: unknown."""
    known = np.isfinite(places_px).all(axis=2)
    s = (places_px[..., 0] + np.float32(0.5)) / np.float32(size_px[0])
    t = 1 - (places_px[..., 1] + np.float32(0.5)) / np.float32(size_px[1])
    red, green = np.where(known, s, np.float32(0)), np.where(known, t, np.float32(0))
    return exr_bytes({"R": red, "G": green, "B": np.zeros_like(red), "A": np.asarray(known, np.float32)})
