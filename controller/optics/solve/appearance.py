"""Pictures at interactive speed: base times scale (paper 3, eqs 4-6).

C_t = C_b x C_s for every camera pixel; the base's frames P_b are solved once; each projector pixel's P_s is the mean of
C_s over its metapixel; then P_t = P_b x P_s. Light is counted above the black image K, and the product is taken in the
camera's colours, M p, so that projectors of different primaries are scaled alike.

Traditional compensation, with which superimposed projectors are compared (paper 6), uses one projector and a division
at each pixel (Nayar 2003, Grossberg 2004). It ignores neighbours, other projectors and bounds.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal

import numpy as np

from controller.core import channels
from controller.core.arrays import FloatImage, moved_to_file
from controller.core.channels import largest
from controller.core.checks import check_image
from controller.core.errors import UsageError
from controller.optics.calibrate.values import Calibration
from controller.optics.solve.bounded.engine import ALONE, Engine, Processor, SolveContext
from controller.optics.solve.bounded.equations import DEFAULT_SETTINGS, Solution, SolveSettings
from controller.optics.solve.bounded.solver import check_target, solve_bounded
from controller.optics.solve.reach.drive_levels import DriveLevels
from controller.optics.solve.reach.feasibility import ExposedTarget, expose_target
from controller.optics.transport import LightTransport, build_transport
from controller.optics.transport.indirect.indirect_light import ReflectedLight
from controller.optics.transport.planes import frame_planes, plane_frames, planes_above

BaseKind = Literal["minimum", "white"]

FAINTEST_BASE: Final = 1e-2
"""Below this fraction of the mean base light, a pixel is not used in its metapixels' means."""
HEADROOM: Final = 0.5
"""A white base uses this part of the reachable light, so that scales above 1 are possible."""


@dataclass(frozen=True, slots=True, eq=False)
class StageLight:
    """What is known of the light of a stage.

    ``transport``: T; ``black`` (rows, columns, 3): the black image K
    ``indirect``: light by way of other surfaces, G; None: there is none
    ``drive``: levels of this transport, where they are already known
    """

    transport: LightTransport
    black: FloatImage
    indirect: ReflectedLight | None = None
    drive: DriveLevels | None = None

    def levels(self, folder: Path | None = None) -> DriveLevels:
        """Of this transport; ``folder`` as of ``DriveLevels``, where they are not known already."""
        return DriveLevels.of_transport(self.transport, folder) if self.drive is None else self.drive


@dataclass(frozen=True, slots=True)
class Base:
    """A solved base image, ready to be scaled.

    ``image`` (rows, columns, 3): C_b with the black image; ``solution``: its frames P_b
    ``inverse`` (3, rows, columns): 1 / base light, 0 where the base is (nearly) zero
    ``coverage`` (3, pixels): 1 / share of each metapixel that has base light, 0 where none has
    ``mixed`` (3, pixels): M p_b
    """

    image: FloatImage
    solution: Solution
    inverse: FloatImage
    coverage: FloatImage
    mixed: FloatImage

    def in_files(self, folder: Path) -> Base:
        """The same; what is large need not stay in memory, but in nameless files of ``folder``."""
        frames = tuple(moved_to_file(frame, folder) for frame in self.solution.frames)
        image, inverse, coverage, mixed = (
            moved_to_file(one, folder) for one in (self.image, self.inverse, self.coverage, self.mixed)
        )
        solution = dataclasses.replace(self.solution, frames=frames)
        return Base(image, solution, inverse, coverage, mixed)


def base_image(calibration: Calibration, kind: BaseKind = "white") -> FloatImage:
    """The base image C_b as radiance, (rows, columns, 3); the black image alone outside the object.

    ``"minimum"``: the darkest white image among the projectors that light a pixel, which drops specular highlights and
    keeps the object's own pattern (paper 3.1, 5). ``"white"``: even light over the object, so that its pattern is
    cancelled in the base, at full resolution, and the scale has only the target's detail.
    """
    # one projector after the other: their white images are in files, and together larger than all else
    first, *others = (p.white for p in calibration.projectors)
    brightest = largest(first)
    for white in others:
        np.maximum(brightest, largest(white), out=brightest)
    mask = calibration.object_mask & (brightest > 0)
    if kind == "minimum":
        light = _where_lit(first)
        for white in others:
            np.minimum(light, _where_lit(white), out=light)
        light[~np.isfinite(light)] = 0
        light[~mask] = 0
        return np.asarray(light + calibration.black, np.float32)
    whole = first[mask]
    for white in others:
        whole += white[mask]
    whole += calibration.black[mask]
    reach = whole.min(axis=1)
    level = HEADROOM * float(np.quantile(reach, 0.05)) if reach.size else 0.0
    return np.where(mask[..., None], np.maximum(calibration.black, np.float32(level)), calibration.black)


def _where_lit(white: FloatImage) -> FloatImage:
    """A white image, infinite where the projector hardly shines."""
    faint = np.float32(1e-3) * white.max(initial=0)
    return np.where(white.max(axis=2, keepdims=True) > faint, white, np.float32(np.inf))


def solve_base(
    transport: LightTransport,
    image: FloatImage,
    black: FloatImage,
    settings: SolveSettings = DEFAULT_SETTINGS,
    context: SolveContext = ALONE,
) -> Base:
    """Solve the frames of a base ``image`` (``base_image``) and prepare to scale them; errors as ``solve_bounded``."""
    return prepare_base(transport, image, black, solve_bounded(transport, image, black, settings, context))


def prepare_base(transport: LightTransport, image: FloatImage, black: FloatImage, solution: Solution) -> Base:
    """A Base from frames that were solved before for ``image``."""
    light = planes_above(image, black)
    mask = transport.object_mask
    faint = FAINTEST_BASE * light[:, mask].mean() if mask.any() else 0.0
    present = mask & (light > max(faint, np.finfo(np.float32).tiny))
    # made again after the means: both together would be the peak of the whole solve
    del light
    coverage = transport.gaussian_mean_planes(present.astype(np.float32))
    np.divide(1, coverage, out=coverage, where=coverage > 0)
    inverse = planes_above(image, black)
    np.divide(1, inverse, out=inverse, where=present)
    inverse[~present] = 0
    mixed = np.empty_like(coverage)
    for n, M in enumerate(transport.mixing):
        mixed[:, transport.span(n)] = M @ frame_planes([solution.frames[n]])
    return Base(image, solution, inverse, coverage, mixed)


def scale_frames(
    transport: LightTransport, base: Base, target: FloatImage, black: FloatImage, *, engine: Engine | None = None
) -> list[FloatImage]:
    """P_t = P_b x P_s (paper eqs 4-6): frames (rows, columns, 3) in [0, 1] for a target radiance (rows, columns, 3).

    Exact where C_t / C_b has no detail finer than one projector's pixels (paper 3.3).
    Raises UsageError("image-wrong-size", "target-not-finite").
    """
    check_target(transport.camera_shape, target)
    light = planes_above(target, black)
    out = (engine or Processor()).scaled(transport, light, base.inverse, base.mixed, base.coverage)
    return plane_frames(out, transport.sizes)


def traditional_compensation(calibration: Calibration, target: FloatImage, n: int) -> list[FloatImage]:
    """Frames that make ``target`` with projector ``n`` alone; the other projectors are black.

    p = M^-1 ((C_t - K) / W_n), read bilinearly at the camera pixel each metapixel's centre falls on, clipped to [0, 1].
    ``target`` (rows, columns, 3): linear radiance, finite.

    Raises UsageError("projector-unknown", "image-wrong-size", "target-not-finite").
    """
    if not 0 <= n < len(calibration.projectors):
        raise UsageError(
            "projector-unknown",
            what=f"Projector number {n + 1} does not exist.",
            remedy=f"Choose one from 1 to {len(calibration.projectors)}.",
        )
    check_image("target", target, calibration.black.shape)
    frames = [np.zeros((*p.metapixels.valid.shape, 3), np.float32) for p in calibration.projectors]
    projector = calibration.projectors[n]
    metapixels = projector.metapixels
    usable = metapixels.valid & channels.finite(metapixels.centre_px)
    centre = metapixels.centre_px[usable].astype(np.float64)
    wanted = np.maximum(target - calibration.black, 0)
    light = _sampled(wanted, centre)
    white = _sampled(projector.white, centre)
    # Without light of the projector a division is impossible: use full brightness.
    ratio = np.divide(
        light, white, out=(light > 0).astype(np.float64), where=white > 1e-6 * projector.white.max(initial=0)
    )
    unmixed = ratio @ np.linalg.inv(projector.radiometry.mixing).T
    frames[n][usable] = np.clip(unmixed, 0, 1)
    return frames


def exposed_for_one(
    calibration: Calibration, picture: FloatImage, n: int, *, share: float, indirect: ReflectedLight | None = None
) -> ExposedTarget:
    """``picture`` (rows, columns, 3), like reflectance, as bright as projector ``n`` can make it alone.

    By the same rule as for all projectors: ``share`` of the pixels that it lights are in reach. At a higher exposure
    the comparison would only show that one lamp is darker than several. Raises what ``expose_target`` raises.
    """
    alone = build_transport(dataclasses.replace(calibration, projectors=(calibration.projectors[n],)))
    return expose_target(DriveLevels.of_transport(alone), picture, calibration.black, share=share, indirect=indirect)


def _sampled(
    image: FloatImage, centre: np.ndarray[tuple[int, ...], np.dtype[np.float64]]
) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    from scipy.ndimage import map_coordinates

    at = (centre[:, 1], centre[:, 0])
    return np.stack([map_coordinates(image[..., c], at, np.float64, order=1, mode="nearest") for c in range(3)], -1)
