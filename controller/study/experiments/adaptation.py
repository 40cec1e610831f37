"""Beyond the paper: gentle adaptation where light is lacking (in the spirit of Law et al. 2011)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np

from controller.core.arrays import FloatImage, Mask
from controller.report.pictures import crop_around
from controller.solve.adapt import adapt, adapt_gently, contrast_kept
from controller.solve.bounded.solver import SMOOTHNESS, solve_bounded
from controller.solve.feasibility import choose_exposure, feasibility
from controller.solve.metrics import compare
from controller.study.lab.subject import Subject
from controller.study.lab.trial import photograph_target
from controller.study.output.drawing import LabelledPicture, Line, plotted, screen, strip
from controller.study.values import Cell, Criterion, Experiment, Figure, Result, ResultTable

SHARES: Final = (0.95, 0.85, 0.7, 0.5)
"""Share of the object's pixels that can be made as bright as the target requires; the rest lacks light."""
CUT, GENTLE, FULL = "cut off", "gently adapted", "adapted in full"
BAND_SIGMAS_PX: Final = (1.5, 3.0, 6.0, 12.0)
FAINT: Final = 0.02
"""Weber contrast below which nothing is visible."""
NOT_WORSE: Final = 0.005


@dataclass(frozen=True, slots=True)
class AdaptationResult:
    """One way at one exposure. ``kept``: by our own measure; ``bands``: of Peli's contrast; both 0 to 1."""

    share: float
    reachable: float
    way: str
    kept: float
    bands: float
    delta_e: float
    photograph: FloatImage
    wanted: FloatImage
    white: float


def adaptation(subject: Subject) -> Result:
    """Make a photograph at four exposures that ask for more and more light than there is, in three ways each."""
    target = photograph_target(subject)
    results: list[AdaptationResult] = []
    for number, share in enumerate(SHARES):
        subject.advance(number / len(SHARES), f"{share:.0%} in reach")
        results += _at_exposure(subject, target.image, target.mask, share)
    return Result(_criteria(results), (_table(results),), _figures(subject, results), TEXT)


def _at_exposure(subject: Subject, image: FloatImage, mask: Mask, share: float) -> list[AdaptationResult]:
    transport, black, drive = subject.transport, subject.calibration.black, subject.drive
    white = choose_exposure(transport, image, black, share=share, drive=drive)
    wanted = np.asarray(np.float32(white) * image, np.float32)
    shown = mask & subject.mask
    reachable = feasibility(transport, wanted, black, drive=drive).share
    targets = {
        CUT: wanted,
        GENTLE: adapt_gently(transport, wanted, black, white=white, drive=drive)[0].target,
        FULL: adapt(transport, wanted, black, drive=drive).target,
    }
    results = []
    for way, asked in targets.items():
        frames = solve_bounded(transport, asked, black, smoothness=SMOOTHNESS).frames
        picture = subject.light.photograph(f"{share:.2f}-{way.replace(' ', '-')}", frames, white=white)
        found = compare(picture, wanted, subject.calibration.camera_to_xyz, white, shown)
        results.append(
            AdaptationResult(
                share, reachable, way,
                contrast_kept(picture, wanted, shown, white=white), bands_kept(picture, wanted, shown),
                found.delta_e00_median, picture, wanted, white,
            )
        )  # fmt: skip
    return results


def bands_kept(achieved: FloatImage, target: FloatImage, mask: Mask) -> float:
    """How much of the target's band-limited local contrast a picture has, 0 to 1 (Peli 1990), over four octaves.

    In each band contrast is the difference of two Gaussian means by the wider one. Of a pixel's contrast counts what
    has the target's sign, up to the target's. Luminance stands for colour, and what lies beside the mask for nothing.
    """
    kept = whole = 0.0
    present = mask.astype(np.float32)
    for sigma in BAND_SIGMAS_PX:
        ours, theirs = (_band(image.mean(axis=2), present, sigma) for image in (achieved, target))
        counted = mask & (np.abs(theirs) > FAINT)
        along = np.where(np.sign(ours) == np.sign(theirs), np.minimum(np.abs(ours), np.abs(theirs)), 0.0)
        kept += float(along[counted].sum(dtype=np.float64))
        whole += float(np.abs(theirs)[counted].sum(dtype=np.float64))
    return kept / whole if whole > 0 else 1.0


def _band(light: FloatImage, present: FloatImage, sigma: float) -> FloatImage:
    """Contrast (rows, columns) between two neighbourhoods an octave apart, of what is on the object alone."""
    near, far = (
        cv2.GaussianBlur(light * present, (0, 0), s) / np.maximum(cv2.GaussianBlur(present, (0, 0), s), 1e-6)
        for s in (sigma, 2 * sigma)
    )
    return np.asarray((near - far) / np.maximum(far, 1e-9), np.float32)


def _of(results: Sequence[AdaptationResult], way: str) -> dict[float, AdaptationResult]:
    return {result.share: result for result in results if result.way == way}


def _criteria(results: Sequence[AdaptationResult]) -> tuple[Criterion, ...]:
    cut, gentle = _of(results, CUT), _of(results, GENTLE)
    found = []
    for share in SHARES:
        before, after = cut[share], gentle[share]
        lacking = share < SHARES[0]
        worst = min(after.kept - before.kept, after.bands - before.bands)
        holds = worst > 0 if lacking else worst > -NOT_WORSE
        asked = "more contrast is kept than by cutting off" if lacking else "nothing is lost where little is lacking"
        reason = "" if holds else (
            ("So little light is lacking that a dimming would lose as much as it wins: almost nothing was "
"adapted.")
            if abs(after.kept - before.kept) < NOT_WORSE else
            "Adaptation is chosen by the prediction for a perfect stage; the photograph shows less."
        )  # fmt: skip
        found.append(
            Criterion(
                f"{asked}, {share:.0%} in reach, by both measures",
                f"{before.kept:.3f} to {after.kept:.3f}; in bands {before.bands:.3f} to {after.bands:.3f}",
                holds,
                reason,
            )
        )
    return tuple(found)


def _table(results: Sequence[AdaptationResult]) -> ResultTable:
    columns = (
        "asked to be in reach", "in reach", "way", "contrast kept", "contrast kept in bands (Peli)", "CIEDE2000 median"
    )  # fmt: skip
    rows: list[tuple[Cell, ...]] = [
        (m.share, round(m.reachable, 3), m.way, round(m.kept, 4), round(m.bands, 4), round(m.delta_e, 2))
        for m in results
    ]
    return ResultTable("adaptation", "Contrast of the target that photographs keep", columns, tuple(rows))


def _figures(subject: Subject, results: Sequence[AdaptationResult]) -> tuple[Figure, ...]:
    crop, matrix = crop_around(subject.mask), subject.calibration.camera_to_xyz
    panels = []
    for share in (SHARES[-2], SHARES[-1]):
        some = [result for result in results if result.share == share]
        panels.append(
            LabelledPicture(f"target, {share:.0%} in reach", screen(some[0].wanted, matrix, some[0].white, crop))
        )
        panels += [
            LabelledPicture(result.way, screen(result.photograph, matrix, result.white, crop)) for result in some
        ]
    lines = [
        Line(f"{way}, {name}", x=[1 - s for s in SHARES], y=[getattr(_of(results, way)[s], key) for s in SHARES],
             style=style + mark)
        for way, style in ((CUT, "-"), (GENTLE, "--"), (FULL, ":"))
        for name, key, mark in (("our measure", "kept", "o"), ("Peli", "bands", "s"))
    ]  # fmt: skip
    return (
        Figure("photographs", "The target and photographs of each way, where a third and where half lacks light.",
               strip(panels, columns=4)),
        Figure("contrast", "Contrast kept in photographs, by how much of the object lacks light.",
               plotted(lines, x="share of pixels that lack light", y="contrast kept")),
    )  # fmt: skip


TEXT = """\
A photograph as target, at rising exposures, where more and more pixels of the object need more light than there is.
*Cut off*: the plain solve. *Gently adapted*: the result of `[solve] adapt = 1`. It tries a few dimmings, which give up
the pixels that hardly any light reaches, and takes the one that keeps most contrast. *Adapted in full*: all in reach.
Contrast is measured in photographs of the result, in two ways: the measure that chooses the dimming, and an
independent one, band-limited contrast after Peli 1990. The colour difference is to the requested target, and
adaptation makes it larger: it trades absolute brightness for detail. There was no test with viewers, so it is not
shown which result people prefer."""

ADAPTATION = Experiment(
    name="adaptation",
    title="Gentle adaptation where light is lacking",
    paper="Beyond the paper: in the spirit of Law et al. 2011",
    shows="adaptation keeps more of the target's local contrast than cutting off.",
    scene="painted",
    run=adaptation,
    cost_s=60.0,
)
