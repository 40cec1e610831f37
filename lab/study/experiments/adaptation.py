"""Beyond the paper: targets bent where light is lacking, so that the object's own pattern does not show."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from controller.core.arrays import ByteImage, FloatImage, Mask
from controller.optics.calibrate.photometry.reflectance import own_reflectance
from controller.optics.solve.bounded.solver import solve_bounded
from controller.optics.solve.reach.adaptation import adapted_target
from controller.optics.solve.reach.feasibility import choose_exposure, feasibility
from controller.optics.solve.result.ghosting import Ghosting, ghosting
from controller.optics.solve.result.metrics import TITLES, PixelSet, by_pixels
from controller.stage.report.pictures import Crop, crop_around
from lab.study.output.drawing import LabelledPicture, Line, plotted, screen, strip
from lab.study.subject.likeness import lab_of
from lab.study.subject.subject import Subject
from lab.study.subject.trial import photograph_target
from lab.study.values import Cell, Criterion, Experiment, Figure, Result, ResultTable

SHARES: Final = (0.95, 0.85, 0.7, 0.5)
"""Share of the object's pixels that can be made as bright as the target requires; the rest lacks light."""
CUT, ADAPTED = "cut off", "adapted"
GHOST: Final = 1 / 3
"""Of cutting off's ghosting, at most this."""
LIGHTNESS: Final = 0.1


@dataclass(frozen=True, slots=True)
class AdaptationResult:
    """One way at one exposure. ``lightness``: mean L*; ``flip``: mean of FLIP where it is installed."""

    share: float
    reachable: float
    way: str
    ghost: Ghosting | None
    lightness: float
    pixels: dict[str, PixelSet]
    flip: float | None
    photograph: FloatImage
    wanted: FloatImage
    white: float


def adaptation(subject: Subject) -> Result:
    """Make a photograph at four exposures that ask for more and more light than there is, in two ways each."""
    target = photograph_target(subject)
    own = own_reflectance(subject.calibration, subject.geometry)
    results: list[AdaptationResult] = []
    for number, share in enumerate(SHARES):
        subject.advance(number / len(SHARES), f"{share:.0%} in reach")
        results += _at_exposure(subject, target.image, target.mask, own, share)
    return Result(_criteria(results), (_table(results),), _figures(subject, results), TEXT)


def _at_exposure(
    subject: Subject, image: FloatImage, mask: Mask, own: FloatImage, share: float
) -> list[AdaptationResult]:
    transport, black, drive = subject.transport, subject.calibration.black, subject.drive
    white = choose_exposure(transport, image, black, share=share, drive=drive)
    wanted = np.asarray(np.float32(white) * image, np.float32)
    shown = mask & subject.mask
    possible = feasibility(transport, wanted, black, drive=drive)
    targets = {CUT: wanted, ADAPTED: adapted_target(transport, wanted, black, drive=drive)}
    matrix, crop, results = subject.calibration.camera_to_xyz, crop_around(subject.mask), []

    def on_screen(image: FloatImage) -> ByteImage:
        return screen(np.where(shown[..., None], image, 0).astype(np.float32), matrix, white, crop)

    for way, asked in targets.items():
        frames = solve_bounded(transport, asked, black).frames
        picture = subject.light.photograph(f"{share:.2f}-{way.replace(' ', '-')}", frames, white=white)
        results.append(
            AdaptationResult(
                share, possible.share, way,
                ghosting(picture, wanted, own, matrix, white, shown, shown & ~possible.reachable),
                float(lab_of(picture[shown], matrix, white)[:, 0].mean()),
                by_pixels(picture, wanted, matrix, white, reachable=possible.reachable, valid=mask, lit=subject.mask),
                flip_of(on_screen(wanted), on_screen(picture), shown, crop),
                picture, wanted, white,
            )
        )  # fmt: skip
    return results


def flip_of(reference: ByteImage, picture: ByteImage, mask: Mask, crop: Crop) -> float | None:
    """Mean of FLIP (Andersson et al. 2020) over a mask, of 8-bit pictures (rows, columns, 3); None if not installed."""
    try:
        import flip_evaluator
    except ImportError:
        return None
    pictures = [np.ascontiguousarray(one / np.float32(255), np.float32) for one in (reference, picture)]
    found = np.asarray(flip_evaluator.evaluate(*pictures, "LDR", applyMagma=False)[0])
    return float(found.reshape(*found.shape[:2], -1).mean(axis=2)[mask[crop.rows, crop.columns]].mean())


def _of(results: Sequence[AdaptationResult], way: str) -> dict[float, AdaptationResult]:
    return {result.share: result for result in results if result.way == way}


def _criteria(results: Sequence[AdaptationResult]) -> tuple[Criterion, ...]:
    cut, adapted = _of(results, CUT), _of(results, ADAPTED)
    found = []
    for share in SHARES:
        before, after = cut[share].ghost, adapted[share].ghost
        if before is None or after is None:
            reached, holds = "nothing is out of reach", None
        else:
            reached = f"{before.both.correlation:.3f} to {after.both.correlation:.3f}"
            holds = after.both.correlation <= GHOST * before.both.correlation
        reason = "What is left goes along with the pattern in reach, too: errors of the calibration and of edges."
        found.append(
            Criterion(f"ghosting is at most a third of cutting off's, {share:.0%} in reach", reached, holds,
                      "" if holds else reason if holds is False else "Nothing is out of reach.")
        )  # fmt: skip
        lost = 1 - adapted[share].lightness / cut[share].lightness
        found.append(
            Criterion(
                f"at most {LIGHTNESS:.0%} of the mean lightness is lost, {share:.0%} in reach", f"{lost:.1%}",
                lost <= LIGHTNESS, "" if lost <= LIGHTNESS else "So much of the object lacks light.",
            )
        )  # fmt: skip
    return tuple(found)


def _table(results: Sequence[AdaptationResult]) -> ResultTable:
    columns = (
        "asked to be in reach", "way", "ghosting, correlation", "lightness", "chroma", "share of the pattern",
        "mean L*", *(f"CIEDE2000 {title}" for title in TITLES.values()),
        *(f"left out of {title}" for title in TITLES.values()), "FLIP",
    )  # fmt: skip
    return ResultTable("adaptation", "The object's own pattern in photographs, and the error", columns,
                       tuple(_row(result) for result in results))  # fmt: skip


def _row(one: AdaptationResult) -> tuple[Cell, ...]:
    ghosts: tuple[Cell, ...] = (None,) * 4
    if one.ghost is not None:
        both, lightness, chroma = one.ghost.both, one.ghost.lightness, one.ghost.chroma
        ghosts = tuple(
            round(value, 3) for value in (both.correlation, lightness.correlation, chroma.correlation, both.share)
        )
    errors = [
        None if each.delta_e00_median is None or each.delta_e00_p95 is None
        else f"{each.delta_e00_median:.2f} / {each.delta_e00_p95:.1f}"
        for each in one.pixels.values()
    ]  # fmt: skip
    left_out = (round(each.left_out_share, 3) for each in one.pixels.values())
    flip = None if one.flip is None else round(one.flip, 4)
    return (one.share, one.way, *ghosts, round(one.lightness, 1), *errors, *left_out, flip)


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
        Line(way, x=[1 - s for s in SHARES],
             y=[float("nan") if (ghost := _of(results, way)[s].ghost) is None else ghost.both.correlation
                for s in SHARES], style=style)
        for way, style in ((CUT, "-o"), (ADAPTED, "--o"))
    ]  # fmt: skip
    return (
        Figure("photographs", "The target and photographs of each way, where a third and where half lacks light.",
               strip(panels, columns=3)),
        Figure("ghosting", "Ghosting in photographs, by how much of the object lacks light.",
               plotted(lines, x="share of pixels that lack light", y="correlation with the object's pattern",
                       y_range=(0, None))),
    )  # fmt: skip


TEXT = """\
A photograph as target, at rising exposures, where more and more pixels of the object need more light than there is.
*Cut off*: the plain solve. *Adapted*: the target is bent first, as `[solve] adapt = 1` does. *Ghosting* is measured in
photographs of the result: how far their error goes along with the object's own paint, near the pixels that are out of
reach, in bands of 1 to 8 % of the picture. All errors are against the target as it was asked for. FLIP (Andersson et
al. 2020) compares at the asked brightness, too, so it counts a smooth change of light as an error. It is missing where
`flip-evaluator` is not installed. There was no test with viewers."""

ADAPTATION = Experiment(
    name="adaptation",
    title="Adaptation where light is lacking",
    paper="Beyond the paper: in the spirit of Law et al. 2011",
    shows="adaptation hides the object's own pattern where light is lacking, and costs little lightness.",
    scene="painted",
    run=adaptation,
    cost_s=60.0,
)
