"""A judge's camera: it photographs an emulated stage from any place, without noise, and no controller knows of it."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from plugins.emulated.core.truth import CameraTruth, Pose, matrix_of, read_truth, rotation_vector_of, three
from plugins.emulated.optics.indirect.transfers import IndirectTransfers
from plugins.emulated.optics.light_cache import light_folder
from plugins.emulated.optics.rays import samples_of
from plugins.emulated.optics.render import ByteImage, FloatImage, Renderer
from plugins.emulated.optics.world import object_of


def carried(camera: CameraTruth, right_degrees: float) -> CameraTruth:
    """The camera, carried so many degrees to the right around the object, which stays in the middle of its picture."""
    turn = matrix_of((0.0, -float(np.deg2rad(right_degrees)), 0.0))
    position, rotation = turn @ np.asarray(camera.pose.position_m), camera.pose.rotation @ turn.T
    return dataclasses.replace(camera, pose=Pose(three(position), three(rotation_vector_of(rotation))))


class JudgeCamera:
    """``camera``: of the stage's truth, or ``carried``; its rays are cast at once, which takes seconds.

    ``direct``: without the light that comes back from other surfaces
    """

    def __init__(self, stage: Path, camera: CameraTruth, *, direct: bool = False) -> None:
        whole = read_truth(stage)
        # one of the stage's own sees the very light that the bench has worked out for it
        own = whole.seen_by(camera) if camera in whole.cameras else whole
        self._truth = dataclasses.replace(own, camera=camera, more_cameras=())
        if direct:
            self._truth = dataclasses.replace(self._truth, engine="direct")
        thing, kept = object_of(stage, whole.object), light_folder(stage)
        samples = samples_of(self._truth, thing, kept, lambda share: None)
        transfer = IndirectTransfers(thing, kept).transfer(self._truth, samples.pixels, lambda share: None, keep=True)
        self._renderer = Renderer(self._truth, samples, transfer)

    def light(self, frames: Mapping[str, ByteImage]) -> FloatImage:
        """Linear light (rows, columns, 3) float32 of device frames (rows, columns, 3) uint8 by projector name.

        Projectors without a frame show black; all lamps are fully lit.
        """
        shown = []
        for projector in self._truth.projectors:
            width, height = projector.lens.size_px
            shown.append(frames.get(projector.name, np.zeros((height, width, 3), np.uint8)))
        return np.array(self._renderer.light(shown, [1.0] * len(shown)))
