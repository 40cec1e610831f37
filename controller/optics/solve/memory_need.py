"""How much memory calibrations and solves take at their peak, calculated before they begin (docs/decisions/0004).

Counted are arrays of the process itself. A calibration's own arrays lie in files, and what of them is in memory can be
had back by the system at any time.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from controller.core.arrays import MAPPED_FROM
from controller.core.errors import WorkError
from controller.optics.calibrate.values import Calibration

WINDOW: Final = 15
"""Bytes of one camera sample's share of one projector."""
LEAST_OBJECT: Final = 0.25
"""Share of the camera's picture; how much an object needs is not known before it is photographed, and what is refused
then must certainly not fit."""
DECODED: Final = 62
"""Bytes of a camera pixel while one projector's photographs are decoded, sums in a file."""
FITTED: Final = 75
"""The same while its metapixels and its phase map are made, the projector's own arrays included: it has about a sixth
as many pixels as the camera."""
PHOTOGRAPHED: Final = 17
"""The same of the photograph of the next projector that is read meanwhile."""
REFINED: Final = 290
"""Bytes of a camera pixel while a photograph of a result corrects the target: 24 pictures of light, and masks."""
INDIRECT, PAINT, SPREAD = 13, 18, 16
"""Of what is known of a stage's indirect light, of colours that depend on the paint, and of light under the surface."""
SPARE: Final = 1.1
"""Small arrays, stacks and tables of threads."""
PROGRAM: Final = 300 * 1024 * 1024
"""Python, its libraries and compiled kernels."""


@dataclass(frozen=True, slots=True)
class StageSize:
    """What the memory of a solve depends on.

    ``camera``, ``projectors``: pixels of the camera, and of all projectors together; ``count`` of projectors
    ``windows``: pairs of a camera sample and a projector that lights it; ``samples``: of the camera, one a pixel with
    a mosaic, else three; ``has_indirect``, ``has_paint``, ``has_spread``: what is known of the stage's light
    """

    camera: int
    projectors: int
    count: int
    windows: int
    samples: int
    has_indirect: bool = False
    has_paint: bool = False
    has_spread: bool = False

    @property
    def transport(self) -> int:
        """Bytes of the light transport: windows, masks, and four numbers a projector pixel."""
        return WINDOW * self.windows + self.count * self.camera + 16 * self.projectors

    @property
    def white(self) -> int:
        """Bytes of what solves keep of the projectors' white light."""
        return 12 * self.projectors + self.count * self.camera * 3 // 4

    @property
    def known(self) -> int:
        """Bytes of a camera pixel of what is known of the stage's light."""
        return INDIRECT * self.has_indirect + PAINT * self.has_paint + SPREAD * self.has_spread


def stage_size(calibration: Calibration) -> StageSize:
    """Of a calibration; as if every projector lit the whole object, so rather too large."""
    lit = int(calibration.object_mask.sum())
    channels = 3 if calibration.mosaic is None else 1
    count = len(calibration.projectors)
    pixels = sum(part.metapixels.valid.size for part in calibration.projectors)
    camera = calibration.object_mask.size
    parts = calibration.projectors
    return StageSize(
        camera, pixels, count, count * lit * channels, camera * channels,
        has_indirect=any(part.indirect is not None for part in parts),
        has_paint=all(part.radiometry.paint is not None for part in parts),
        has_spread=any(part.spread is not None for part in parts),
    )  # fmt: skip


def planned_size(camera_px: tuple[int, int], projectors_px: Sequence[tuple[int, int]]) -> StageSize:
    """Of a stage that is not calibrated yet, (width, height) each, with an object that is small in the picture."""
    camera = camera_px[0] * camera_px[1]
    pixels = sum(width * height for width, height in projectors_px)
    windows = int(LEAST_OBJECT * len(projectors_px) * camera)
    return StageSize(camera, pixels, len(projectors_px), windows, camera)


def base_peak_bytes(size: StageSize) -> int:
    """Bytes at the peak of building the transport, solving a base image and preparing to scale it."""
    C, P, W, S = size.camera, size.projectors, size.windows, size.samples
    # even gains and one picture of samples, wherever means over metapixels are taken
    means = 4 * W + 4 * S
    built = size.transport + 3 * size.count * C + 12 * P + max(28 * C, 12 * C + means)
    # the picture and the weights stay during the solve
    solving = size.transport + size.white + 12 * C + 4 * C
    smoothed = solving + 12 * C + 12 * P + 12 * P + means
    begun = solving + 24 * P + 12 * C + 12 * P + 12 * P + means + 4 * S
    swept = solving + 24 * P + 36 * P + 5 * 4 * S
    ended = solving + 36 * P + 24 * C
    prepared = size.transport + size.white + 24 * C + 12 * P + 3 * C + max(12 * C + 12 * P + means, 15 * C + 36 * P)
    return int(SPARE * max(built, smoothed, begun, swept, ended, prepared)) + PROGRAM


def appearance_peak_bytes(size: StageSize) -> int:
    """Bytes at the peak of making a target reachable and solving it, its base ready to be scaled."""
    C, P, W, S = size.camera, size.projectors, size.windows, size.samples
    own = 12 * P // max(size.count, 1)
    # Small images stay in memory: light of white, the base, what is known, and the target.
    here = C if 12 * C < MAPPED_FROM else 0
    kept = size.transport + size.white + C + (36 * P if own < MAPPED_FROM else 0) + (36 + 36 + size.known) * here
    aimed = kept + 12 * C + 12 * here + 7 * C
    floor = 12 * C if size.known else 0
    adapted = aimed + floor + 12 * C + 12 * C + 12 * C + 24 * C
    apart = aimed + 12 * here + (12 + 12 + 12 + 12 + 24) * C + (PAINT * size.has_paint + 16 * size.has_spread) * C
    begun = kept + 36 * here + floor + (14 + 1 + 4) * C + 24 * P + 12 * C + 12 * P + 2 * own + 4 * W + 4 * S
    swept = kept + 36 * here + floor + (14 + 1 + 8) * C + 24 * P + 36 * P + 20 * S
    return int(SPARE * max(adapted, apart if size.known else 0, begun, swept)) + PROGRAM


def solve_peak_bytes(size: StageSize) -> int:
    """Bytes at the peak of a base image and of the appearances after it."""
    return max(base_peak_bytes(size), appearance_peak_bytes(size))


def refine_peak_bytes(size: StageSize) -> int:
    """Bytes at the peak of correcting an appearance by a photograph of it."""
    C, P = size.camera, size.projectors
    kept = size.transport + (72 + size.known) * (C if 12 * C < MAPPED_FROM else 0) + 24 * P
    return int(SPARE * (kept + REFINED * C)) + PROGRAM


def calibration_peak_bytes(size: StageSize) -> int:
    """Bytes at the peak of decoding photographs and fitting metapixels, while the next projector is photographed."""
    return int(SPARE * (max(DECODED, FITTED) + PHOTOGRAPHED) * size.camera) + PROGRAM


def check_memory(need: int, free: int | None, work: str = "The solve") -> str:
    """One sentence on how much memory is needed and free. Raises WorkError("memory-too-small") where it does not fit.

    ``free``: bytes, or None if not known; then nothing is refused. ``work``: what needs it, one thing
    """
    needed = f"{work} needs about {need / 1e9:.1f} GB of memory"
    if free is None:
        return f"{needed}; how much is free is not known."
    if need > free:
        raise WorkError(
            "memory-too-small",
            what=f"{needed}, and {free / 1e9:.1f} GB are free for this process.",
            remedy="Close other programs, raise the memory limit of the service, or use a machine with more memory.",
        )
    return f"{needed}; {free / 1e9:.1f} GB are free."
