"""Projectors put up as planned: the bench's setting ``stands``."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Final

from hal.runtime.files import read_text
from plugins.emulated.core.tables import Between, load
from plugins.emulated.core.truth import Lens, Pose, ProjectorTruth, Three, Two

DRAWN: Final = -1.0
"""Instead of a blur: it is drawn, as lenses differ."""
LUX_OF_LIGHT: Final = 9000.0
"""Illuminance by which the bench calls the light on a surface 1."""


@dataclass(frozen=True, slots=True)
class Stand:
    """A projector put up as planned. World and device frames as in ``truth``; lens and light as data sheets have them.

    ``throw_ratio``: distance by picture width; ``centre_share``: the axis' place in the picture, in its width and
    height from the upper left corner; ``focus_m``: the depth of best focus; ``lumens`` of a white picture; ``pupil_m``;
    ``sharpest_px``: standard deviation of a pixel's blur in focus; ``DRAWN``: as lenses differ
    """

    name: str
    position_m: Annotated[Three, Between(-100.0, 100.0)]
    rotation_vector: Annotated[Three, Between(-10.0, 10.0)]
    throw_ratio: Annotated[float, Between(0.05, 100.0)]
    centre_share: Annotated[Two, Between(-10.0, 10.0)]
    focus_m: Annotated[float, Between(0.01, 100.0)]
    lumens: Annotated[float, Between(1.0, 1e6)]
    pupil_m: Annotated[float, Between(0.0, 1.0)]
    sharpest_px: Annotated[float, Between(0.0, 3.0)] = DRAWN

    def put(self, projector: ProjectorTruth) -> ProjectorTruth:
        """``projector`` at this place."""
        size = projector.lens.size_px
        lens = self.lens(size)
        # near its focus a lens' disc grows in proportion to the depth; its sigma is a quarter of its width
        slope = 0.25 * self.pupil_m * lens.focal_px / self.focus_m**2
        return dataclasses.replace(
            projector,
            pose=Pose(self.position_m, self.rotation_vector),
            lens=lens,
            focus=dataclasses.replace(
                projector.focus,
                distance_m=self.focus_m,
                slope_px_per_m=slope,
                sharpest_px=projector.focus.sharpest_px if self.sharpest_px < 0 else self.sharpest_px,
            ),
            light=dataclasses.replace(projector.light, reference_m=self.focus_m, brightness=self.light_at_focus(size)),
        )

    def lens(self, size_px: tuple[int, int]) -> Lens:
        width, height = size_px
        centre = (self.centre_share[0] * width - 0.5, self.centre_share[1] * height - 0.5)
        return Lens(size_px, self.throw_ratio * width, centre, (0.0, 0.0))

    def light_at_focus(self, size_px: tuple[int, int]) -> float:
        """Of a white picture on a plane facing the lens: the picture there is focus by throw ratio wide."""
        wide_m = self.focus_m / self.throw_ratio
        return self.lumens / (wide_m * wide_m * size_px[1] / size_px[0]) / LUX_OF_LIGHT


@dataclass(frozen=True, slots=True)
class _File:
    stands: tuple[Stand, ...]


def read(folder: Path, file: str) -> tuple[Stand, ...]:
    """Those of a TOML file, relative to ``folder``.

    Raises ValueError with what is wrong: the file, or names of which two are alike; DeviceError as ``tables.load``.
    """
    try:
        text = read_text(folder / file)
    except (OSError, UnicodeDecodeError) as error:
        raise ValueError(file) from error
    stands = load(text, _File, file=file).stands
    if len({stand.name for stand in stands}) != len(stands):
        raise ValueError([stand.name for stand in stands])
    return stands
