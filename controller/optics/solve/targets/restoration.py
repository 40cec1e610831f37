"""A picture of how the object should look under even white light, on the object where it belongs."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final, Literal

import cv2
import numpy as np

from controller.core import channels
from controller.core.arrays import Float64, FloatImage, Mask
from controller.core.blur import masked_blur
from controller.core.colour import D65, reflectance_to_camera
from controller.core.errors import UsageError
from controller.optics.solve.targets.registration import Registration
from controller.optics.solve.targets.values import Target, through_camera
from controller.optics.solve.targets.wrap import ObjectSpace, for_painting, painted, sampled

LightName = Literal["d65", "d55", "d50", "a"]
LIGHTS: Final[dict[LightName, tuple[float, float]]] = {
    "d65": D65, "d55": (0.33243, 0.34744), "d50": (0.34567, 0.35851), "a": (0.44758, 0.40745),
}  # fmt: skip
"""CIE xy (2 degrees) of the white of each light."""
EVEN: Final = 0.01
"""Of white, as the eye sees it: so little the margin of a scan varies."""


@dataclass(frozen=True, slots=True)
class RestorationLook:
    """How a picture restores the object; the settings of stage.toml have the same names.

    ``light``: under which the object should look as in the picture, which shows it under D65
    ``brightness``: of that light, as a share of the light of all projectors at full white, above 0 to 1
    ``lux``: instead of it, with ``white_lux``: what a meter reads at the object with all projectors at full white.
        Without either, the picture is as bright as [solve] ``exposure_share`` allows
    ``outside``: what is around the picture, for example the frame and the wall, stays "dark", or "as-is" in that light
    ``margin``: whether an even margin at all four corners of the picture, as of a turned scan, is a part of it
    ``points``: see ``registration.Points``, in pixels of the file
    """

    light: LightName = "d65"
    brightness: float | None = None
    lux: float | None = None
    white_lux: float | None = None
    outside: Literal["dark", "as-is"] = "dark"
    margin: Literal["leave-out", "use"] = "leave-out"
    points: tuple[tuple[float, float, float, float], ...] = ()

    def share_of_white(self) -> float | None:
        """The light as a share of all projectors' white; None: as bright as possible. Raises
        UsageError("restoration-light").
        """
        if self.lux is None and self.white_lux is None:
            share = self.brightness
        elif self.lux is None or self.white_lux is None or self.brightness is not None or self.white_lux <= 0:
            raise _wrong_light("`lux` needs `white_lux`, and no `brightness`")
        else:
            share = self.lux / self.white_lux
        if share is not None and not 0 < share <= 1:
            raise _wrong_light(f"The projectors can't make {share:g} of their own white")
        return share


def _wrong_light(what: str) -> UsageError:
    return UsageError(
        "restoration-light",
        what=f"{what}.",
        remedy="Give `brightness` from 0 to 1, or `lux` and the `white_lux` that a meter reads at the object with all "
        "projectors at full white.",
    )


def without_margin(picture: FloatImage) -> FloatImage:
    """``picture`` (height, width, 3) linear, NaN where the colour of all four corners continues, a margin."""
    encoded = np.sqrt(np.clip(np.nan_to_num(picture), 0, 1))
    alike = channels.every(np.abs(encoded - encoded[0, 0]) < EVEN) & channels.finite(picture)
    corners = (0, 0, -1, -1), (0, -1, 0, -1)
    if not alike[corners].all():
        return picture
    _, parts = cv2.connectedComponents(alike.astype(np.uint8), connectivity=4)
    # an encoder blurs its edge
    margin = cv2.dilate(np.isin(parts, parts[corners]).astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    return picture if margin.all() else np.where(margin[..., None], np.float32(np.nan), picture)


def restored(
    picture: FloatImage, registration: Registration, own: FloatImage, mask: Mask, look: RestorationLook,
    camera_to_xyz: Float64,
) -> Target:  # fmt: skip
    """The target of a ``picture`` (height, width, 3), linear sRGB of reflectance, NaN where it says nothing.

    ``own`` (rows, columns, 3): the object's reflectance in the camera's colours, which stays where the picture is not
    matched; ``mask`` (rows, columns): the object's pixels
    """
    matched = mask & registration.matched
    asked = through_camera(_laid_on(picture, registration.position_px, matched))
    to_camera = reflectance_to_camera(LIGHTS[look.light], camera_to_xyz)
    image = np.maximum(asked.image @ to_camera.T.astype(np.float32), 0)
    as_is = mask & ~matched & channels.finite(own)
    if look.outside == "dark":
        as_is &= registration.inside
    # its own reflectance is that in the camera's white, and only the light's colour changes it
    image[as_is] = np.maximum(own[as_is], 0) * to_camera.sum(axis=1).astype(np.float32)
    return replace(asked, image=image, mask=matched | as_is)


def _laid_on(picture: FloatImage, position_px: FloatImage, matched: Mask) -> Target:
    height, width = picture.shape[:2]
    known = channels.finite(picture)
    if not known.all():
        # what is shown next to its edge is the picture's own
        picture = np.where(known[..., None], picture, 0)
        picture = np.where(known[..., None], picture, np.nan_to_num(masked_blur(picture, known, 1.0)))
    steps = np.hypot(*np.moveaxis(np.diff(position_px, axis=1), 2, 0))[matched[:, 1:] & matched[:, :-1]]
    small = for_painting(np.asarray(picture, np.float32), max(float(np.median(steps)) if steps.size else 1.0, 1e-6))
    scale = np.array([small.shape[1] / width, small.shape[0] / height])
    at = np.where(matched[..., None], (position_px + 0.5) * scale - 0.5, 0).astype(np.float32)
    space = ObjectSpace(at[..., 0], at[..., 1], matched, float("inf"))
    return painted(space, lambda across, down: sampled(small, across, down))
