"""Metapixels from dots, the paper's way: an elliptical Gaussian fitted to each projector pixel (paper 4.2.2, eq. 8).

A photograph of dots, less black and divided by the white image, shows each lit pixel's share of the light. The fits are
in ``gaussian_fit``; here is the rest: where metapixels are likely to be before any dot is fitted (by correspondences,
or by the 3D model), windows that keep clear of the next dots, and the initial estimate where a fit ends far from it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numba
import numpy as np
import numpy.typing as npt

from controller.core import channels
from controller.core.arrays import Float64, FloatImage, Mask
from controller.core.errors import CalibrationError
from controller.core.jit import compiled
from controller.optics.calibrate.correspondence.captures import Captures, coloured
from controller.optics.calibrate.correspondence.phase_map import invert_map
from controller.optics.calibrate.geometry.normal_equations import bending
from controller.optics.calibrate.metapixels.from_phase import carry_covariance
from controller.optics.calibrate.metapixels.gaussian_fit import PARAMETERS, fit_gaussian
from controller.optics.calibrate.values import Correspondence, Geometry, Metapixels, Pinhole
from controller.optics.capture.patterns import PAPER_SPACING_PX, dot_patterns

PIXEL_SIGMA_PX: Final = 0.4
"""Of a projector pixel in focus, in projector pixels."""
CAMERA_SIGMA_PX: Final = 0.6
"""Of the camera's optics, its own pixel and its colour pattern, in camera pixels."""
SHADOW_DEPTH: Final = 0.01
"""A surface point this much farther from a projector, relatively, than another in the same pixel is in its shadow."""
GRAZING: Final = 0.1
"""Cosine between normal and projector below which its light carries no information."""


def initial_metapixels(correspondence: Correspondence, size_px: tuple[int, int]) -> Metapixels:
    """Centres from the inverse of the map, sizes from its slope and an assumed blur.

    ``size_px`` (width, height) of the projector.
    """
    inverse = invert_map(correspondence, size_px)
    round_px2 = np.array([1, 0, 1], np.float32)
    blur = np.broadcast_to(np.float32(PIXEL_SIGMA_PX**2) * round_px2, (*inverse.valid.shape, 3))
    covariance = carry_covariance(inverse.jacobian, blur) + np.float32(CAMERA_SIGMA_PX**2) * round_px2
    return Metapixels(inverse.centre_px, covariance, inverse.valid)


def where_missing(metapixels: Metapixels, other: Metapixels) -> Metapixels:
    """``metapixels``, and those of ``other`` where they are not valid."""
    take = (~metapixels.valid & other.valid)[..., None]
    return Metapixels(
        np.where(take, other.centre_px, metapixels.centre_px),
        np.where(take, other.covariance_px2, metapixels.covariance_px2),
        metapixels.valid | other.valid,
    )


def modelled_correspondence(geometry: Geometry, n: int) -> Correspondence:
    """Where each camera pixel's point lies in projector ``n``'s image, by the reconstructed object and pose.

    Points that face away from the projector or lie in its shadow are not valid. ``modulation`` is 1 where valid.
    """
    projector = geometry.projectors[n]
    points = geometry.points_m.astype(np.float64)
    px, depth = project(projector, points)
    ray = points - (-projector.rotation.T @ projector.translation_m)
    with np.errstate(invalid="ignore", divide="ignore"):
        facing = -channels.total(geometry.normals * ray) / channels.length(ray) > GRAZING
        width, height = projector.size_px
        inside = channels.every(px > -0.5) & (px[..., 0] < width - 0.5) & (px[..., 1] < height - 0.5) & (depth > 0)
    valid = inside & facing
    valid &= ~_in_shadow(px, depth, valid, projector.size_px)
    position: FloatImage = np.where(valid[..., None], px, np.nan).astype(np.float32)
    return Correspondence(position, valid.astype(np.float32), valid)


def project(pinhole: Pinhole, points_m: Float64) -> tuple[Float64, Float64]:
    """(..., 2) image position and (...) depth of (..., 3) world points; NaN points give NaN."""
    local = points_m @ pinhole.rotation.T + pinhole.translation_m
    depth = local[..., 2]
    with np.errstate(invalid="ignore", divide="ignore"):
        xy = local[..., :2] / depth[..., None]
    xy = np.stack(bending(xy[..., 0], xy[..., 1], *pinhole.distortion)[:2], axis=-1)
    return xy @ pinhole.matrix[:2, :2].T + pinhole.matrix[:2, 2], depth


def _in_shadow(px: FloatImage | Float64, depth: Float64, valid: Mask, size_px: tuple[int, int]) -> Mask:
    width, height = size_px
    at = np.where(valid[..., None], np.round(px), 0).astype(np.int64)
    cell = np.clip(at[..., 1], 0, height - 1) * width + np.clip(at[..., 0], 0, width - 1)
    nearest = np.full(width * height, np.inf)
    np.minimum.at(nearest, cell[valid], depth[valid])
    return np.asarray(depth > nearest[cell] * (1 + SHADOW_DEPTH))


WIDEST_CUT: Final = 3.25
"""A window ends at this Mahalanobis distance from the initial estimate, or half way to the next dot."""
NARROWEST_CUT: Final = 1.5
"""Dots whose light overlaps further than this can't be separated."""
REFIT_PX: Final = 0.5
REFIT_SIZE: Final = 1.15
"""A fit that moved or grew by more than this is repeated once, in the window where it ended."""

_UNTRIED, _FITTED, _FAILED = 0, 1, 2


@dataclass(frozen=True, slots=True)
class DotReport:
    """How many pixels were ``fitted``, ``failed`` (diverged, or no light; their initial estimate was kept) or had none.

    ``residual``: median over the fitted of the rms difference over the rms of the dot, 0 for a perfect Gaussian
    """

    fitted: int
    failed: int
    without_guess: int
    residual: float


def fit_dots(
    captures: Captures,
    white: FloatImage,
    initial: Metapixels,
    r: int = PAPER_SPACING_PX,
    *,
    fallback: Metapixels | None = None,
    progress: Callable[[float], None] | None = None,
) -> tuple[Metapixels, DotReport]:
    """One projector's metapixels from photographs of its dots.

    Parameters
    ----------
    captures : ``black`` and every ``dot-*`` of ``dot_patterns(size, r)``, linear, in one unit, NaN where saturated;
        each is asked for once
    white : (camera rows, columns, 3) the projector alone at white, less black, in the same unit; or (rows, columns)
        where the photographs are grey
    initial : where the fits start; see ``controller.optics.calibrate.metapixels.from_dots``
    r : the dots' spacing in projector pixels
    fallback : used where a fit fails and it is valid: the 3D model's estimate (paper 4.2.2); else ``initial`` is used
    progress : called with the share of the pictures that are done

    Returns
    -------
    metapixels, valid where ``initial`` was, and how many were fitted

    Raises CalibrationError("capture-missing") or CalibrationError("capture-shape-wrong").
    """
    rows, columns = initial.valid.shape
    light = _stacked(white)
    black = _like(light, coloured(captures, "black", light.shape[:2]), "black")
    centre, covariance = initial.centre_px.copy(), initial.covariance_px2.copy()
    status = np.full((rows, columns), _UNTRIED, np.uint8)
    residual = np.full((rows, columns), np.nan, np.float32)
    patterns = dot_patterns((columns, rows), r)
    for number, pattern in enumerate(patterns):
        image = _like(light, coloured(captures, pattern.name, light.shape[:2]), pattern.name)
        fit_picture(
            image, black, light, initial.centre_px, initial.covariance_px2, initial.valid,
            (pattern.row, pattern.column, r), centre, covariance, status, residual,
        )  # fmt: skip
        if progress is not None:
            progress((number + 1) / len(patterns))
    fitted = status == _FITTED
    if fallback is not None:
        instead = (status == _FAILED) & fallback.valid
        centre[instead], covariance[instead] = fallback.centre_px[instead], fallback.covariance_px2[instead]
    report = DotReport(
        fitted=int(fitted.sum()),
        failed=int((status == _FAILED).sum()),
        without_guess=int((status == _UNTRIED).sum()),
        residual=float(np.median(residual[fitted])) if fitted.any() else float("nan"),
    )
    return Metapixels(centre, covariance, initial.valid.copy()), report


def blur_px2(metapixels: Metapixels) -> FloatImage:
    """(rows, columns, 3) xx, xy, yy: each metapixel's covariance in projector pixels squared, the camera's blur in it.

    NaN at pixels that lack a neighbour in a row or column, of which the local scale would be taken.
    """
    centre = np.where(metapixels.valid[..., None], metapixels.centre_px, np.nan)
    a, c = np.moveaxis(np.gradient(centre, axis=1), -1, 0)
    b, d = np.moveaxis(np.gradient(centre, axis=0), -1, 0)
    with np.errstate(invalid="ignore", divide="ignore"):
        scale = 1 / (a * d - b * c)
        inverse = np.stack([d, -b, -c, a], axis=-1) * scale[..., None]
        return carry_covariance(inverse, np.where(metapixels.valid[..., None], metapixels.covariance_px2, np.nan))


def largest_sigma_px(metapixels: Metapixels, share: float = 0.95) -> float:
    """The blur that dots must keep clear of: the long axis, in projector pixels, that most metapixels stay below.

    ``share`` of the metapixels that do. NaN where there is no metapixel.
    """
    xx, xy, yy = np.moveaxis(blur_px2(metapixels).astype(np.float64), -1, 0)
    long = np.sqrt((xx + yy) / 2 + np.hypot((xx - yy) / 2, xy))
    long = long[np.isfinite(long)]
    return float(np.quantile(long, share)) if long.size else float("nan")


def peak_share(metapixels: Metapixels) -> float:
    """Share of the white light at a dot's centre that only one metapixel in fifty exceeds; at most 1.

    With all pixels at white, a camera pixel's light is the sum of Gaussians one projector pixel apart.
    """
    xx, xy, yy = np.moveaxis(blur_px2(metapixels).astype(np.float64), -1, 0)
    with np.errstate(invalid="ignore", divide="ignore"):
        peak = 1 / (2 * np.pi * np.sqrt(xx * yy - xy * xy))
    peak = peak[np.isfinite(peak)]
    return float(min(np.quantile(peak, 0.98), 1.0)) if peak.size else 1.0


def _stacked(image: FloatImage) -> FloatImage:
    image = np.ascontiguousarray(image, np.float32)
    return image if image.ndim == 3 else image[:, :, None]


def _like(white: FloatImage, image: FloatImage, name: str) -> FloatImage:
    image = _stacked(image)
    if image.shape != white.shape:
        raise CalibrationError(
            "capture-shape-wrong",
            what=f"The photograph of {name} has the shape {image.shape}, the white image {white.shape}.",
            remedy="Use colour for both or grey for both, and do not change the camera's picture size.",
        )
    return image


@compiled(parallel=True)
def fit_picture(
    image: FloatImage,
    black: FloatImage,
    white: FloatImage,
    start_px: FloatImage,
    start_px2: FloatImage,
    tried: Mask,
    lit: tuple[int, int, int],
    centre: FloatImage,
    covariance: FloatImage,
    status: npt.NDArray[np.uint8],
    residual: FloatImage,
) -> None:
    """Fit the dots of one photograph; ``lit`` is the row and column of the first and the spacing.

    ``centre``, ``covariance``, ``status`` and ``residual`` are written for the pixels that were lit, the first two only
    where the fit held.
    """
    rows, columns = tried.shape
    first_row, first_column, r = lit
    down, across = (rows - first_row + r - 1) // r, (columns - first_column + r - 1) // r
    for i in numba.prange(down * across):
        row, column = first_row + i // across * r, first_column + i % across * r
        if not tried[row, column]:
            continue
        status[row, column] = _FAILED
        cut = _clear_of_others(start_px, start_px2, tried, row, column, r)
        if cut < NARROWEST_CUT:
            continue
        fit = np.empty(PARAMETERS)
        at, size = start_px[row, column], start_px2[row, column]
        quality = fit_gaussian(image, black, white, at, size, at, size, cut, fit)
        if quality >= 0 and _changed(at, size, fit):
            near = np.array([fit[0], fit[1]], np.float32)
            fitted_px2 = np.array([fit[2], fit[3], fit[4]], np.float32)
            quality = fit_gaussian(image, black, white, at, size, near, fitted_px2, cut, fit)
        if quality >= 0:
            status[row, column] = _FITTED
            centre[row, column, 0], centre[row, column, 1] = fit[0], fit[1]
            for k in range(3):
                covariance[row, column, k] = fit[2 + k]
            residual[row, column] = quality


@compiled()
def _clear_of_others(centre: FloatImage, covariance: FloatImage, valid: Mask, row: int, column: int, r: int) -> float:
    """Half the Mahalanobis distance to the nearest dot of the same picture, at most the widest cut."""
    xx, xy, yy = covariance[row, column, 0], covariance[row, column, 1], covariance[row, column, 2]
    determinant = xx * yy - xy * xy
    if not (xx > 0 and yy > 0 and determinant > 0):
        return 0.0
    nearest = (2 * WIDEST_CUT) ** 2
    for down in range(-1, 2):
        for across in range(-1, 2):
            i, j = row + down * r, column + across * r
            if (i == row and j == column) or i < 0 or j < 0 or i >= valid.shape[0] or j >= valid.shape[1]:
                continue
            if valid[i, j]:
                dx, dy = centre[i, j, 0] - centre[row, column, 0], centre[i, j, 1] - centre[row, column, 1]
                nearest = min(nearest, (yy * dx * dx - 2 * xy * dx * dy + xx * dy * dy) / determinant)
    return float(0.5 * np.sqrt(nearest))


@compiled()
def _changed(at: FloatImage, size: FloatImage, fit: npt.NDArray[np.float64]) -> bool:
    moved = np.hypot(fit[0] - at[0], fit[1] - at[1]) > REFIT_PX
    wider = max(fit[2] / size[0], size[0] / fit[2])
    higher = max(fit[4] / size[2], size[2] / fit[4])
    return bool(moved or max(wider, higher) > REFIT_SIZE**2)
