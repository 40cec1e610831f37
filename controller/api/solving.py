"""Compensation images: the bounded solve, and base times scale."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from controller.config.defaults import SMOOTHNESS
from controller.core.arrays import ByteImage, FloatImage, Mask, as_light
from controller.optics.calibrate.values import Calibration, Radiometry
from controller.optics.solve import appearance
from controller.optics.solve.appearance import Base
from controller.optics.solve.bounded.equations import MOST_ITERATIONS, TOLERANCE, Solution, SolveSettings
from controller.optics.solve.bounded.solver import solve_bounded
from controller.optics.solve.reach.drive_levels import DriveLevels
from controller.optics.solve.reach.feasibility import expose_target, target_radiance
from controller.optics.solve.scaling.dither import to_device
from controller.optics.transport import LightTransport
from controller.optics.transport.indirect.indirect_light import IndirectLight


@dataclass(frozen=True, slots=True)
class ReachableTarget:
    """A target in the camera's unit of light.

    ``radiance`` (camera rows, columns, 3) float32: what the camera should see, black image included
    ``exposure``: light of a white pixel of the picture
    ``reachable`` (camera rows, columns) bool: on the object, and not too bright, too dark or too saturated
    ``share``: the part of the object's pixels that is reachable, 0 to 1
    ``direct`` like ``radiance``: what ``solve`` has to aim at, so that with its indirect light it becomes ``radiance``
    """

    radiance: FloatImage
    exposure: float
    reachable: Mask
    share: float
    direct: FloatImage


def reachable_target(
    transport: LightTransport,
    picture: npt.ArrayLike,
    black: npt.ArrayLike | None = None,
    *,
    share: float = 0.95,
    indirect: IndirectLight | None = None,
) -> ReachableTarget:
    """Make a picture as bright as the projectors can show it.

    Parameters
    ----------
    transport : of ``build_transport``, ``transport_from_matrices`` or ``read_run``
    picture : (camera rows, columns, 3) linear, at least 0; 1 is a white surface. As seen from the camera
    black : (camera rows, columns, 3) light with all projectors at black; without it 0
    share : above 0 and up to 1, the part of the object's pixels that must be reachable
    indirect : of ``indirect_light`` or ``read_run``: light by way of other surfaces

    Errors: ``image-wrong-size``, ``target-not-finite``, ``share-out-of-range``, ``no-light``.
    """
    wanted = as_light(picture)
    dark = _black(black, wanted)
    found = expose_target(DriveLevels.of_transport(transport), wanted, dark, share=share, indirect=indirect)
    radiance, direct = (target_radiance(image, dark, 1.0) for image in (found.wanted, found.needed))
    return ReachableTarget(radiance, found.exposure, found.possible.reachable, found.possible.share, direct)


def solve(
    transport: LightTransport,
    target: npt.ArrayLike,
    black: npt.ArrayLike | None = None,
    *,
    smoothness: float = SMOOTHNESS,
    weights: npt.ArrayLike | None = None,
    start: Sequence[npt.ArrayLike] | None = None,
    tolerance: float = TOLERANCE,
    most_iterations: int = MOST_ITERATIONS,
) -> Solution:
    """The projectors' pictures that make the camera see ``target`` (paper 2.2 to 2.4, eqs 2 and 3).

    Minimises  sum over camera pixels of the object of w |T p + K - C|^2  +  s sum over adjacent projector pixels of
    a^2 (p_i - p_j)^2   with 0 <= p <= 1.  K is ``black``, C ``target``, w ``weights``; a is small where the target has
    an edge; s is ``smoothness`` times the mean diagonal of the data's majoriser. Pixels of the object are those of
    ``transport.object_mask``; with ``transport_from_matrices`` those that some projector lights. The light wanted at
    other pixels counts for nothing, in ``objective`` neither.

    Parameters
    ----------
    transport : of ``build_transport``, ``transport_from_matrices`` or ``read_run``
    target : (camera rows, columns, 3) light, finite; counts as ``black`` where it is darker
    black : (camera rows, columns, 3) light with all projectors at black; without it 0
    smoothness : at least 0; 0 is plain bounded least squares
    weights : (camera rows, columns), at least 0, how much each camera pixel counts; without it 1
    start : frames to start from, (rows, columns, 3) each
    tolerance : stops when the rms projected gradient step, in units of projector light, is below it
    most_iterations : and at the latest after so many sweeps

    Returns
    -------
    ``Solution``: ``frames``, one (rows, columns, 3) float32 linear image a projector, 0 to 1, whose light is
    ``transport.forward(frames)``; ``objective``, ``kkt``, ``iterations``, ``seconds``, ``converged``

    Errors: ``image-wrong-size``, ``target-not-finite``, ``solve-arguments``.
    """
    wanted = as_light(target)
    return solve_bounded(
        transport,
        wanted,
        _black(black, wanted),
        SolveSettings(
            smoothness,
            None if weights is None else as_light(weights),
            None if start is None else [as_light(one) for one in start],
            tolerance,
            most_iterations,
        ),
    )


def base_image(calibration: Calibration, kind: Literal["white", "minimum"] = "white") -> FloatImage:
    """A base image C_b, from which other targets are scaled (paper 3.1, 5).

    Parameters
    ----------
    calibration : of ``calibrate`` or ``read_run``
    kind : ``white``: even light on the whole object. ``minimum``: at each pixel the darkest white image of the
        projectors that light it, which keeps the object's own pattern and drops highlights

    Returns
    -------
    (camera rows, columns, 3) float32 light, black image included
    """
    return appearance.base_image(calibration, kind)


def solve_base(
    transport: LightTransport,
    image: npt.ArrayLike,
    black: npt.ArrayLike | None = None,
    *,
    smoothness: float = SMOOTHNESS,
    tolerance: float = TOLERANCE,
) -> Base:
    """Solve a base image once, so that ``scale`` can make many targets from it quickly.

    Parameters
    ----------
    image : (camera rows, columns, 3) light, for example of ``base_image``
    transport, black, smoothness, tolerance : as ``solve``

    Returns
    -------
    ``Base``: ``image``, and ``solution`` with the base's own frames

    Errors: as ``solve``.
    """
    wanted = as_light(image)
    dark = _black(black, wanted)
    return appearance.solve_base(transport, wanted, dark, SolveSettings(smoothness, tolerance=tolerance))


def scale(
    transport: LightTransport, base: Base, target: npt.ArrayLike, black: npt.ArrayLike | None = None
) -> list[FloatImage]:
    """Frames for a new target by base times scale, without a solve (paper 3, eqs 4 to 6).

    C_s = C_t / C_b for each camera pixel; the scale of a projector pixel is the mean of C_s over its metapixel; its new
    light is its light in the base times this scale. Exact where C_s has no detail finer than a projector pixel.

    Parameters
    ----------
    transport, black : those of ``solve_base``
    target : (camera rows, columns, 3) light, finite

    Returns
    -------
    one (rows, columns, 3) float32 linear image a projector, 0 to 1

    Errors: ``image-wrong-size``, ``target-not-finite``.
    """
    wanted = as_light(target)
    return appearance.scale_frames(transport, base, wanted, _black(black, wanted))


def encode(
    frame: npt.ArrayLike, radiometry: Radiometry, *, dither: Literal["diffusion", "blue-noise", "nearest"] = "diffusion"
) -> ByteImage:
    """Device values of a linear frame: through the inverse of the projector's response, with dithering.

    Parameters
    ----------
    frame : (rows, columns, 3) linear light, clipped to 0 to 1
    radiometry : of this projector; ``response`` (3, 256) is used
    dither : error diffusion (Floyd and Steinberg), a blue-noise mask, or the nearest value

    Returns
    -------
    (rows, columns, 3) uint8

    Errors: ``frame-shape-wrong``, ``response-not-rising``.
    """
    return to_device(as_light(frame), radiometry, method=dither)


def _black(black: npt.ArrayLike | None, like: FloatImage) -> FloatImage:
    return np.zeros_like(like) if black is None else as_light(black)
