"""What the geometry starts from and what it gives."""

from __future__ import annotations

import math
from dataclasses import dataclass

from controller.core.arrays import Float64, FloatImage
from controller.core.errors import UsageError
from controller.optics.calibrate.geometry.metric_scale import MeasuredDistance
from controller.optics.calibrate.values import Geometry


@dataclass(frozen=True, slots=True)
class CameraPrior:
    """What is known of the camera before it has seen anything: EXIF or a ChArUco session, and a measuring tape.

    ``focal_length_rel_sigma``: 0.001 after a ChArUco session, 0.01-0.03 from EXIF.
    ``principal_point_px`` (x, y): the middle of the image if None; ``principal_point_sigma_px``: 0.5 % of the width if
    None. ``distortion_k1`` with its ``distortion_sigma``. ``distance_m``: from the front of the lens to the nearest
    visible point of the object. ``distances``: between points of the picture; they tell the scale better.
    ``size_px`` of the picture that the focal length belongs to, if that is known.
    """

    focal_length_px: float
    focal_length_rel_sigma: float = 0.01
    principal_point_px: tuple[float, float] | None = None
    principal_point_sigma_px: float | None = None
    distortion_sigma: float = 0.05
    distance_m: float | None = None
    distance_rel_sigma: float = 0.01
    distortion_k1: float = 0.0
    distances: tuple[MeasuredDistance, ...] = ()
    size_px: tuple[int, int] | None = None

    def __post_init__(self) -> None:
        """Raises UsageError("camera-prior-invalid")."""
        if not (math.isfinite(self.focal_length_px) and self.focal_length_px > 0 and self.focal_length_rel_sigma > 0):
            raise UsageError(
                "camera-prior-invalid",
                what=f"A camera focal length of {self.focal_length_px} px +- {self.focal_length_rel_sigma} is not "
                "possible.",
                remedy="Give focal_length_px and focal_length_rel_sigma above 0, from EXIF or a ChArUco session.",
            )
        if self.distance_m is not None and not (math.isfinite(self.distance_m) and self.distance_m > 0):
            raise UsageError(
                "camera-prior-invalid",
                what=f"A distance of {self.distance_m} m from camera to object is not possible.",
                remedy="Measure it in metres, or leave it out and work without a known scale.",
            )


@dataclass(frozen=True, slots=True)
class Reconstruction:
    """The geometry, and how far to trust it.

    ``covariance`` (4 + 10 N, 4 + 10 N) of ``parameter_names``, rotations in radians, centres in metres at a fixed scale
    ``noise_px`` estimated standard deviation of one projector coordinate
    ``shape_rel_sigma`` expected rms error of the points by wrong parameters, as a share of their distance, scale apart
    ``scale_rel_sigma`` by the measured distances; infinite where none was given
    ``sigma_m`` (rows, columns) float32: standard deviation of each point along the camera's ray, at a fixed scale; NaN
    where unknown
    ``stages_tried`` starting points that were adjusted as a whole; ``margin`` by which the best beat the next shape, in
    halved chi-square, infinite where all led to the same
    ``inlier_share`` of the sampled correspondences
    """

    geometry: Geometry
    covariance: Float64
    parameter_names: tuple[str, ...]
    noise_px: float
    shape_rel_sigma: float
    scale_rel_sigma: float
    stages_tried: int
    margin: float
    inlier_share: float
    sigma_m: FloatImage


def parameter_names(projectors: int) -> tuple[str, ...]:
    """Names of the covariance's rows, in order."""
    own = ("log_focal", "cx_px", "cy_px", "k1", "turn_x", "turn_y", "turn_z", "centre_x_m", "centre_y_m", "centre_z_m")
    camera = ("camera.log_focal", "camera.cx_px", "camera.cy_px", "camera.k1")
    return camera + tuple(f"projector{n}.{name}" for n in range(projectors) for name in own)
