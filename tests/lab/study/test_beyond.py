"""The experiments beyond the paper, on a stage in arrays with somebody who disturbs it."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from controller.core.arrays import FloatImage
from controller.core.errors import CalibrationError, UsageError, WorkError
from controller.optics.calibrate.verify.drift import Drift, DriftCause, ProjectorDrift
from controller.optics.calibrate.verify.registration import Motion
from controller.optics.solve.result.metrics import PixelSet
from controller.stage.steps.modes import DotOptions
from hal.errors import DeviceError
from lab.study.experiments.drift import LEVELS_PX, BumpResult, _criteria, drifting
from lab.study.experiments.effort import effort
from lab.study.experiments.robustness import DISTURBANCES, DisturbanceResult, doubles_at, quantised, robustness
from lab.study.subject.measuring import Quality
from lab.study.subject.subject import BenchChange, Dots, ReachableTarget, Recalibration, SessionParts, Subject
from lab.study.subject.trial import Trial
from lab.study.values import column
from tests.lab.study.array_stage import ArrayLight, array_subject


def motion(rms_px: float) -> Motion:
    return Motion(np.eye(3), (0.0, 0.0), (rms_px, 0.0), 0.01, rms_px, 0.0, 0.01, 1.0, 0.001, (1.0, 1.0, 1.0), 1.0, True)


@dataclass
class Clumsy:
    """Moves a stage in arrays as ``changes`` say: every bump shifts what the projectors show, till it is calibrated."""

    subject: Subject
    changes: tuple[BenchChange, ...] = ()
    done: list[str] = field(default_factory=list)
    fails: dict[str, Exception] = field(default_factory=dict)
    """By name of the calibration that it ends."""

    def disturb(self, *changes: BenchChange) -> None:
        self.changes = changes

    def _moved_px(self, what: str) -> float:
        return sum(
            float(change.get("shift_px", (0.0,))[0]) + float(change.get("move_mm", (0.0,))[0])
            for change in self.changes if change["what"] == what
        )  # fmt: skip

    def drift(self, name: str) -> Drift:
        moved = {what: self._moved_px(what) for what in ("projector", "camera", "object")}
        culprit = next((kind for what, kind in (("camera", DriftCause.CAMERA), ("object", DriftCause.OBJECT))
                        if moved[what] > 0.2), DriftCause.NONE)  # fmt: skip
        projectors = tuple(
            ProjectorDrift(part.name, motion(moved["projector"] if n == 0 else 0.0), (1.0, 1.0, 1.0),
                           (0.01, 0.01, 0.01), 0.0, 1.0)
            for n, part in enumerate(self.subject.calibration.projectors)
        )  # fmt: skip
        return Drift(projectors, motion(moved["camera"] + moved["object"]), culprit, 0.0, 1.0)

    def quickly(self, name: str) -> Recalibration:
        return self.again(name)

    def again(self, name: str, options: DotOptions | None = None, *, beyond: str | None = None) -> Recalibration:
        assert beyond is None or beyond in self.done
        self.done.append(name)
        if name in self.fails:
            raise self.fails[name]
        if any(change.get("gloss", 0) > 0.02 for change in self.changes):
            raise CalibrationError("too-glossy", what="The object mirrors.", remedy="Dull it.")
        subject = dataclasses.replace(self.subject, light=array_subject().light)
        spacing = 0 if options is None or options.spacing_px is None else options.spacing_px
        photographs = 3 * (30 + (spacing**2 if options is not None and options.mode == "paper" else 0))
        return Recalibration(subject, photographs, {"p0": 1.2, "p1": 1.4})


@dataclass
class Disturbed:
    """``Photographer`` that shows what a clumsy hand made of the frames."""

    light: ArrayLight
    hand: Clumsy

    def photograph(self, name: str, frames: Sequence[FloatImage], *, white: float) -> FloatImage:
        shown = list(frames)
        for change in self.hand.changes:
            pixels = round(float(change.get("shift_px", (0.0,))[0]) + float(change.get("move_mm", (0.0,))[0]))
            shown[0] = np.roll(shown[0], pixels, axis=1)
            shown = [np.asarray(frame ** np.float32(float(change.get("gamma", 1.0)))) for frame in shown]
        return self.light.photograph(name, shown, white=white)

    def dots(self, n: int, *, plain: bool = False) -> Dots:
        return self.light.dots(n, plain=plain)


def stage() -> tuple[Subject, Clumsy]:
    subject = array_subject()
    hand = Clumsy(subject)
    assert isinstance(subject.light, ArrayLight)
    subject.light = Disturbed(subject.light, hand)
    subject.parts = cast(SessionParts, SimpleNamespace(hand=hand))
    return subject, hand


def test_bumps_cost_more_the_larger_they_are_are_noticed_and_mended() -> None:
    subject, hand = stage()
    result = drifting(subject)
    (table,) = result.tables
    unnoticed = [float(row[2] or 0) for row in table.rows if row[0] == "a projector"]
    assert unnoticed[-1] > unnoticed[0] + 0.5
    assert [criterion.holds for criterion in result.criteria] == [True, True, True, True]
    noticed = [row[4] for row in table.rows].count(True)
    assert noticed > 2 * len(LEVELS_PX)
    assert len(hand.done) == noticed + 1, "each is corrected quickly, and one in full"
    assert f"after {noticed} of {noticed} noticed bumps" in result.criteria[-1].reached
    assert hand.changes == ()


def test_costly_bumps_that_nobody_notices_wrong_names_and_bad_mending_are_told_as_misses() -> None:
    _, hand = stage()
    hand.disturb({"what": "camera", "shift_px": (5.0, 0.0)})
    blind = hand.drift("quiet")
    found = [BumpResult("a projector", 5.0, (9.0, 9.0), False, False, 0.0, (4.0, 4.0), 9, (1.2, 2.0), 95),
             BumpResult("the camera", 5.0, None, False, False, 0.0)]  # fmt: skip
    undisturbed, noticed, named, mended = _criteria((1.0, 2.0), blind, found)
    assert not undisturbed.holds
    assert not noticed.holds
    assert not named.holds
    assert "the camera by 5 px" in named.reason
    assert not mended.holds


def test_a_bump_that_only_the_worst_pixels_show_is_costly_and_without_any_costly_one_nothing_holds() -> None:
    _, hand = stage()
    quiet = hand.drift("quiet")
    mended = BumpResult("a projector", 5.0, (1.1, 3.1), False, True, 5.0, (1.0, 2.6), 9)
    _, noticed, _, again = _criteria((1.0, 2.0), quiet, [mended])
    assert (noticed.holds, noticed.reached) == (False, "0 of 1")
    assert again.holds is False, "0.6 more in 95 %"
    cheap = BumpResult("a projector", 5.0, (1.1, 2.1), False, True, 5.0, (1.0, 2.0), 9)
    assert _criteria((1.0, 2.0), quiet, [cheap])[1].holds is False


def test_photographs_are_counted_for_every_way_to_calibrate() -> None:
    subject, hand = stage()
    result = effort(subject)
    (table,) = result.tables
    assert column(table, "photographs a projector") == [30, 46, 66, 94, 174]
    assert len(hand.done) == 5
    assert result.criteria[1].holds


def test_every_disturbance_grows_until_the_error_has_doubled_and_one_that_cannot_be_calibrated_is_shown() -> None:
    subject, hand = stage()
    result = robustness(subject)
    breaking, table = result.tables
    by = {(row[0], row[1]): dict(zip(table.columns, row, strict=True)) for row in table.rows}
    assert by["highlights", 0.05]["why not"] == "The object mirrors."
    assert by["highlights", 0.05]["95 %"] is None
    assert ("highlights", 1.0) not in by, "it had broken before"
    base = by["none", None]
    median, most = (float(str(base[name])) for name in ("CIEDE2000 median", "95 %"))
    for one in DISTURBANCES:
        levels = [level for name, level in by if name == one.name]
        assert one.limit in levels
        last = by[one.name, levels[-1]]
        if levels[-1] != one.levels[-1] and last["95 %"] is not None:
            assert float(str(last["CIEDE2000 median"])) > 1.9 * median
            assert float(str(last["95 %"])) > 1.9 * most
    doubles = dict(zip(column(breaking, "disturbance"), column(breaking, "the median doubles at"), strict=True))
    assert 1.0 < float(str(doubles["gamma error"])) <= 1.2
    assert doubles["lamp flicker"] == "not at 0.3", "the stage in arrays knows no lamps"
    holds = {one.asked.split(" of ")[0]: one.holds for one in result.criteria}
    assert holds["lamp flicker"]
    assert holds["highlights"] is False
    assert hand.changes == ()


@pytest.mark.parametrize(
    "failure",
    [
        WorkError("no-space", what="The disk has no space.", remedy="Free some."),
        WorkError("run-too-slow", what="The run took too long.", remedy="Start it again."),
        UsageError("response-missing", what="There is no response.", remedy="Measure it."),
        DeviceError("camera-silent", what="The camera is silent.", remedy="Switch it on."),
    ],
    ids=lambda failure: type(failure).__name__,
)
def test_what_fails_for_another_reason_than_the_calibration_is_no_result(failure: Exception) -> None:
    subject, hand = stage()
    hand.fails["camera-noise-10"] = failure
    with pytest.raises(type(failure)) as raised:
        robustness(subject)
    assert raised.value is failure
    assert hand.done[-1] == "camera-noise-10", "nothing is measured after it"
    assert hand.changes == (), "the stage is left as it was"


def _trial(in_reach: tuple[float, float], lit: tuple[float, float]) -> Trial:
    pixels = {"in_reach": PixelSet(*in_reach, 0.3), "lit": PixelSet(*lit, 0.0)}
    nothing = np.zeros((1, 1, 3), np.float32)
    wanted = ReachableTarget(nothing, np.ones((1, 1), np.bool_), 1.0)
    return Trial(wanted, (), nothing, Quality(*in_reach, 0.0, 1.0, 1.0, pixels))


def test_pixels_that_a_disturbance_takes_out_of_reach_count_as_error() -> None:
    base, now = _trial((1.0, 5.0), (1.2, 10.0)), _trial((1.1, 5.5), (3.0, 15.0))
    result = DisturbanceResult(DISTURBANCES[2], 0.15, now, 1.0)
    assert result.times(base) == (2.5, 1.5)
    assert doubles_at(base, [result], 0) == pytest.approx(0.1)
    assert doubles_at(base, [result], 1) is None


def test_a_visitors_shadow_covers_the_asked_share_of_the_object() -> None:
    subject, _ = stage()
    (shadow,) = (one for one in DISTURBANCES if one.name == "a visitor's shadow")
    assert shadow.after is not None
    first = subject.calibration.projectors[0]
    rows_columns = np.argwhere(first.metapixels.valid)
    for level in (0.15, 0.4):
        (change,) = shadow.after(subject, level)
        assert change["name"] == first.name
        covered = rows_columns[:, 1] < float(change["shadow"]) * first.metapixels.valid.shape[1]
        assert covered.mean() == pytest.approx(level, abs=0.1)


@pytest.mark.parametrize("bits", [1.0, 4.0, 8.0])
def test_quantised_frames_have_as_many_values_as_their_bits_allow(bits: float) -> None:
    frame = np.linspace(0, 1, 60_000, dtype=np.float32).reshape(100, 200, 3)
    (coarse,) = quantised([frame], bits)
    assert 2**bits - 1 <= len(np.unique(coarse)) <= 2**bits  # the lowest step of eight bits is narrower than a sample
    assert np.abs(coarse - frame).max() < 2.2 * 0.5 / (2**bits - 1) + 1e-6
