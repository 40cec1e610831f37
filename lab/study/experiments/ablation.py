"""Fig. 8: what each part of the method is worth, from a naive inverse to all of it."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from itertools import pairwise

from controller.config.defaults import SMOOTHNESS
from controller.core.arrays import FloatImage
from controller.optics.calibrate.metapixels.regularize import fill_holes, regularize
from controller.optics.calibrate.values import Calibration, Metapixels
from controller.optics.solve.bounded.equations import SolveSettings, appearance_weights
from controller.optics.solve.bounded.solver import solve_bounded
from controller.optics.transport import LightTransport, build_transport
from controller.optics.transport.gaussians.patches import patches_of_weights
from controller.stage.report.pictures import crop_around
from controller.stage.steps.calibrate.dots import CLEAR_GAIN
from lab.study.experiments.quadrilateral import quadrilateral_weights
from lab.study.output.drawing import LabelledPicture, detail, screen, strip
from lab.study.subject.measuring import Variant, better, photograph_variants, quality_table, unbounded_inverse
from lab.study.subject.subject import ReachableTarget, Shares, Subject
from lab.study.subject.trial import photograph_target
from lab.study.values import Criterion, Experiment, Figure, Result

FALLS = ("naive inverse", "+ bounds", "+ Gaussian metapixels", "+ regularisation", "+ smoothness")
QUADRILATERALS, OURS = "quadrilaterals instead", "shares per camera sample (ours)"


def ablation(subject: Subject) -> Result:
    """Solve the same target with more and more of the method, and photograph each."""
    target = photograph_target(subject)
    wanted = subject.wanted(target)
    steps = photograph_variants(subject, wanted, _ways(subject, wanted))
    table = quality_table("steps", steps, wanted, ways="step", seconds="seconds, model and solve")
    return Result(_criteria(steps), (table,), _figures(subject, wanted, steps))


def _ways(subject: Subject, wanted: ReachableTarget) -> list[tuple[str, Callable[[], Sequence[FloatImage]]]]:
    black = subject.calibration.black
    plain = paper_model(subject.calibration)
    dots = [subject.light.dots(n) for n in range(len(plain.projectors))]
    raw = raw_transport(plain, [one.shares for one in dots])
    found = [one.metapixels for one in dots]
    even = [fill_holes(regularize(one, least_gain=CLEAR_GAIN)[0]) for one in found]

    def solved(transport: LightTransport, smoothness: float) -> Sequence[FloatImage]:
        weights = appearance_weights(wanted.radiance, wanted.mask, wanted.white)
        return solve_bounded(
            transport, wanted.direct, black, SolveSettings(smoothness=smoothness, weights=weights)
        ).frames

    def gaussians(metapixels: Sequence[Metapixels]) -> LightTransport:
        return build_transport(with_metapixels(plain, metapixels))

    def quadrilaterals() -> LightTransport:
        shape = subject.mask.shape
        weights = [quadrilateral_weights(one, (shape[0], shape[1])) for one in even]
        return build_transport(with_metapixels(plain, even), patches=patches_of_weights(weights, (shape[0], shape[1])))

    return [
        (FALLS[0], lambda: unbounded_inverse(raw, wanted.direct, black)),
        (FALLS[1], lambda: solved(raw, 0.0)),
        (FALLS[2], lambda: solved(gaussians(found), 0.0)),
        (FALLS[3], lambda: solved(gaussians(even), 0.0)),
        (FALLS[4], lambda: solved(gaussians(even), SMOOTHNESS)),
        (QUADRILATERALS, lambda: solved(quadrilaterals(), SMOOTHNESS)),
        (OURS, lambda: solved(subject.transport, SMOOTHNESS)),
    ]


def paper_model(calibration: Calibration) -> Calibration:
    """The calibration with the paper's model alone: no phase maps, no camera's blur behind the paint, no mosaic."""
    parts = tuple(dataclasses.replace(part, phase_map=None) for part in calibration.projectors)
    return dataclasses.replace(calibration, projectors=parts, camera_blur_px=(0.0, 0.0, 0.0), mosaic=None)


def raw_transport(plain: Calibration, shares: Sequence[Shares]) -> LightTransport:
    """T of dots alone; only its rows are scaled, so that all pixels at white give the white image (decision 5)."""
    rows, columns = plain.object_mask.shape
    return build_transport(plain, patches=patches_of_weights(shares, (rows, columns)))


def with_metapixels(calibration: Calibration, metapixels: Sequence[Metapixels]) -> Calibration:
    """The calibration with other metapixels, one set a projector."""
    parts = zip(calibration.projectors, metapixels, strict=True)
    return dataclasses.replace(
        calibration, projectors=tuple(dataclasses.replace(part, metapixels=one) for part, one in parts)
    )


def _criteria(steps: Sequence[Variant]) -> tuple[Criterion, ...]:
    by_name = {step.name: step.quality for step in steps}
    pairs = [(after, before, f"{after} is better than {before}") for before, after in pairwise(FALLS)]
    pairs.append((FALLS[-1], QUADRILATERALS, "Gaussian metapixels are better than quadrilaterals"))
    pairs.append((OURS, FALLS[-1], "our shares are better than the paper's metapixels"))
    return tuple(
        better(f"{what}: CIEDE2000, RMSE and SSIM", by_name[after], by_name[before], with_p95=True)
        for after, before, what in pairs
    )


def _figures(subject: Subject, wanted: ReachableTarget, steps: Sequence[Variant]) -> tuple[Figure, ...]:
    whole = crop_around(subject.mask)
    size_px = max(48, subject.mask.shape[1] // 8)
    matrix, white = subject.calibration.camera_to_xyz, wanted.white
    named = [("target", wanted.radiance), *((step.name, step.photograph) for step in steps)]
    figures = [
        Figure(
            "whole",
            "The target, and a photograph of each step.",
            strip([LabelledPicture(name, screen(image, matrix, white, whole)) for name, image in named], columns=4),
        )
    ]
    for number, centre in enumerate(((0.45, 0.25), (0.35, 0.72))):
        crop = detail(subject.mask, centre=centre, size_px=size_px)
        panels = [LabelledPicture(name, screen(image, matrix, white, crop)) for name, image in named]
        figures.append(
            Figure(f"crop-{number + 1}", f"{size_px} x {size_px} camera pixels of the same.", strip(panels, columns=4))
        )
    return tuple(figures)


ABLATION = Experiment(
    name="ablation",
    title="What each part is worth",
    paper="Paper 6, Fig. 8",
    shows="the photographed error (CIEDE2000, RMSE, SSIM) falls with every part of the method.",
    scene="painted",
    run=ablation,
    cost_s=90.0,
    dots=True,
)
