from __future__ import annotations

import dataclasses
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, cast

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from controller.optics.calibrate.verify.drift import Drift, DriftCause, ProjectorDrift
from controller.optics.calibrate.verify.drift_report import advice, drift_from_json, drift_to_json, sentences
from controller.optics.calibrate.verify.registration import Motion, no_motion
from controller.run.journal import Journal
from controller.run.runner import Context, Runner, Step
from controller.run.step_id import StepId
from controller.stage.artefacts.calibrated import Calibrated
from controller.stage.artefacts.drift import write_drift
from controller.stage.artefacts.kinds import white_of
from controller.stage.steps.calibrate.quick import Reuse, chosen, reuse_for_one, reuse_of
from hal.deadline import in_seconds
from tests.controller.stage.artefacts.names import projectors

if TYPE_CHECKING:
    from controller.stage.rig.rig import Rig

STILL = Motion(
    np.eye(3), (10.0, 10.0), (0.0, 0.0), 0.005, 0.01, 0.0, 0.001, 1.0, 1e-5, (1.0, 1.0, 1.0), 0.99, found=True
)
MOVED = dataclasses.replace(STILL, shift_px=(2.0, -1.0), rms_px=2.2)
LOST = no_motion((20, 20), 3)


def projector(name: str, motion: Motion = STILL, gain: float = 1.0, local_px: float = 0.02) -> ProjectorDrift:
    return ProjectorDrift(name, motion, (gain, gain, gain), (0.001, 0.001, 0.001), local_px, gain)


def drift(
    *projectors: ProjectorDrift, culprit: DriftCause = DriftCause.NONE, ambient: float = 0.0, camera: Motion = STILL
) -> Drift:
    return Drift((projector("a"), *projectors), camera, culprit, ambient, 1.0)


def test_nothing_is_repeated_when_nothing_has_changed() -> None:
    found = drift(projector("b"))
    assert advice(found) == "nothing"
    assert {
        reuse_of(step, found)
        for step in (StepId("black"), StepId("light", "a"), StepId("pixels", "b"), StepId("geometry"))
    } == {Reuse.KEEP}


@pytest.mark.parametrize(
    ("bumped", "ways"),
    [
        (projector("b", gain=0.9), {"light": Reuse.CORRECT, "indirect": Reuse.CORRECT, "pixels": Reuse.KEEP}),
        (projector("b", MOVED), {"light": Reuse.CORRECT, "codes": Reuse.KEEP, "indirect": Reuse.CORRECT}),
        (projector("b", MOVED, local_px=0.8), {"light": Reuse.RUN, "codes": Reuse.RUN, "pixels": Reuse.RUN}),
        (projector("b", LOST), {"light": Reuse.RUN, "codes": Reuse.RUN, "pixels": Reuse.RUN}),
    ],
)
def test_only_the_projector_that_changed_is_repeated(bumped: ProjectorDrift, ways: dict[str, Reuse]) -> None:
    found = drift(bumped)
    assert advice(found) == "quick"
    assert {kind: reuse_of(StepId(kind, "b"), found) for kind in ways} == ways
    assert (reuse_of(StepId("light", "a"), found), reuse_of(StepId("codes", "a"), found)) == (Reuse.KEEP, Reuse.KEEP)
    for kind in ("shape", "geometry"):
        assert (reuse_of(StepId(kind), found) is Reuse.RUN) == bool(found.moved)


def test_white_is_photographed_by_the_step_of_the_light_where_a_projector_dimmed() -> None:
    assert reuse_of(white_of("b"), drift(projector("b", gain=0.9))) is Reuse.KEEP
    assert reuse_of(white_of("b"), drift(projector("b", LOST))) is Reuse.RUN
    assert reuse_of(white_of("a"), drift(projector("b", LOST))) is Reuse.KEEP


def test_a_calibration_whose_light_has_its_white_is_kept_without_photographs(tmp_path: Path) -> None:
    """As earlier versions photographed it."""
    last, now = tmp_path / "last", tmp_path / "now"
    for folder in (last, now):
        folder.mkdir()

    def fails(context: Context) -> list[Path]:
        raise AssertionError("white was photographed again")

    with Journal(last):
        pass
    write_drift(now, drift(projector("b", gain=0.9)), calibration="last", photographs=3)
    with Journal(now) as journal:
        before = Step(StepId("drift"), lambda context: [])
        steps = [chosen(cast("Rig", None), Calibrated(last, ["a", "b"]), Step(white_of(name), fails)) for name in "ab"]
        results = Runner([before, *steps], journal).run("recalibrate", deadline=in_seconds(60))
    assert [results[white_of(name)] for name in "ab"] == [(), ()]


def test_a_projector_measured_with_dots_gets_new_ones_when_it_moved() -> None:
    assert reuse_of(StepId("pixels", "b"), drift(projector("b", MOVED)), "paper") is Reuse.RUN


@pytest.mark.parametrize("culprit", [DriftCause.CAMERA, DriftCause.OBJECT, DriftCause.UNKNOWN])
def test_all_is_repeated_when_camera_or_object_moved_and_it_is_said(culprit: DriftCause) -> None:
    found = drift(culprit=culprit, camera=MOVED)
    assert reuse_of(StepId("codes", "a"), found) is Reuse.RUN
    assert "full calibration" in sentences(found)[-1]


def test_a_dark_projector_is_for_a_person_to_look_after() -> None:
    found = drift(ProjectorDrift("b", LOST, (np.nan,) * 3, (np.nan,) * 3, np.nan, 0.01))
    assert advice(found) == "look"
    assert "b is dark" in sentences(found)[0]


def test_a_drift_survives_json_with_what_could_not_be_found() -> None:
    found = drift(projector("b", LOST), camera=MOVED, ambient=0.02)
    again = drift_from_json(drift_to_json(found, calibration="run", photographs=5))
    assert sentences(again) == sentences(found)
    assert again.moved == ("b",)


KINDS = ("light", "codes", "pixels")


def steps_of(names: list[str], done: list[StepId]) -> list[Step]:
    """A full calibration in miniature: each step writes a file of its own and notes that it ran."""

    def writes(one: StepId, number: int) -> Callable[[Context], list[Path]]:
        def run(context: Context) -> list[Path]:
            done.append(one)
            (context.folder / f"{number}.bin").write_bytes(repr(one).encode())
            return [context.folder / f"{number}.bin"]

        return run

    ids = [StepId("black"), *(StepId(kind, name) for name in names for kind in KINDS), StepId("geometry")]
    return [Step(one, writes(one, number)) for number, one in enumerate(ids)]


def bumps(names: list[str]) -> st.SearchStrategy[tuple[list[str], list[str], list[str]]]:
    """A stage's projectors, those that moved, and the order in which the drift check lists them."""
    moved = st.lists(st.sampled_from(names), min_size=1, unique=True)
    return st.tuples(st.just(names), moved, st.permutations(names))


@settings(max_examples=10, deadline=None)
@example((["left", "top-left"], ["left"], ["left", "top-left"]))
@example((["left", "top-left"], ["top-left"], ["left", "top-left"]))
@example((["light", "codes", "light-codes"], ["codes"], ["codes", "light", "light-codes"]))
@given(projectors.flatmap(bumps))
def test_exactly_the_projectors_that_moved_are_repeated_whatever_they_are_called(
    stage: tuple[list[str], list[str], list[str]],
) -> None:
    names, moved, shuffled = stage
    found = Drift(
        tuple(projector(name, MOVED, local_px=0.8) if name in moved else projector(name) for name in shuffled),
        STILL, DriftCause.NONE, 0.0, 1.0,
    )  # fmt: skip
    done: list[StepId] = []
    with tempfile.TemporaryDirectory() as place:
        last, now = Path(place) / "last", Path(place) / "now"
        for folder in (last, now):
            folder.mkdir()
        with Journal(last) as journal:
            Runner(steps_of(names, done), journal).run("calibrate", deadline=in_seconds(60))
        done.clear()
        write_drift(now, found, calibration="last", photographs=3)
        with Journal(now) as journal:
            before = Step(StepId("drift"), lambda context: [])
            rig, calibrated = cast("Rig", None), Calibrated(last, names)
            steps = [before, *(chosen(rig, calibrated, step) for step in steps_of(names, done))]
            Runner(steps, journal).run("recalibrate", deadline=in_seconds(60))
        assert set(done) == {StepId("black"), StepId("geometry"), *(StepId(k, name) for name in moved for k in KINDS)}
        for name in names:
            way = reuse_of(StepId("radiometry", name), found)
            assert way is (Reuse.RUN if name in moved else Reuse.CORRECT), "black is photographed again for all"
        for number, step in enumerate(steps[1:]):
            assert (now / f"{number}.bin").samefile(last / f"{number}.bin") is (step.id not in done)


@given(projectors, st.data())
def test_one_projector_is_recalibrated_and_no_other(names: list[str], data: st.DataObject) -> None:
    one = data.draw(st.sampled_from(names))
    for name in names:
        ways = {kind: reuse_for_one(StepId(kind, name), one) for kind in (*KINDS, "radiometry")}
        kept = {**dict.fromkeys(KINDS, Reuse.KEEP), "radiometry": Reuse.CORRECT}
        assert ways == (dict.fromkeys(ways, Reuse.RUN) if name == one else kept)
