"""Fig. 8 as an owner of the paper's camera would have taken it: each dot photographed once, no row of T scaled."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Final

import numpy as np
import scipy.sparse as sp

from controller.config.defaults import SMOOTHNESS
from controller.core.arrays import Float64, FloatImage
from controller.optics.calibrate.metapixels.regularize import fill_holes, regularize
from controller.optics.calibrate.values import Calibration, Metapixels
from controller.optics.solve.bounded.equations import SolveSettings, appearance_weights
from controller.optics.solve.bounded.solver import solve_bounded
from controller.optics.transport import LightTransport
from controller.stage.steps.calibrate.dots import CLEAR_GAIN
from lab.study.experiments.ablation import FALLS, paper_model, raw_transport
from lab.study.subject.measuring import (
    Variant,
    better,
    photograph_variants,
    quality_table,
    side_by_side,
    unbounded_inverse,
)
from lab.study.subject.subject import Dots, ReachableTarget, Shares, Subject
from lab.study.subject.trial import photograph_target
from lab.study.values import Criterion, Experiment, Result

CUT: Final = 3.0
"""Gaussians end at this Mahalanobis distance."""


def plain_ablation(subject: Subject) -> Result:
    """Solve the ablation's target with more and more of the method, from dots that are faint, and photograph each."""
    wanted = subject.wanted(photograph_target(subject))
    steps = photograph_variants(subject, wanted, _ways(subject, wanted))
    table = quality_table("steps", steps, wanted, ways="step", seconds="seconds, model and solve")
    return Result(_criteria(steps), (table,), side_by_side(subject, wanted, steps))


def _ways(subject: Subject, wanted: ReachableTarget) -> list[tuple[str, Callable[[], Sequence[FloatImage]]]]:
    plain, black, shape = paper_model(subject.calibration), subject.calibration.black, subject.mask.shape
    dots = [subject.light.dots(n, plain=True) for n in range(len(plain.projectors))]
    raw = unscaled_transport(plain, [one.shares for one in dots])

    def solved(transport: LightTransport, smoothness: float) -> Sequence[FloatImage]:
        weights = appearance_weights(wanted.radiance, wanted.mask, wanted.white)
        settings = SolveSettings(smoothness=smoothness, weights=weights)
        return solve_bounded(transport, wanted.direct, black, settings).frames

    def gaussians(even: bool) -> LightTransport:
        return unscaled_transport(plain, [_as_gaussians(one, (shape[0], shape[1]), even) for one in dots])

    return [
        (FALLS[0], lambda: unbounded_inverse(raw, wanted.direct, black)),
        (FALLS[1], lambda: solved(raw, 0.0)),
        (FALLS[2], lambda: solved(gaussians(False), 0.0)),
        (FALLS[3], lambda: solved(gaussians(True), 0.0)),
        (FALLS[4], lambda: solved(gaussians(True), SMOOTHNESS)),
    ]


def unscaled_transport(plain: Calibration, shares: Sequence[Shares]) -> LightTransport:
    """T whose rows sum to what the shares do: the white image is multiplied by the sums that it is divided by."""
    shape = plain.object_mask.shape
    parts = [
        dataclasses.replace(
            part, white=part.white * np.asarray(one.sum(axis=1), np.float32).reshape(*shape, 1)
        )
        for part, one in zip(plain.projectors, shares, strict=True)
    ]  # fmt: skip
    return raw_transport(dataclasses.replace(plain, projectors=tuple(parts)), shares)


def _as_gaussians(dots: Dots, shape: tuple[int, int], even: bool) -> Shares:
    """The dots' Gaussians, as bright as they were fitted; ``even``: their centres moved, gaps filled (paper 4.2.4)."""
    metapixels, peaks = dots.metapixels, peaks_of(dots, shape)
    if even:
        metapixels = fill_holes(regularize(metapixels, least_gain=CLEAR_GAIN)[0])
    return gaussian_shares(metapixels, peaks, shape)


def peaks_of(dots: Dots, shape: tuple[int, int]) -> Float64:
    """(projector pixels,) share at each Gaussian's centre, by least squares over its dot; where none is, the median."""
    around = gaussian_shares(dots.metapixels, np.ones(dots.metapixels.valid.size), shape)
    seen = np.asarray(around.multiply(dots.shares).sum(axis=0)).ravel()
    whole = np.asarray(around.multiply(around).sum(axis=0)).ravel()
    peaks = np.divide(seen, whole, out=np.zeros_like(seen), where=whole > 0)
    clear = peaks > 0
    usual = float(np.median(peaks[clear])) if clear.any() else 0.0
    return np.asarray(np.clip(np.where(clear, peaks, usual), 0, 1))


def gaussian_shares(metapixels: Metapixels, peaks: Float64, shape: tuple[int, int]) -> Shares:
    """(camera pixels, projector pixels), row-major both: each valid metapixel's Gaussian, its peak as given."""
    rows, columns = shape
    xx, xy, yy = np.moveaxis(metapixels.covariance_px2.reshape(-1, 3).astype(np.float64), -1, 0)
    # Half as wide as usual: at the paper's size there are a hundred million.
    which = np.flatnonzero(metapixels.valid.ravel() & (xx > 0) & (xx * yy > xy * xy)).astype(np.int32)
    xx, xy, yy = xx[which], xy[which], yy[which]
    centre = metapixels.centre_px.reshape(-1, 2)[which].astype(np.float64)
    far_x, far_y = (int(np.ceil(CUT * np.sqrt(np.percentile(one, 99.5)) + 0.5)) if one.size else 0 for one in (xx, yy))
    parts = [(np.empty(0, np.int32), np.empty(0, np.int32), np.empty(0))]
    near = np.round(centre).astype(np.int32)
    for down in range(-far_y, far_y + 1):
        for across in range(-far_x, far_x + 1):
            x, y = near[:, 0] + across, near[:, 1] + down
            u, v = x - centre[:, 0], y - centre[:, 1]
            squared = (yy * u * u - 2 * xy * u * v + xx * v * v) / (xx * yy - xy * xy)
            inside = (squared <= CUT**2) & (x >= 0) & (y >= 0) & (x < columns) & (y < rows)
            value = peaks[which[inside]] * np.exp(-0.5 * squared[inside])
            parts.append(((y * columns + x)[inside], which[inside], value))
    row, column, value = (np.concatenate(part) for part in zip(*parts, strict=True))
    return sp.csr_matrix((value, (row, column)), shape=(rows * columns, metapixels.valid.size))


def _criteria(steps: Sequence[Variant]) -> tuple[Criterion, ...]:
    return tuple(
        better(f"{after.name} is better than {before.name}: CIEDE2000, RMSE and SSIM", after.quality, before.quality,
               with_p95=True)
        for before, after in pairwise(steps)
    )  # fmt: skip


PLAIN_ABLATION = Experiment(
    name="ablation-plain",
    title="What each part is worth, with dots photographed once",
    paper="Paper 6, Fig. 8, as its camera was used",
    shows="the photographed error (CIEDE2000, RMSE, SSIM) falls with every part of the method.",
    scene="painted",
    run=plain_ablation,
    cost_s=90.0,
    dots=True,
)
