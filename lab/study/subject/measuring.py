"""How near a photograph is to its target, and the solves that experiments share."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final

import cv2
import numpy as np
from scipy.sparse.linalg import LinearOperator, lsmr

from controller.core.arrays import ByteImage, Float64, FloatImage, Mask
from controller.core.colour import linear_to_srgb
from controller.optics.solve.result.metrics import (
    TITLES,
    PixelSet,
    by_pixels,
    compare,
    edges_of_both,
    sharpness,
)
from controller.optics.transport import LightTransport
from controller.optics.transport.planes import image_planes, plane_frames
from controller.stage.report.pictures import Crop, crop_around
from lab.study.output.drawing import LabelledPicture, detail, screen, strip
from lab.study.subject.likeness import structural_similarity
from lab.study.subject.subject import ReachableTarget, Subject
from lab.study.values import Cell, Criterion, Figure, ResultTable

REGION_PX = 16
"""The paper's regions (3.2)."""
LEAST_PIXELS = 32
"""A region counts where so many of its pixels are compared."""
NAIVE_ITERATIONS = 200


@dataclass(frozen=True, slots=True)
class Quality:
    """Of one photograph, over the pixels of a mask.

    ``delta_e`` median CIEDE2000 and ``delta_e_p95`` its 95th percentile; ``rmse`` of the target's white, linear light;
    ``ssim`` mean structural similarity of the pictures as a screen shows them (sRGB, 11 px Gaussian window);
    ``sharpness``: lambda of eq. 9; ``pixels``: CIEDE2000 by sets of pixels (``solve.judged``), whatever the mask
    """

    delta_e: float
    delta_e_p95: float
    rmse: float
    ssim: float
    sharpness: float
    pixels: Mapping[str, PixelSet] = field(default_factory=dict)


def quality(subject: Subject, achieved: FloatImage, wanted: ReachableTarget, mask: Mask | None = None) -> Quality:
    """Compare a photograph with its target where both can be compared."""
    mask = wanted.mask if mask is None else mask
    found = compare(achieved, wanted.radiance, subject.calibration.camera_to_xyz, wanted.white, mask)
    pictures = [
        np.where(mask[..., None], linear_to_srgb(image / np.float32(wanted.white)), 0)
        for image in (achieved, wanted.radiance)
    ]
    local = structural_similarity(*pictures)
    return Quality(
        found.delta_e00_median, found.delta_e00_p95, found.rmse, float(local[mask].mean()), found.sharpness_lambda,
        pixel_sets(subject, achieved, wanted),
    )  # fmt: skip


def pixel_sets(subject: Subject, achieved: FloatImage, wanted: ReachableTarget) -> dict[str, PixelSet]:
    """CIEDE2000 in reach, of all lit pixels and of the whole visible object, and what each leaves out."""
    return by_pixels(
        achieved, wanted.radiance, subject.calibration.camera_to_xyz, wanted.white,
        reachable=wanted.mask, valid=wanted.valid, lit=subject.mask,
    )  # fmt: skip


SET_COLUMNS: Final = (
    "in reach leaves out", "all lit pixels: CIEDE2000, 95 %", "all lit pixels leave out",
    "whole visible object: CIEDE2000, 95 %", "target",
)  # fmt: skip
"""Of every table of errors, after the figures in reach: so that nothing is hidden by what is left out."""


def set_cells(pixels: Mapping[str, PixelSet], wanted: ReachableTarget) -> tuple[str, ...]:
    """The cells of ``SET_COLUMNS``."""
    if not pixels:
        return ("",) * len(SET_COLUMNS)
    reach, lit, visible = (pixels[name] for name in TITLES)
    return (_left_out(reach), _both(lit), _left_out(lit), _both(visible), wanted.as_asked)


def _left_out(one: PixelSet) -> str:
    return f"{one.left_out_share:.1%}"


def _both(one: PixelSet) -> str:
    return "" if one.delta_e00_median is None else f"{one.delta_e00_median:.2f}, {one.delta_e00_p95:.1f}"


@dataclass(frozen=True, slots=True)
class Variant:
    """One of several ways to make the same target: how long its ``solve`` took, and its photograph."""

    name: str
    seconds: float
    photograph: FloatImage
    quality: Quality


def photograph_variants(
    subject: Subject, wanted: ReachableTarget, ways: Sequence[tuple[str, Callable[[], Sequence[FloatImage]]]]
) -> list[Variant]:
    """Make ``wanted`` in each way, given as its name and what finds all projectors' frames, and photograph each."""
    variants = []
    for number, (name, solve) in enumerate(ways):
        subject.advance(number / len(ways), name)
        began_s = time.perf_counter()
        frames = solve()
        seconds = time.perf_counter() - began_s
        picture = subject.light.photograph(f"{number}", frames, white=wanted.white)
        variants.append(Variant(name, seconds, picture, quality(subject, picture, wanted)))
    return variants


def better(asked: str, after: Quality, before: Quality, *, with_p95: bool = False) -> Criterion:
    """Whether CIEDE2000, RMSE and SSIM are all better after than before; ``with_p95``: also report 95th percentiles."""
    p95 = f" (95 %: {before.delta_e_p95:.1f} to {after.delta_e_p95:.1f})" if with_p95 else ""
    reached = (
        f"CIEDE2000 {before.delta_e:.2f} to {after.delta_e:.2f}{p95}, "
        f"RMSE {before.rmse:.4f} to {after.rmse:.4f}, SSIM {before.ssim:.3f} to {after.ssim:.3f}"
    )
    holds = {
        "CIEDE2000": after.delta_e < before.delta_e,
        "RMSE": after.rmse < before.rmse,
        "SSIM": after.ssim > before.ssim,
    }
    missed = [name for name, held in holds.items() if not held]
    return Criterion(asked, reached, not missed, f"{' and '.join(missed)} not better." if missed else "")


def quality_table(
    name: str, variants: Sequence[Variant], wanted: ReachableTarget, *, ways: str, seconds: str = "seconds"
) -> ResultTable:
    """A row for each way; ``ways`` and ``seconds``: what the first and the last column are called."""
    columns = (ways, "CIEDE2000 median", "95 %", "RMSE", "SSIM", "lambda", *SET_COLUMNS, seconds)
    rows: list[tuple[Cell, ...]] = []
    for variant in variants:
        q = variant.quality
        figures = (q.delta_e, q.delta_e_p95, q.rmse, q.ssim, q.sharpness)
        rows.append((variant.name, *figures, *set_cells(q.pixels, wanted), variant.seconds))
    return ResultTable(name, "Photographed errors in reach, and by sets of pixels", columns, tuple(rows))


def side_by_side(subject: Subject, wanted: ReachableTarget, variants: Sequence[Variant]) -> tuple[Figure, Figure]:
    """The target and each way's photograph: whole, and a detail of it."""
    whole = crop_around(subject.mask)
    crop = detail(subject.mask, centre=(0.4, 0.3), size_px=max(48, subject.mask.shape[1] // 8))
    matrix, white = subject.calibration.camera_to_xyz, wanted.white
    named = [("target", wanted.radiance), *((variant.name, variant.photograph) for variant in variants)]

    def pictures(cut: Crop) -> ByteImage:
        return strip([LabelledPicture(name, screen(image, matrix, white, cut)) for name, image in named], columns=3)

    return (
        Figure("photographs", "The target and a photograph of each.", pictures(whole)),
        Figure("crops", "The same, closer: camera pixels enlarged.", pictures(crop)),
    )


def region_means(values: FloatImage, mask: Mask, size_px: int = REGION_PX) -> FloatImage:
    """Mean of ``values`` (rows, columns) over the mask's pixels of each square region, NaN where too few are in it."""
    rows, columns = (-(-side // size_px) for side in mask.shape)
    y, x = np.nonzero(mask)
    region = (y // size_px) * columns + x // size_px
    count = np.bincount(region, minlength=rows * columns)
    total = np.bincount(region, weights=values[mask].astype(np.float64), minlength=rows * columns)
    enough = count >= min(LEAST_PIXELS, size_px * size_px // 2)
    means = np.divide(total, count, out=np.full(total.shape, np.nan), where=enough)
    return np.asarray(means.reshape(rows, columns), np.float32)


def normalised_residual(achieved: FloatImage, wanted: ReachableTarget, mask: Mask) -> FloatImage:
    """Per region of 16x16 camera pixels: rms difference to the target over its white, (rows, columns), NaN outside."""
    squared = (((achieved - wanted.radiance) / np.float32(wanted.white)) ** 2).mean(axis=2)
    return np.asarray(np.sqrt(region_means(squared, mask)), np.float32)


def sharpness_map(
    achieved: FloatImage, wanted: ReachableTarget, mask: Mask, size_px: int, least_edges: int = 12
) -> tuple[FloatImage, float]:
    """lambda (paper 6, eq. 9) around each pixel, NaN where the target has too few edges; and over all of them."""
    return sharpness_around(achieved, wanted.radiance, wanted.white, mask, size_px, least_edges=least_edges)


def unbounded_inverse(
    transport: LightTransport, wanted: FloatImage, black: FloatImage, *, iterations: int = NAIVE_ITERATIONS
) -> list[FloatImage]:
    """Least squares without bounds (paper 2.2, eq. 2), clipped to [0, 1] afterwards.

    By LSMR, which ends at the least-norm solution, the pseudo-inverse's, as it continues.
    """
    mask, shape = transport.object_mask, transport.camera_shape
    camera = (3, *shape)

    def forward(p: Float64) -> Float64:
        light = transport.forward_planes(np.ascontiguousarray(p.reshape(3, -1), np.float32))
        return np.asarray(light * mask, np.float64).ravel()

    def adjoint(r: Float64) -> Float64:
        image = np.ascontiguousarray(r.reshape(camera) * mask, np.float32)
        return np.asarray(transport.adjoint_planes(image), np.float64).ravel()

    operator = LinearOperator(
        (3 * shape[0] * shape[1], 3 * transport.pixels), matvec=forward, rmatvec=adjoint, dtype=np.float64
    )
    light = image_planes(np.maximum(wanted - black, 0)) * mask
    scale = float(light.max(initial=0)) or 1.0
    found = lsmr(operator, light.astype(np.float64).ravel() / scale, atol=1e-7, btol=1e-7, maxiter=iterations)[0]
    return plane_frames(np.clip(found.reshape(3, -1) * scale, 0, 1).astype(np.float32), transport.sizes)


def predicted(subject: Subject, frames: Sequence[FloatImage], transport: LightTransport | None = None) -> FloatImage:
    """What the camera should see of these frames by the model: (I + G) L p + K.

    ``transport``: of the projectors that ``frames`` are for; else of all.
    """
    direct = (subject.transport if transport is None else transport).forward(frames)
    whole = direct if subject.indirect is None else direct + subject.indirect.forward(direct)
    return np.asarray(whole + subject.calibration.black, np.float32)


def sharpness_around(
    achieved: FloatImage, target: FloatImage, white: float, mask: Mask, size_px: int, *, least_edges: int = 12
) -> tuple[FloatImage, float]:
    """lambda (paper 6, eq. 9) in the square neighbourhood of ``size_px`` camera pixels of each pixel, and over all.

    (rows, columns) float32, NaN outside the mask and where the target has fewer than ``least_edges`` edge pixels near.
    """
    ours, theirs = edges_of_both(achieved, target, white, mask)

    def counted(picture: Mask) -> FloatImage:
        flat = cv2.boxFilter(picture.astype(np.float32), -1, (size_px, size_px), normalize=False,
                             borderType=cv2.BORDER_CONSTANT)  # fmt: skip
        return np.asarray(np.round(flat), np.float32)

    common, most = counted(ours & theirs), np.maximum(counted(ours), counted(theirs))
    enough = mask & (counted(theirs) >= least_edges)
    return np.divide(common, most, out=np.full(mask.shape, np.nan, np.float32), where=enough), sharpness(
        achieved, target, white, mask
    )
