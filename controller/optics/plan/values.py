"""What a plan consists of.

The room: metres, right-handed, origin in the middle of the object's bounding box, x to the right and z away from the
audience, y down. Pixel coordinates as everywhere: (x, y) = (column, row), centres at whole numbers.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pydantic import Field

from controller.config.table import ConfigTable, Positive
from controller.core.arrays import Float64, Mask


@dataclass(frozen=True, slots=True)
class ProjectorModel:
    """What a data sheet says of a projector.

    ``size_px`` (width, height); ``lumens`` of a white picture; ``throw_ratio`` (shortest, longest): distance by picture
    width; ``lens_shift`` (right, up): how far the picture's middle lies from the optical axis, in picture widths and
    heights; ``pupil_m``: diameter of the lens' exit pupil, which sets the depth of focus (focal length by f-number);
    ``sharpest_px``: standard deviation of a pixel's blur in focus, in pixels
    """

    name: str
    size_px: tuple[int, int]
    lumens: float
    throw_ratio: tuple[float, float]
    lens_shift: tuple[float, float]
    pupil_m: float
    sharpest_px: float


@dataclass(frozen=True, slots=True)
class MountingPoint:
    """A place where a projector can stand: ``position_m`` (3,) of its lens."""

    name: str
    position_m: tuple[float, float, float]

    @classmethod
    def around_object(cls, name: str, right_degrees: float, above_degrees: float, distance_m: float) -> MountingPoint:
        """A place on a sphere of ``distance_m`` around the object, by degrees to the audience's right and above it."""
        azimuth, height = np.deg2rad(right_degrees), np.deg2rad(above_degrees)
        x, y, z = distance_m * np.array(
            [np.sin(azimuth) * np.cos(height), -np.sin(height), -np.cos(azimuth) * np.cos(height)]
        )
        return cls(name, (float(x), float(y), float(z)))


@dataclass(frozen=True, slots=True)
class Placement:
    """A projector at a place, turned, zoomed and focused: x_local = rotation (x_world - position_m).

    ``rotation`` (3, 3); ``focal_px``, ``centre_px``: its lens in pixels, pinhole; ``focus_m``: depth of best focus
    """

    model: ProjectorModel
    mounting_point: MountingPoint
    rotation: Float64
    focal_px: float
    centre_px: tuple[float, float]
    focus_m: float

    @property
    def position_m(self) -> Float64:
        """(3,) of the lens."""
        return np.asarray(self.mounting_point.position_m, np.float64)

    @property
    def throw_ratio(self) -> float:
        """Distance by picture width that it is zoomed to."""
        return self.focal_px / self.model.size_px[0]


@dataclass(frozen=True, slots=True)
class Surface:
    """Points on the object: ``points_m`` (N, 3), ``normals`` (N, 3) outward and unit, ``area_m2`` (N,) each stands for.

    ``area_m2`` is 0 where the audience never sees the point.
    """

    points_m: Float64
    normals: Float64
    area_m2: Float64


@dataclass(frozen=True, slots=True)
class Illumination:
    """What one projector does at each of N surface points.

    ``reached`` (N,) bool: in its picture, facing it, not in any shadow. Of the rest, zero or infinite:
    ``cosine`` (N,): of the angle between its light and the normal; 1 - cosine is lost by grazing
    ``lux`` (N,): of a white picture, before the surface's albedo
    ``blur_px`` (N,): standard deviation in projector pixels, focus included
    ``pixel_mm`` (N, 2): longer and shorter side of a projector pixel on the surface
    ``detail_mm`` (N,): full width at half maximum of a projected pixel along its longer side, blur included
    """

    reached: Mask
    cosine: Float64
    lux: Float64
    blur_px: Float64
    pixel_mm: Float64
    detail_mm: Float64

    def useful(self, steepest_degrees: float) -> Mask:
        """(N,) bool: reached, and no farther than ``steepest_degrees`` from the normal (``PlanGoal``)."""
        near: Mask = self.cosine >= np.cos(np.deg2rad(steepest_degrees))
        return self.reached & near


class PlanGoal(ConfigTable):
    """What the plan is for: [goal] of plan.toml.

    Light that meets the surface farther from the normal than ``steepest_degrees`` counts for nothing: metapixels are
    too long there to be of use, and small errors of shape move them far.
    """

    lux: Positive = Field(
        default=400.0, description="required light on the surface from all projectors, in lux, above 0"
    )
    detail_mm: Positive = Field(
        default=1.0, description="width of the smallest required detail in millimetres, above 0"
    )
    overlap: int = Field(
        default=2, ge=1, le=16, description="required number of projectors at each point, from 1 to 16"
    )
    steepest_degrees: float = Field(
        default=75.0,
        ge=10,
        le=89,
        description="the smallest angle between light and surface that counts, in degrees, 10 to 89",
    )
    fill: float = Field(
        default=0.9, gt=0, le=1, description="the share of a picture that the object should fill, above 0, at most 1"
    )
    body_m: float = Field(default=0.25, ge=0, le=10, description="a projector's radius in metres, 0 to 10")
    apart_m: float = Field(
        default=0.5, ge=0, le=100, description="the smallest distance between lenses in metres, 0 to 100"
    )
    points: int = Field(
        default=4000, ge=100, le=200_000, description="number of sample points on the surface, 100 to 200000"
    )
