"""Traditional compensation: one projector, a division at each pixel (Nayar 2003, Grossberg 2004).

Superimposed projectors are compared with it (paper 6). It ignores neighbours, other projectors and bounds.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from controller.core import channels
from controller.core.arrays import FloatImage
from controller.core.checks import check_image
from controller.core.errors import UsageError
from controller.optics.calibrate.values import Calibration
from controller.optics.solve.reach.exposure import ExposedTarget, expose_target
from controller.optics.transport import build_transport
from controller.optics.transport.indirect.indirect_light import IndirectLight


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
    calibration: Calibration, picture: FloatImage, n: int, *, share: float, indirect: IndirectLight | None = None
) -> ExposedTarget:
    """``picture`` (rows, columns, 3), like reflectance, as bright as projector ``n`` can make it alone.

    By the same rule as for all projectors: ``share`` of the pixels that it lights are in reach. At a higher exposure
    the comparison would only show that one lamp is darker than several. Raises what ``expose_target`` raises.
    """
    alone = build_transport(dataclasses.replace(calibration, projectors=(calibration.projectors[n],)))
    return expose_target(alone, picture, calibration.black, share=share, indirect=indirect)


def _sampled(
    image: FloatImage, centre: np.ndarray[tuple[int, ...], np.dtype[np.float64]]
) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    from scipy.ndimage import map_coordinates

    at = (centre[:, 1], centre[:, 0])
    return np.stack([map_coordinates(image[..., c], at, np.float64, order=1, mode="nearest") for c in range(3)], -1)
