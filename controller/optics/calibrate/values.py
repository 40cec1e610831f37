"""What a calibration consists of. Pixel coordinates are (x, y) = (column, row), pixel centres at whole numbers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from controller.core.arrays import Float64, FloatImage, Mask
from controller.core.channels import own_light


@dataclass(frozen=True, slots=True)
class Correspondence:
    """Where each camera pixel looks on one projector's image plane.

    ``projector_px`` (rows, columns, 2) float32: x and y in projector pixels, NaN where not valid
    ``modulation`` (rows, columns) float32: contrast of the finest pattern, 0..1, lowered by blur
    ``valid`` (rows, columns) bool
    ``as_seen_px`` like ``projector_px``: mean position of the light that the camera pixel gets, neither smoothed nor
    freed of the pull towards paler paint; None where it was not kept
    """

    projector_px: FloatImage
    modulation: FloatImage
    valid: Mask
    as_seen_px: FloatImage | None = None


@dataclass(frozen=True, slots=True)
class Metapixels:
    """One projector's pixels as they appear in the camera: elliptical Gaussians (paper 4.2.2, eq. 8).

    Shapes are those of the projector's image, (rows, columns, ...).

    ``centre_px`` (..., 2) float32: camera x and y, NaN where not valid
    ``covariance_px2`` (..., 3) float32: the covariance's xx, xy, yy in camera pixels squared
    ``valid`` (...) bool: the camera sees the pixel and trusts it
    """

    centre_px: FloatImage
    covariance_px2: FloatImage
    valid: Mask


@dataclass(frozen=True, slots=True)
class PhaseMap:
    """Where each camera pixel looks on a projector's image, and how far the projector's pixels spread there.

    From it the transport makes the shares of each camera pixel's light (docs/decisions/0006).

    ``projector_px`` (camera rows, columns, 2) float32: x and y in projector pixels, NaN where unknown
    ``spread_px2`` (projector rows, columns, 3) float32: covariance xx, xy, yy of the light of a pixel in projector
    pixels squared, as a single camera sample sees it, NaN where unknown
    ``colours_px`` (3, 2) float64: how far the projector's red, green and blue lie to the right of these places, and
    below them; None where they lie on each other
    """

    projector_px: FloatImage
    spread_px2: FloatImage
    colours_px: Float64 | None = None


@dataclass(frozen=True, slots=True)
class Radiometry:
    """How one projector turns device values into light.

    ``response`` (3, 256) float64: linear light of each 8-bit value per channel, 0 at black, 1 at white, rising
    ``mixing`` (3, 3) float64: camera channel (row) by projector channel (column), each row summing to 1, so that
    white is white; the strength of the light is in the projector's white image
    ``segment``: share of white that a white segment makes, of what red, green and blue have in common; 0 without one
    ``paint`` (3, 3, 3) float64: mixing that depends on the paint (``photometry.tile_fit``): camera channel,
        projector channel, camera channel of white; its sum over projector channels is 1 where both camera channels
        are the same, and else 0. None where one mixing holds for all paints
    """

    response: Float64
    mixing: Float64
    segment: float = 0.0
    paint: Float64 | None = None

    def emitted(self, light: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """What is shown, (..., 3), of the channels' own light (..., 3): with what a white segment adds to greys."""
        if not self.segment:
            return light
        common = light.min(axis=-1, keepdims=True)
        return np.asarray(light + light.dtype.type(self.segment) * (common - light))

    def channels(self, shown: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """The inverse: the channels' own light for what is to be shown; above 1 where a colour is too saturated."""
        return own_light(shown, self.segment)


@dataclass(frozen=True, slots=True)
class SurfaceSpread:
    """Light that enters a surface and leaves it beside (``calibrate.photometry.surface_spread``).

    ``share`` of the light that falls on it, 0 to 1; it diffuses by the distance d, ``camera_px`` or ``projector_px``
    """

    share: float
    camera_px: float
    projector_px: float


@dataclass(frozen=True, slots=True)
class ProjectorCalibration:
    """All that the transport needs of one projector.

    ``white`` (camera rows, columns, 3) float32: HDR image of this projector alone at white, less the black image;
    linear camera units, >= 0, 0 where the projector does not reach
    ``phase_map``: None where metapixels are all that is known
    ``indirect`` like ``white``: what reached the camera by way of other surfaces, and is not in ``white``; None where
    there is none to speak of
    ``stripes`` (patterns, blocks, 3): of ``transport.indirect.stripes.dark_light``; None where not measured
    ``spread``: of light under the surface; None where none was seen
    """

    name: str
    metapixels: Metapixels
    radiometry: Radiometry
    white: FloatImage
    phase_map: PhaseMap | None = None
    indirect: FloatImage | None = None
    stripes: FloatImage | None = None
    spread: SurfaceSpread | None = None


@dataclass(frozen=True, slots=True)
class Pinhole:
    """A camera or projector: x_px ~ K [R | t] X, with OpenCV's distortion in normalised coordinates.

    ``matrix`` (3, 3) K; ``distortion`` (4,) k1, k2, p1, p2, or the first two of them; ``rotation`` (3, 3);
    ``translation_m`` (3,)
    """

    matrix: Float64
    distortion: Float64
    rotation: Float64
    translation_m: Float64
    size_px: tuple[int, int]
    """(width, height)"""

    def __post_init__(self) -> None:
        terms = np.append(self.distortion, np.zeros(max(4 - len(self.distortion), 0)))
        object.__setattr__(self, "distortion", terms)

    def rays(self, px: Float64) -> Float64:
        """(points, 2) x, y at depth 1 of what (points, 2) of the picture see."""
        import cv2

        until = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-12)
        points, same = np.ascontiguousarray(px).reshape(-1, 1, 2), np.eye(3)
        found = cv2.undistortPointsIter(points, self.matrix, self.distortion, same, same, until)
        return np.asarray(found, np.float64).reshape(-1, 2)

    def straightened(self, px: Float64) -> Float64:
        """Where (points, 2) of the picture lie in one without distortion."""
        return self.rays(px) @ self.matrix[:2, :2].T + self.matrix[:2, 2]


@dataclass(frozen=True, slots=True)
class Geometry:
    """The self-calibrated stage; the camera is the origin.

    ``points_m`` (rows, columns, 3) float32: object position at each camera pixel, NaN where unknown
    ``normals`` (rows, columns, 3) float32: outward unit normals, NaN where unknown
    """

    camera: Pinhole
    projectors: tuple[Pinhole, ...]
    points_m: FloatImage
    normals: FloatImage
    reprojection_rms_px: float
    scale_known: bool


@dataclass(frozen=True, slots=True)
class Calibration:
    """A whole stage as the solver needs it.

    ``black`` (rows, columns, 3) float32: all projectors at black, ambient light included (K)
    ``object_mask`` (rows, columns): camera pixels on the object that at least one projector lights
    ``camera_to_xyz`` (3, 3): linear camera RGB to CIE XYZ (D65), from the camera's own colour matrix
    ``camera_blur_px``: standard deviation in camera pixels of the camera's own blur, red, green and blue; 0: not known
    ``mosaic`` (2, 2): colour of the camera's samples at even and odd rows and columns, 0 red, 1 green, 2 blue, where
    pictures are interpolated from them as ``capture.raw`` does; None where each pixel has its own three colours
    """

    projectors: tuple[ProjectorCalibration, ...]
    black: FloatImage
    object_mask: Mask
    camera_to_xyz: npt.NDArray[np.float64]
    camera_blur_px: tuple[float, float, float] = (0.0, 0.0, 0.0)
    mosaic: npt.NDArray[np.int64] | None = None
