"""Fig. 13: earlier systems beside ours, on the same object, target and exposure."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import cv2
import numpy as np

from controller.config.defaults import SMOOTHNESS
from controller.core.arrays import FloatImage
from controller.optics.calibrate.values import Calibration
from controller.optics.solve.appearance import traditional_compensation
from controller.optics.solve.bounded.equations import SolveSettings, appearance_weights
from controller.optics.solve.bounded.solver import solve_bounded
from controller.optics.solve.result.metrics import colour_difference
from controller.optics.transport import LightTransport, build_transport
from controller.stage.report.pictures import crop_around, error_picture
from lab.study.experiments.ablation import paper_model, raw_transport
from lab.study.experiments.residual import brightest_first
from lab.study.output.drawing import LabelledPicture, strip
from lab.study.subject.measuring import (
    Variant,
    better,
    photograph_variants,
    quality_table,
    side_by_side,
    unbounded_inverse,
)
from lab.study.subject.subject import ReachableTarget, Subject
from lab.study.subject.trial import photograph_target
from lab.study.values import Criterion, Experiment, Figure, Result

FEATHER = 0.02
"""Of the picture's width: standard deviation of the blur of the seams between projectors."""
OURS = "ours"


def earlier_systems(subject: Subject) -> Result:
    """Make one target in five ways and photograph each."""
    best = brightest_first(subject)[0]
    target = photograph_target(subject)
    alone = build_transport(subject.with_projectors([best]))
    wanted = subject.wanted(target, transport=alone)
    variants = photograph_variants(subject, wanted, _ways(subject, wanted, best))
    table = quality_table("systems", variants, wanted, ways="system")
    return Result(_criteria(variants), (table,), _figures(subject, wanted, variants))


def _ways(subject: Subject, wanted: ReachableTarget, best: int) -> list[tuple[str, Callable[[], Sequence[FloatImage]]]]:
    calibration, black = subject.calibration, subject.calibration.black
    plain = paper_model(calibration)
    raw = raw_transport(plain, [subject.light.dots(n).shares for n in range(len(plain.projectors))])
    weights = appearance_weights(wanted.radiance, wanted.mask, wanted.white)

    def bounded(transport: LightTransport, smoothness: float) -> Sequence[FloatImage]:
        return solve_bounded(
            transport, wanted.direct, black, SolveSettings(weights=weights, smoothness=smoothness)
        ).frames

    return [
        ("one projector, division at each pixel", lambda: traditional_compensation(calibration, wanted.direct, best)),
        ("feathered projectors", lambda: feathered(calibration, wanted.direct)),
        ("unconstrained inverse, clipped", lambda: unbounded_inverse(raw, wanted.direct, black)),
        ("bounded, no pixel model", lambda: bounded(raw, 0.0)),
        (OURS, lambda: bounded(subject.transport, SMOOTHNESS)),
    ]


def feathered(calibration: Calibration, target: FloatImage) -> list[FloatImage]:
    """Each place lit by the projector that is brightest there, seams blended over (in the spirit of Raskar 2001).

    Every projector divides at each pixel, as ``traditional_compensation``, for its part of ``target``
    (rows, columns, 3) radiance.
    """
    whites = np.stack([part.white.mean(axis=2) for part in calibration.projectors])
    lit = whites > 0.02 * whites.max()
    first = whites.argmax(axis=0)
    sigma = max(1.0, FEATHER * target.shape[1])
    shares = np.stack([cv2.GaussianBlur((first == n).astype(np.float32), (0, 0), sigma) for n in range(len(whites))])
    shares *= lit
    total = shares.sum(axis=0)
    shares = np.divide(shares, total, out=np.zeros_like(shares), where=total > 0)
    light = np.maximum(target - calibration.black, 0)
    frames = []
    for n in range(len(whites)):
        part = np.asarray(calibration.black + shares[n][..., None] * light, np.float32)
        frames.append(traditional_compensation(calibration, part, n)[n])
    return frames


def _criteria(variants: Sequence[Variant]) -> tuple[Criterion, ...]:
    return tuple(
        better(f"ours is better than: {variant.name}", variants[-1].quality, variant.quality)
        for variant in variants[:-1]
    )


def _figures(subject: Subject, wanted: ReachableTarget, variants: Sequence[Variant]) -> tuple[Figure, ...]:
    whole = crop_around(subject.mask)
    matrix, white = subject.calibration.camera_to_xyz, wanted.white
    errors = []
    for variant in variants:
        difference = colour_difference(variant.photograph, wanted.radiance, matrix, white, wanted.mask)
        cut = error_picture(difference, wanted.mask)[whole.rows, whole.columns]
        errors.append(LabelledPicture(variant.name, np.ascontiguousarray(cut)))
    return (
        *side_by_side(subject, wanted, variants),
        Figure("errors", "CIEDE2000 of each, black 0, bright 12 and more; grey is not compared.",
               strip(errors, columns=3)),
    )  # fmt: skip


EARLIER = Experiment(
    name="earlier",
    title="Earlier systems",
    paper="Paper 6, Fig. 13",
    shows="ours is better than the unconstrained inverse, bounds without a pixel model, one projector, and feathering.",
    scene="painted",
    run=earlier_systems,
    cost_s=60.0,
    dots=True,
)
