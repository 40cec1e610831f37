"""Photographs for experiments, on the opened stage."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from controller.core.arrays import ByteImage, FloatImage
from controller.run.runner import Context
from controller.stage.artefacts.calibrated import Calibrated
from controller.stage.rig.rig import Rig
from controller.stage.rig.shared_display import frames_digest
from controller.stage.steps.appearance.photographing import ShownPicture, take_hdr
from controller.stage.steps.appearance.solving import device_frames
from lab.study.subject.dots import plain_dots, read_study_dots
from lab.study.subject.subject import Dots


@dataclass(frozen=True, slots=True)
class RigPhotographer:
    """``subject.Photographer`` on real devices; ``name`` is the experiment's."""

    rig: Rig
    context: Context
    calibrated: Calibrated
    name: str
    longest_exposure_s: float
    used: list[Path] = field(default_factory=list)
    """The photographs of this run or an earlier one."""

    def photograph(self, name: str, frames: Sequence[FloatImage], *, white: float) -> FloatImage:
        return self.photograph_shown(name, device_frames(self.calibrated.calibration, frames), white=white)

    def photograph_shown(self, name: str, shown: Mapping[str, ByteImage], *, white: float) -> FloatImage:
        """As ``photograph``, of 8-bit frames by projector name as the displays get them."""
        presented = self.rig.display.show(self.rig.on_outputs(shown), deadline=self.context.deadline.within(20))
        what = ShownPicture("study", f"{self.name}-{name}", {"frames": frames_digest(shown)}, presented.at_s, white)
        taken, merged = take_hdr(self.rig, self.context, what, self.longest_exposure_s)
        self.used.extend(one.path for one in taken)
        # Too bright for the shortest exposure is at least its full scale; black would be the one wrong answer.
        return np.asarray(np.nan_to_num(merged, nan=1 / min(one.exposure_s for one in taken)), np.float32)

    def dots(self, n: int, *, plain: bool = False) -> Dots:
        name = self.calibrated.projectors[n]
        return plain_dots(self.rig, self.context, name) if plain else read_study_dots(self.context.folder, name)
