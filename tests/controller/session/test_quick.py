from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from controller.calibrate.drift import Culprit, Drift, ProjectorDrift
from controller.calibrate.drift_report import advice, drift_from_json, drift_to_json, sentences
from controller.calibrate.registration import Motion, nowhere
from controller.session.quick import Way, way_of

STILL = Motion(
    np.eye(3), (10.0, 10.0), (0.0, 0.0), 0.005, 0.01, 0.0, 0.001, 1.0, 1e-5, (1.0, 1.0, 1.0), 0.99, found=True
)
MOVED = dataclasses.replace(STILL, shift_px=(2.0, -1.0), rms_px=2.2)
LOST = nowhere((20, 20), 3)


def projector(name: str, motion: Motion = STILL, gain: float = 1.0, local_px: float = 0.02) -> ProjectorDrift:
    return ProjectorDrift(name, motion, (gain, gain, gain), (0.001, 0.001, 0.001), local_px, gain)


def drift(
    *projectors: ProjectorDrift, culprit: Culprit = Culprit.NOBODY, ambient: float = 0.0, camera: Motion = STILL
) -> Drift:
    return Drift((projector("a"), *projectors), camera, culprit, ambient, 1.0)


def test_nothing_is_repeated_when_nothing_has_changed() -> None:
    found = drift(projector("b"))
    assert advice(found) == "nothing"
    assert {way_of(step, found) for step in ("black", "light-a", "pixels-b", "geometry")} == {Way.KEEP}


@pytest.mark.parametrize(
    ("bumped", "ways"),
    [
        (projector("b", gain=0.9), {"light": Way.CORRECT, "codes": Way.KEEP, "pixels": Way.KEEP}),
        (projector("b", MOVED), {"light": Way.CORRECT, "codes": Way.KEEP, "pixels": Way.CORRECT}),
        (projector("b", MOVED, local_px=0.8), {"light": Way.RUN, "codes": Way.RUN, "pixels": Way.RUN}),
        (projector("b", LOST), {"light": Way.RUN, "codes": Way.RUN, "pixels": Way.RUN}),
    ],
)
def test_only_the_projector_that_changed_is_repeated(bumped: ProjectorDrift, ways: dict[str, Way]) -> None:
    found = drift(bumped)
    assert advice(found) == "quick"
    assert {kind: way_of(f"{kind}-b", found) for kind in ways} == ways
    assert (way_of("light-a", found), way_of("codes-a", found)) == (Way.KEEP, Way.KEEP)
    assert (way_of("geometry", found) is Way.RUN) == bool(found.moved)


def test_a_projector_measured_with_dots_gets_new_ones_when_it_moved() -> None:
    assert way_of("pixels-b", drift(projector("b", MOVED)), "paper") is Way.RUN


@pytest.mark.parametrize("culprit", [Culprit.CAMERA, Culprit.OBJECT, Culprit.UNKNOWN])
def test_all_is_repeated_when_camera_or_object_moved_and_it_is_said(culprit: Culprit) -> None:
    found = drift(culprit=culprit, camera=MOVED)
    assert way_of("codes-a", found) is Way.RUN
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
