"""Which light transport a calibration gets.

Where the phase map is known, each camera sample has its own shares (``windows``, docs/decisions/0006). Where only
metapixels are, the shares are their Gaussians (``gaussians``).
"""

from __future__ import annotations

import dataclasses

import numpy as np

from controller.core.errors import UsageError
from controller.optics.calibrate.values import Calibration, Metapixels
from controller.optics.transport.gaussians.patches import Patches
from controller.optics.transport.gaussians.transport import PatchTransport
from controller.optics.transport.indirect.beside_object import beside_object
from controller.optics.transport.operator import LightTransport
from controller.optics.transport.windows.transport import WindowTransport


def build_transport(calibration: Calibration, *, patches: Patches | None = None) -> LightTransport:
    """Build T from a calibration.

    Camera pixels outside ``object_mask``, or not lit by a projector, have no shares of it. Shares come from the
    phase maps where every projector has one, else from the metapixels; of these, those that are not valid, not
    finite, or larger than 255 camera pixels light nothing. ``patches`` take the place of both, for another model of
    a projector pixel (``custom_weights``).

    Raises UsageError("calibration-inconsistent") when sizes differ or an image is not finite.
    """
    check_calibration(calibration)
    if patches is None and all(part.phase_map is not None for part in calibration.projectors):
        made: LightTransport = WindowTransport.from_calibration(calibration)
    else:
        made = PatchTransport.from_calibration(calibration, patches)
    segments = tuple(part.radiometry.segment for part in calibration.projectors)
    made = dataclasses.replace(made, segments=segments if any(segments) else ())
    beside = beside_object(calibration)
    if beside is None:
        return made
    # A camera pixel that sees the room by any projector's light is none of the object's.
    return dataclasses.replace(made, lit=made.lit & ~beside.camera.any(axis=0), beside=beside.pixels)


def check_calibration(calibration: Calibration) -> None:
    """Raise UsageError("calibration-inconsistent") when sizes differ or an image is not finite."""
    shape = (*calibration.object_mask.shape, 3)
    problem = None
    if not calibration.projectors:
        problem = "it has no projector"
    elif calibration.black.shape != shape or not np.isfinite(calibration.black).all():
        problem = "its black image has another size than the camera's, or is not finite"
    for projector in calibration.projectors:
        white, metapixels = projector.white, projector.metapixels
        if white.shape != shape or not np.isfinite(white).all() or white.min(initial=0) < 0:
            problem = (
                f"the white image of {projector.name} has another size than the camera's, is not finite or negative"
            )
        elif not _consistent(metapixels):
            problem = f"the metapixels of {projector.name} differ in size"
        elif projector.phase_map is not None and not (
            projector.phase_map.projector_px.shape == (*shape[:2], 2)
            and projector.phase_map.spread_px2.shape == (*metapixels.valid.shape, 3)
        ):
            problem = f"the phase map of {projector.name} has another size than its pictures"
    if problem is not None:
        raise UsageError(
            "calibration-inconsistent",
            what=f"The calibration can't be used: {problem}.",
            remedy="Calibrate the stage again.",
        )


def _consistent(metapixels: Metapixels) -> bool:
    shape = metapixels.valid.shape
    return metapixels.centre_px.shape == (*shape, 2) and metapixels.covariance_px2.shape == (*shape, 3)
