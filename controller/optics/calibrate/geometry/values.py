"""What the geometry starts from and what it gives; metres from what a technician measures with a tape."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from controller.config.models import PoseTable
from controller.core import channels
from controller.core.arrays import Float64, FloatImage
from controller.core.errors import CalibrationError, UsageError
from controller.optics.calibrate.values import Geometry

NEAREST_SHARE: Final = 0.001
"""Of the known points; the very nearest point may be wrong."""
REACH_PX: Final = 3
"""How far from a given picture point a known point of the object may lie."""
MOST_SIGMAS: Final = 4.0


@dataclass(frozen=True, slots=True)
class MeasuredDistance:
    """Two points of the object in the camera's picture (x, y), how far apart they are, and how sure that is."""

    from_px: tuple[float, float]
    to_px: tuple[float, float]
    distance_m: float
    sigma_m: float = 0.001

    def __post_init__(self) -> None:
        """Raises UsageError("distance-invalid")."""
        if not (0 < self.distance_m < math.inf and 0 < self.sigma_m < math.inf):
            raise UsageError(
                "distance-invalid",
                what=f"A distance of {self.distance_m} m +- {self.sigma_m} m between two points is not possible.",
                remedy="Measure it in metres, and give distance_m and sigma_m above 0.",
            )


def nearest_distance(points: FloatImage) -> float:
    """Distance from the camera to the nearest point of (rows, columns, 3), but for the nearest thousandth of them."""
    distance = channels.length(points[np.isfinite(points[..., 2])])
    return float(np.quantile(distance, NEAREST_SHARE))


def metres_per_unit(
    points: FloatImage, distance_m: float | None, distance_rel_sigma: float, between: Sequence[MeasuredDistance]
) -> tuple[float, float]:
    """Metres in one unit of ``points`` (rows, columns, 3), and its relative standard deviation.

    ``distance_m`` is from the camera to the nearest visible point of the object. All that was measured counts by
    its certainty; with nothing measured, the nearest point is put at 1 m, with an infinite deviation.

    Raises
    ------
    CalibrationError  "distance-point-unknown" (a point of the picture where the object is not known),
        "distances-contradict" (no scale fits all that was measured)
    """
    nearest = nearest_distance(points)
    logs, sigmas, names = [], [], []
    if distance_m is not None:
        logs.append(math.log(distance_m / nearest))
        sigmas.append(distance_rel_sigma)
        names.append("distance_m of the camera")
    for own in between:
        apart = float(np.linalg.norm(_point_at(points, own.from_px) - _point_at(points, own.to_px)))
        if not apart > 1e-4 * nearest:
            raise _unknown(own.to_px, "is the same as the other end of its distance")
        logs.append(math.log(own.distance_m / apart))
        sigmas.append(own.sigma_m / own.distance_m)
        names.append(f"the {own.distance_m:g} m from {own.from_px} to {own.to_px}")
    if not logs:
        return 1.0 / nearest, math.inf
    weights = 1.0 / np.square(sigmas)
    mean = float(np.sum(weights * logs) / np.sum(weights))
    off = np.abs(np.asarray(logs) - mean) / np.hypot(sigmas, 0.002)
    worst = int(np.argmax(off))
    if off[worst] > MOST_SIGMAS:
        raise CalibrationError(
            "distances-contradict",
            what=f"The measured distances contradict each other: {names[worst]} is off by "
            f"{100 * abs(math.expm1(logs[worst] - mean)):.1f} %.",
            remedy="Measure again: distance_m from the front of the lens to the nearest visible point, the others "
            "between the points in stage.toml.",
        )
    return math.exp(mean), float(np.sum(weights) ** -0.5)


def _point_at(points: FloatImage, px: tuple[float, float]) -> FloatImage:
    """The median of the known points next to a point of the picture."""
    rows, columns = points.shape[:2]
    x, y = round(px[0]), round(px[1])
    if not (0 <= x < columns and 0 <= y < rows):
        raise _unknown(px, f"is not in the camera's picture of {columns} x {rows} pixels")
    for reach in range(1, REACH_PX + 1):
        patch = points[max(0, y - reach) : y + reach + 1, max(0, x - reach) : x + reach + 1].reshape(-1, 3)
        known = patch[np.isfinite(patch[:, 2])]
        if len(known):
            return np.asarray(np.median(known, axis=0))
    raise _unknown(px, "shows no known point of the object")


def _unknown(px: tuple[float, float], problem: str) -> CalibrationError:
    return CalibrationError(
        "distance-point-unknown",
        what=f"A distance was measured to the picture point {px}, which {problem}.",
        remedy="Choose points on the object that the projectors light and the camera sees, away from edges.",
    )


@dataclass(frozen=True, slots=True)
class CameraPrior:
    """What is known of the camera before it has seen anything: EXIF or a ChArUco session, and a measuring tape.

    ``focal_length_rel_sigma``: 0.001 after a ChArUco session, 0.01-0.03 from EXIF.
    ``principal_point_px`` (x, y): the middle of the image if None; ``principal_point_sigma_px``: 0.5 % of the width if
    None. ``distortion_k1`` with its ``distortion_sigma``. ``other_terms``: k2, p1, p2 and log fy/fx, which stay as they
    are; ``focal_length_px`` is then fx. ``distance_m``: from the front of the lens to the nearest visible point of the
    object. ``distances``: between points of the picture; they tell the scale better.
    ``size_px`` of the picture that the focal length belongs to, if that is known. ``pose``: of the camera in the room.
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
    other_terms: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0)
    pose: PoseTable | None = field(default=None, repr=False)

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


def camera_lens(prior: CameraPrior, size_px: tuple[int, int]) -> tuple[Float64, Float64]:
    """log f, cx, cy, k1 and the other terms of the camera, and how sure the first four are (4,)."""
    width, height = size_px
    x, y = prior.principal_point_px or ((width - 1) / 2, (height - 1) / 2)
    sigma = prior.principal_point_sigma_px or 0.005 * width
    lens = np.array([math.log(prior.focal_length_px), x, y, prior.distortion_k1, *prior.other_terms])
    return lens, np.array([prior.focal_length_rel_sigma, sigma, sigma, prior.distortion_sigma])


LENS_SIGMA: Final = 0.03
"""Of a projector's k1 about 0: lenses of 0.06 to either side within two."""


def projector_lenses(sizes_px: Sequence[tuple[int, int]]) -> tuple[Float64, Float64]:
    """log f, cx, cy, k1 (N, 4) of usual projectors with pictures of (width, height), and how far they differ (N, 4).

    Throw ratios of 0.9 to 3.5 within one sigma; no horizontal shift to speak of; any vertical one.
    """
    sizes = np.array(sizes_px, dtype=np.float64)
    zero = np.zeros(len(sizes))
    usual = np.stack([np.log(1.8 * sizes[:, 0]), (sizes[:, 0] - 1) / 2, 0.5 * sizes[:, 1], zero], axis=1)
    sigmas = np.stack([zero + 0.7, 0.02 * sizes[:, 0], 0.7 * sizes[:, 1], zero + LENS_SIGMA], axis=1)
    return usual, sigmas


@dataclass(frozen=True, slots=True)
class Reconstruction:
    """The geometry, and how far to trust it.

    ``covariance`` (4 + 10 N, 4 + 10 N) of ``parameter_names``, rotations in radians, centres in metres at a fixed scale
    ``noise_px`` estimated standard deviation of one projector coordinate
    ``shape_rel_sigma`` expected rms error of the points by wrong parameters, as a share of their distance, scale apart
    ``scale_rel_sigma`` by the measured distances; infinite where none was given
    ``sigma_m`` (rows, columns) float32: standard deviation of each point along the camera's ray, at a fixed scale; NaN
    where unknown
    ``margin`` by which the best starting point, adjusted as a whole, beat the next shape, in halved chi-square;
    infinite where all led to the same
    ``inlier_share`` of the sampled correspondences
    """

    geometry: Geometry
    covariance: Float64
    parameter_names: tuple[str, ...]
    noise_px: float
    shape_rel_sigma: float
    scale_rel_sigma: float
    margin: float
    inlier_share: float
    sigma_m: FloatImage


def parameter_names(projectors: int) -> tuple[str, ...]:
    """Names of the covariance's rows, in order."""
    own = ("log_focal", "cx_px", "cy_px", "k1", "turn_x", "turn_y", "turn_z", "centre_x_m", "centre_y_m", "centre_z_m")
    camera = ("camera.log_focal", "camera.cx_px", "camera.cy_px", "camera.k1")
    return camera + tuple(f"projector{n}.{name}" for n in range(projectors) for name in own)
