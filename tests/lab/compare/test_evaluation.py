"""The judge: what methods get, what is refused, and that its figures are those of an independent computation."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from controller.core.arrays import ByteImage, Float64, FloatImage
from controller.core.errors import WorkError
from hal.deadline import Cancelled
from lab.compare.api import ComparisonStage, ComparisonTarget, MakeFrames
from lab.compare.entries import Entry, entries
from lab.compare.evaluation import Evaluation, evaluate
from lab.study.subject.subject import ReachableTarget, Subject
from tests.lab.compare.arena import EXPOSURES, ArrayShower, counted
from tests.lab.study.array_stage import array_subject

Frames = Sequence[ByteImage]
EXAMPLE = Path(__file__).parents[3] / "docs" / "examples" / "compared_method.py"


@pytest.fixture(scope="module")
def subject() -> Subject:
    return array_subject()


def ramp(subject: Subject) -> dict[str, ReachableTarget]:
    """A coloured ramp, in reach everywhere but at its right side."""
    rows, columns = subject.mask.shape
    across = np.linspace(0.1, 0.9, columns, dtype=np.float32)[None, :, None]
    radiance = np.ones((rows, 1, 1), np.float32) * across * np.array([1.0, 0.8, 0.5], np.float32)
    reach = subject.mask & (np.arange(columns) < columns - 40)
    return {"ramp": ReachableTarget(radiance, reach, 1.0, None, subject.mask)}


def judged(subject: Subject, method: Any, most: int = 100, shower: ArrayShower | None = None) -> Evaluation:
    shower = ArrayShower(subject) if shower is None else shower
    return evaluate(Entry("mine", method), counted(subject, shower, most), ramp(subject), shower)


def grey_frames(stage: ComparisonStage, value: int = 90) -> Frames:
    return [np.full((height, width, 3), value, np.uint8) for width, height in stage.projectors_px]


def grey(stage: ComparisonStage) -> MakeFrames:
    """Even grey."""
    return lambda target: grey_frames(stage)


def lab(xyz: FloatImage) -> Float64:
    """CIE 1976, of light whose white is (1, 1, 1)."""
    t = np.maximum(xyz.astype(np.float64), 0)
    x, y, z = np.moveaxis(np.where(t > 216 / 24389, np.cbrt(t), (24389 / 27 * t + 16) / 116), -1, 0)
    return np.stack([116 * y - 16, 500 * (x - y), 200 * (y - z)], -1)


def ciede2000(first: Float64, other: Float64) -> Float64:
    """As Sharma, Wu and Dalal (2005) write it down, with angles in degrees."""
    (l1, a1, b1), (l2, a2, b2) = (np.moveaxis(one, -1, 0) for one in (first, other))
    mean7 = ((np.hypot(a1, b1) + np.hypot(a2, b2)) / 2) ** 7
    g = 1.5 - 0.5 * np.sqrt(mean7 / (mean7 + 25**7))
    c1, c2 = np.hypot(g * a1, b1), np.hypot(g * a2, b2)
    h1, h2 = (np.degrees(np.arctan2(b, g * a)) % 360 for a, b in ((a1, b1), (a2, b2)))
    turn = (h2 - h1 + 180) % 360 - 180
    hue, chroma, light = h1 + turn / 2, (c1 + c2) / 2, (l1 + l2) / 2

    def cos(factor: float, shift: float) -> Float64:
        return np.asarray(np.cos(np.radians(factor * hue + shift)))

    t = 1 - 0.17 * cos(1, -30) + 0.24 * cos(2, 0) + 0.32 * cos(3, 6) - 0.2 * cos(4, -63)
    spread = 30 * np.exp(-((((hue % 360) - 275) / 25) ** 2))
    rotation = -2 * np.sqrt(chroma**7 / (chroma**7 + 25**7)) * np.sin(np.radians(2 * spread))
    by_light = (l2 - l1) / (1 + 0.015 * (light - 50) ** 2 / np.sqrt(20 + (light - 50) ** 2))
    by_chroma = (c2 - c1) / (1 + 0.045 * chroma)
    by_hue = 2 * np.sqrt(c1 * c2) * np.sin(np.radians(turn / 2)) / (1 + 0.015 * chroma * t)
    return np.asarray(np.sqrt(by_light**2 + by_chroma**2 + by_hue**2 + rotation * by_chroma * by_hue))


def test_the_other_computation_knows_published_pairs() -> None:
    first = np.array([[50, 2.6772, -79.7751], [50, 2.49, -0.001], [22.7233, 20.0904, -46.694]])
    other = np.array([[50, 0, -82.7485], [50, -2.49, 0.0011], [23.0331, 14.973, -42.5619]])
    assert ciede2000(first, other) == pytest.approx([2.0425, 7.2195, 2.0373], abs=1e-4)


def test_the_figures_are_those_of_another_computation(subject: Subject) -> None:
    found = judged(subject, grey)
    (score,) = found.scores
    assert score.photograph is not None
    (wanted,) = ramp(subject).values()
    # The array stage's camera has XYZ as its colours, so that white is the illuminant (1, 1, 1).
    error = ciede2000(lab(wanted.radiance), lab(score.photograph))
    for name, mask in (("in_reach", wanted.mask), ("lit", subject.mask)):
        median, p95 = np.percentile(error[mask], (50, 95))
        assert score.pixels[name].delta_e00_median == pytest.approx(median, abs=2e-3)
        assert score.pixels[name].delta_e00_p95 == pytest.approx(p95, abs=2e-3)
    assert score.pixels["in_reach"].delta_e00_median != pytest.approx(score.pixels["lit"].delta_e00_median, rel=0.01)


def test_each_exposure_is_counted_and_the_judges_are_not(subject: Subject) -> None:
    def looks(stage: ComparisonStage) -> MakeFrames:
        stage.photograph(grey_frames(stage))
        assert stage.photographs == EXPOSURES
        stage.calibrated([1])
        stage.calibrated([1, 2])
        assert stage.photographs == EXPOSURES + 5 + 20 + 30

        def frames(target: ComparisonTarget) -> Frames:
            stage.photograph(grey_frames(stage, 30))
            return grey_frames(stage)

        return frames

    shower = ArrayShower(subject)
    found = judged(subject, looks, shower=shower)
    assert found.photographs == 2 * EXPOSURES + 55
    assert shower.names == ["own-0", "own-1", "judged-ramp"]


def test_a_method_that_wants_too_many_photographs_is_refused(subject: Subject) -> None:
    def greedy(stage: ComparisonStage) -> MakeFrames:
        while True:
            stage.photograph(grey_frames(stage))

    found = judged(subject, greedy, most=6)
    assert found.failed is not None
    assert (found.failed.code, found.photographs, found.scores) == ("benchmark-photographs-spent", 6, ())


WRONG: dict[str, Any] = {
    "too few": lambda frames: frames[:-1],
    "another size": lambda frames: [frame[1:] for frame in frames],
    "not finite": lambda frames: [np.full(frame.shape, np.nan) for frame in frames],
    "nothing": lambda frames: None,
    "lists": lambda frames: [frame.tolist() for frame in frames],
}


@pytest.mark.parametrize("how", WRONG)
def test_frames_that_can_not_be_shown_are_refused(subject: Subject, how: str) -> None:
    shower = ArrayShower(subject)
    found = judged(subject, lambda stage: lambda target: WRONG[how](grey_frames(stage)), shower=shower)
    (score,) = found.scores
    assert score.failed is not None
    assert (score.failed.code, score.pixels) == ("benchmark-frames-wrong", {})
    assert judged(subject, lambda stage: stage.photograph(WRONG[how](grey_frames(stage)))).failed == score.failed
    assert shower.names == []


def test_a_photograph_for_no_light_is_refused(subject: Subject) -> None:
    found = judged(subject, lambda stage: stage.photograph(grey_frames(stage), white=float("nan")))
    assert found.failed is not None
    assert found.failed.code == "benchmark-white-wrong"


def test_what_a_method_raises_is_its_result(subject: Subject) -> None:
    def broken(stage: ComparisonStage) -> MakeFrames:
        raise ZeroDivisionError("no light")

    found = judged(subject, broken)
    assert found.failed is not None
    assert found.failed.code == "benchmark-method-failed"
    assert "ZeroDivisionError: no light" in found.failed.what
    assert judged(subject, lambda stage: None).failed is not None

    def later(stage: ComparisonStage) -> MakeFrames:
        def frames(target: ComparisonTarget) -> Frames:
            raise KeyError(target.name)

        return frames

    (score,) = judged(subject, later).scores
    assert score.failed is not None
    assert score.failed.code == "benchmark-method-failed"


def test_a_stop_ends_the_work(subject: Subject) -> None:
    def stopped() -> None:
        raise Cancelled

    shower = ArrayShower(subject)
    stage = counted(subject, shower)
    stage.check = stopped
    with pytest.raises(Cancelled):
        evaluate(Entry("mine", lambda stage: stage.photograph(grey_frames(stage))), stage, ramp(subject), shower)

    def ended() -> None:
        raise WorkError("run-too-slow", what="The run's time is over.", remedy="Run it again.")

    stage.check = ended
    with pytest.raises(WorkError):
        evaluate(Entry("mine", lambda stage: {}[stage]), stage, ramp(subject), shower)


def test_a_method_can_not_change_what_it_is_judged_by(subject: Subject) -> None:
    def cheating(stage: ComparisonStage) -> MakeFrames:
        stage.object_mask[:] = False

        def frames(target: ComparisonTarget) -> Frames:
            target.radiance[:] = 0
            target.valid[:] = False
            target.in_reach[:] = False
            return grey_frames(stage)

        return frames

    honest, other = (judged(subject, method).scores[0].pixels for method in (grey, cheating))
    assert other == honest


def test_the_example_is_a_method(subject: Subject) -> None:
    (entry,) = entries((f"{EXAMPLE}:even_colour",))
    shower = ArrayShower(subject)
    found = evaluate(entry, counted(subject, shower), ramp(subject), shower)
    (score,) = found.scores
    assert (score.failed, found.photographs) == (None, 5 * EXPOSURES)
    assert score.photograph is not None
    made, asked = (image[subject.mask].mean(axis=0) for image in (score.photograph, ramp(subject)["ramp"].radiance))
    assert np.allclose(made, asked, atol=0.01)
