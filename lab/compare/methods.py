"""The methods that are entered: ours, and earlier ones as their papers describe them.

docs/how-to/compare-methods.md says what each does, and what it leaves out.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import cv2
import numpy as np
from scipy.ndimage import map_coordinates

from controller.core.arrays import ByteImage, Float64, FloatImage, Mask
from controller.optics.calibrate.metapixels.regularize import fill_holes, regularize
from controller.optics.calibrate.values import Calibration, ProjectorCalibration
from controller.optics.solve.bounded.equations import SolveSettings, appearance_weights
from controller.optics.solve.bounded.solver import solve_bounded
from controller.optics.solve.reach.feasibility import direct_part
from controller.optics.solve.scaling.dither import to_device
from controller.optics.transport import LightTransport, build_transport
from controller.optics.transport.indirect.indirect_light import IndirectLight
from controller.stage.steps.appearance.solving import device_frames
from controller.stage.steps.calibrate.dots import CLEAR_GAIN
from lab.compare.api import ComparisonTarget, MakeFrames
from lab.compare.metered_stage import MeteredStage
from lab.study.experiments.ablation import paper_model, raw_transport, with_metapixels
from lab.study.subject.measuring import unbounded_inverse

LIT: Final = 0.05
"""Of the brightest white light on the object: with less, a camera pixel counts as not lit."""
STEPS: Final = 40
"""Of LSMR. Further ones let the noise of the dots grow: on `dark` 5, 15, 40, 100 and 200 were compared by the model."""
SINGULAR: Final = 1e-6
"""A pixel's colours are too alike to be separated if the determinant is below this share of its light cubed."""


def ours(stage: MeteredStage) -> MakeFrames:
    """Velatura: measured shares of light, all projectors solved together between bounds, with indirect light."""
    known = stage.calibrated()
    black = known.calibration.black
    return lambda target: _bounded(known.transport, target, black, known.calibration, known.indirect)


def paper(stage: MeteredStage) -> MakeFrames:
    """The superimposed-projector paper's own way: Gaussians fitted to photographed dots, evened out, bounded solve."""
    known = stage.calibrated()
    plain = paper_model(known.calibration)
    found = [stage.dots(n).metapixels for n in range(len(plain.projectors))]
    even = [fill_holes(regularize(one, least_gain=CLEAR_GAIN)[0]) for one in found]
    transport = build_transport(with_metapixels(plain, even))
    return lambda target: _bounded(transport, target, plain.black, plain, known.indirect)


def inversion(stage: MeteredStage) -> MakeFrames:
    """Full inversion (Wetzstein and Bimber 2007): pseudo-inverse of the measured light transport, then clipped."""
    known = stage.calibrated()
    plain = paper_model(known.calibration)
    transport = raw_transport(plain, [stage.dots(n).shares for n in range(len(plain.projectors))])

    def frames(target: ComparisonTarget) -> list[ByteImage]:
        wanted = direct_part(transport.reach(), target.radiance, plain.black, known.indirect)
        return _device(plain, unbounded_inverse(transport, wanted, plain.black, iterations=STEPS))

    return frames


def single(stage: MeteredStage) -> MakeFrames:
    """One projector (Nayar 2003, Grossberg 2004): each pixel's own colour matrix, measured and inverted."""
    sizes = stage.projectors_px
    black = stage.photograph(_shown(sizes, 0, (0, 0, 0)))
    colours = [_colours(stage, n, black) for n in range(len(sizes))]
    lit = _lit(colours, stage.object_mask)
    best = int(np.argmax([mask.sum() for mask in lit]))
    known = stage.calibrated([best])
    part = known.calibration.projectors[0]

    def frames(target: ComparisonTarget) -> list[ByteImage]:
        whole = _shown(sizes, 0, (0, 0, 0))
        light = np.maximum(target.radiance - black, 0)
        whole[best] = to_device(divided(part, colours[best], light), part.radiometry)
        return whole

    return frames


def feathering(stage: MeteredStage) -> MakeFrames:
    """Feathered projectors (Raskar 1999): each adds a share that falls to nothing at the edge of its light."""
    sizes = stage.projectors_px
    black = stage.photograph(_shown(sizes, 0, (0, 0, 0)))
    colours = [_colours(stage, n, black) for n in range(len(sizes))]
    shares = feathers(_lit(colours, stage.object_mask))
    calibration = stage.calibrated().calibration

    def frames(target: ComparisonTarget) -> list[ByteImage]:
        light = np.maximum(target.radiance - black, 0)
        parts = zip(calibration.projectors, colours, shares, strict=True)
        return _device(calibration, [divided(part, seen, share[..., None] * light) for part, seen, share in parts])

    return frames


def feathers(lit: Sequence[Mask]) -> list[FloatImage]:
    """Each projector's share of the light (rows, columns): by the distance to where it ends; they add up to 1."""
    # A frame of unlit pixels: the picture's edge ends the light, too.
    far = [cv2.distanceTransform(np.pad(mask, 1).astype(np.uint8), cv2.DIST_L2, 5)[1:-1, 1:-1] for mask in lit]
    whole = np.sum(far, axis=0)
    return [np.divide(one, whole, out=np.zeros(whole.shape, np.float32), where=whole > 0) for one in far]


def divided(part: ProjectorCalibration, colours: Float64, light: FloatImage) -> FloatImage:
    """The linear frame (rows, columns, 3) of one projector that makes ``light`` (camera rows, columns, 3) alone.

    At each metapixel's centre the 3x3 matrix of ``colours`` (camera rows, columns, 3 camera, 3 projector channels) is
    read bilinearly and inverted; clipped to [0, 1]. A pixel whose colours can't be separated is at white where light
    is wanted.
    """
    frame = np.zeros((*part.metapixels.valid.shape, 3), np.float32)
    usable = part.metapixels.valid & np.isfinite(part.metapixels.centre_px).all(axis=-1)
    centre = part.metapixels.centre_px[usable].astype(np.float64)
    wanted = _sampled(light, centre)
    matrix = _sampled(colours.reshape(*colours.shape[:2], 9), centre).reshape(-1, 3, 3)
    size = matrix.sum(axis=2).mean(axis=1)
    regular = np.abs(np.linalg.det(matrix)) > SINGULAR * np.maximum(size, 1e-12) ** 3
    value = (wanted > 0).astype(np.float64)
    value[regular] = np.linalg.solve(matrix[regular], wanted[regular][..., None])[..., 0]
    frame[usable] = np.clip(value, 0, 1)
    return frame


def _bounded(
    transport: LightTransport,
    target: ComparisonTarget,
    black: FloatImage,
    calibration: Calibration,
    indirect: IndirectLight | None,
) -> list[ByteImage]:
    wanted = direct_part(transport.reach(), target.radiance, black, indirect)
    weights = appearance_weights(target.radiance, target.in_reach, target.white)
    solution = solve_bounded(transport, np.maximum(wanted, black), black, SolveSettings(weights=weights))
    return _device(calibration, solution.frames)


def _device(calibration: Calibration, frames: Sequence[FloatImage]) -> list[ByteImage]:
    return list(device_frames(calibration, frames).values())


def _shown(sizes: Sequence[tuple[int, int]], n: int, colour: tuple[int, int, int]) -> list[ByteImage]:
    """Projector ``n`` in one colour, the others black."""
    frames = [np.zeros((height, width, 3), np.uint8) for width, height in sizes]
    frames[n][:] = colour
    return frames


def _colours(stage: MeteredStage, n: int, black: FloatImage) -> Float64:
    """(rows, columns, 3 camera channels, 3 projector channels): light of each channel of projector ``n`` at full."""
    channels = [tuple(255 if k == c else 0 for k in range(3)) for c in range(3)]
    seen = [stage.photograph(_shown(stage.projectors_px, n, (r, g, b))) - black for r, g, b in channels]
    return np.stack(seen, axis=-1).astype(np.float64)


def _lit(colours: Sequence[Float64], mask: Mask) -> list[Mask]:
    """Where each projector lights the object."""
    light = [one.sum(axis=(2, 3)) for one in colours]
    most = max(float(np.percentile(one[mask], 99)) for one in light)
    return [np.asarray(mask & (one > LIT * most)) for one in light]


def _sampled(image: FloatImage | Float64, centre: Float64) -> Float64:
    at = (centre[:, 1], centre[:, 0])
    channels = range(image.shape[2])
    return np.stack([map_coordinates(image[..., c], at, np.float64, order=1, mode="nearest") for c in channels], -1)
