"""Beyond the paper: what base times scale loses beside a solve, and what narrower means give back (decision 10)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

from controller.core.arrays import FloatImage
from controller.optics.solve.appearance import Base, BaseKind, base_image, scale_frames, solve_base
from controller.optics.solve.bounded.solver import solve_bounded
from lab.study.subject.measuring import better, photograph_variants, quality_table, side_by_side
from lab.study.subject.subject import ReachableTarget, Subject
from lab.study.subject.trial import live_frames, photograph_target
from lab.study.values import Experiment, Result

BASES: tuple[BaseKind, ...] = ("white", "minimum")
PAPERS, OURS, FULL = "eq. 6", "narrower means", "full solve"


def live_pictures(subject: Subject) -> Result:
    """Make one target by base times scale, from two bases and by two means, and by a solve; photograph each."""
    wanted = subject.wanted(photograph_target(subject))
    variants = photograph_variants(subject, wanted, _ways(subject, wanted))
    quality = {variant.name: variant.quality for variant in variants}
    criteria = []
    for kind in BASES:
        asked = f"base {kind}: {OURS} are better than {PAPERS}"
        criteria.append(better(asked, quality[_named(kind, OURS)], quality[_named(kind, PAPERS)]))
    table = quality_table("ways", variants, wanted, ways="way", seconds="seconds, first time")
    return Result(tuple(criteria), (table,), side_by_side(subject, wanted, variants))


def _named(kind: BaseKind, means: str) -> str:
    return f"base {kind}, {means}"


def _ways(subject: Subject, wanted: ReachableTarget) -> list[tuple[str, Callable[[], Sequence[FloatImage]]]]:
    calibration, transport, black = subject.calibration, subject.transport, subject.calibration.black

    def papers(base: Base) -> Sequence[FloatImage]:
        return scale_frames(transport, base, wanted.direct, black)

    ways: list[tuple[str, Callable[[], Sequence[FloatImage]]]] = []
    for kind in BASES:
        base = solve_base(transport, base_image(calibration, kind), black)
        ways += [
            (_named(kind, PAPERS), partial(papers, base)),
            (_named(kind, OURS), partial(live_frames, subject, base, wanted.radiance)),
        ]
    return [*ways, (FULL, lambda: solve_bounded(transport, wanted.direct, black).frames)]


LIVE = Experiment(
    name="live",
    title="Live pictures",
    paper="Beyond the paper: base times scale (eqs 4-6) with means narrower than a pixel",
    shows="narrower means come nearer to the target than eq. 6, from either base.",
    scene="painted",
    run=live_pictures,
    cost_s=25.0,
)
