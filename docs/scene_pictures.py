"""Makes the small pictures of Blender's scenes again, from the calibration of a demo: python -m docs.scene_pictures RUN

RUN is a finished calibration's folder. The pictures show its object in each scene, as its camera sees it.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path
from typing import Final

import cv2
import numpy as np

from controller.core.arrays import ByteImage, Mask
from controller.core.colour import linear_to_srgb
from controller.kiosk.preview.scenes import SHIPPED
from controller.optics.solve.targets.files import read_picture
from controller.stage.artefacts.calibrated import Calibrated
from controller.stage.artefacts.geometry import read_geometry
from controller.stage.blender.job import BUILTIN, RenderSettings, as_seen, write_job
from controller.stage.blender.run import find_blender, render

NAMES: Final = ("left", "right", "above")
"""The projectors of a demo."""
WIDE, HIGH = 480, 320


def main(run: Path) -> None:
    calibrated = Calibrated(run, NAMES)
    geometry, mask = read_geometry(run, NAMES), calibrated.transport.object_mask
    light = calibrated.transport.reach()
    for name in BUILTIN:
        with tempfile.TemporaryDirectory() as scratch:
            work = Path(scratch)
            write_job(work, geometry, mask, light, builtin=name, scene_file=None, settings=RenderSettings())
            seen = as_seen(read_picture(render(find_blender(), work, lambda share, note: None)), geometry.camera, mask)
        colours = np.rint(255 * linear_to_srgb(np.clip(seen.image, 0, 1))).astype(np.uint8)
        cv2.imwrite(
            str(SHIPPED / f"{name}.jpg"), _framed(colours, seen.mask)[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 82]
        )


def _framed(picture: ByteImage, mask: Mask) -> ByteImage:
    """The object in the middle of a picture of 3:2, on black."""
    rows, columns = np.nonzero(mask)
    top, bottom, left, right = rows.min(), rows.max() + 1, columns.min(), columns.max() + 1
    scale = min(0.94 * WIDE / (right - left), 0.94 * HIGH / (bottom - top))
    part = picture[top:bottom, left:right]
    cut = np.asarray(cv2.resize(part, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), np.uint8)
    framed = np.zeros((HIGH, WIDE, 3), np.uint8)
    y, x = (HIGH - cut.shape[0]) // 2, (WIDE - cut.shape[1]) // 2
    framed[y : y + cut.shape[0], x : x + cut.shape[1]] = cut
    return framed


if __name__ == "__main__":
    main(Path(sys.argv[1]))
