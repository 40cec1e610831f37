"""Appearances on a stage in arrays: what is made, what is left out, and what is reported of it."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from controller.core.arrays import FloatImage
from controller.core.errors import UsageError, WorkError
from controller.optics.solve.targets.values import Target
from controller.optics.transport import build_transport
from controller.stage.blender.run import Blender
from lab.study.experiments.appearances import experiment, targets
from lab.study.experiments.appearances.experiment import LeftOut, PhotographedLook, appearances
from lab.study.experiments.appearances.targets import LOOKS, Look, leaves, rendered
from lab.study.subject.measuring import Quality
from lab.study.subject.subject import ReachableTarget, SessionParts, Subject
from lab.study.values import column
from tests.lab.study.array_stage import ArrayLight, array_subject

BY_US = tuple(look for look in LOOKS if look.made_by != targets.BLENDER)


def untold(fraction: float, note: str) -> None:
    pass


def stage() -> Subject:
    """A projector stands where the camera does, so that the object's own paint can be determined."""
    subject = array_subject()
    subject.geometry = dataclasses.replace(subject.geometry, projectors=(subject.geometry.camera,))
    return subject


def with_folder(folder: Path) -> Subject:
    subject = stage()
    subject.parts = cast(SessionParts, SimpleNamespace(context=SimpleNamespace(folder=folder)))
    return subject


def no_blender() -> Blender:
    raise UsageError("blender-missing", what="Blender was not found.", remedy="Install it.")


def test_without_blender_its_looks_are_left_out_and_told_and_the_others_are_made(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(targets, "find_blender", no_blender)
    some = (BY_US[0], BY_US[4], *(look for look in LOOKS if look.made_by == targets.BLENDER))
    monkeypatch.setattr(experiment, "LOOKS", some)
    subject = with_folder(tmp_path)
    result = appearances(subject)
    made, *others, dimmed = result.criteria
    assert made.holds is False
    assert made.reached == f"2 of {len(some)}"
    assert made.reason.count("Blender was not found.") == 4
    assert len(others) == 2
    assert all(look in one.reached for one in others for look in ("of 2: gloss", "; leaves added"))
    assert dimmed.holds
    assert column(result.tables[0], "state").count("left out") == 4
    assert isinstance(subject.light, ArrayLight)
    assert subject.light.names == [f"{name}-{way}" for name in ("gloss", "leaves")
                                   for way in ("ours", "one", "one-dimmed")]  # fmt: skip
    assert [figure.name for figure in result.figures] == ["photographs-1"]
    errors = {(row[0], row[2], row[3]): float(row[5] or 0) for row in result.tables[1].rows}
    assert errors["gloss", "ours", "in reach"] < errors["gloss", "one projector", "in reach"]
    assert errors["gloss", "ours", "in reach"] < 4
    for compared in ("all lit pixels", "whole visible object"):
        assert errors["gloss", "ours", compared] < errors["gloss", "one projector", compared]


def test_a_stage_that_fails_is_not_told_as_a_look_that_was_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    subject = array_subject()

    def broken(name: str, frames: object, *, white: float) -> FloatImage:
        raise WorkError("dark", what="The lamp went out.", remedy="Change it.")

    monkeypatch.setattr(experiment, "LOOKS", (BY_US[0],))
    monkeypatch.setattr(subject.light, "photograph", broken)
    with pytest.raises(WorkError, match="lamp"):
        appearances(subject)


@pytest.mark.parametrize("look", BY_US, ids=lambda look: look.name)
def test_a_target_says_something_of_most_of_the_object_in_reflectances(look: Look) -> None:
    subject = stage()
    target = look.make(subject, untold)
    assert target.mask[subject.mask].mean() > 0.95
    assert not target.mask[~subject.mask].any()
    inside = target.image[target.mask]
    assert np.isfinite(inside).all()
    assert inside.min() >= 0
    assert inside.max() <= 1
    assert inside.mean() > 0.03


def test_recolouring_exchanges_red_and_blue_and_new_light_comes_from_its_side() -> None:
    subject = stage()
    bluish = np.array([0.3, 0.5, 0.9], np.float32)
    parts = tuple(
        dataclasses.replace(part, white=np.asarray(part.white * bluish, np.float32))
        for part in subject.calibration.projectors
    )
    subject.calibration = dataclasses.replace(subject.calibration, projectors=parts)
    subject.transport = build_transport(subject.calibration)
    by = {look.name: look.make(subject, untold) for look in BY_US if look.name in ("recoloured", "light")}
    red, _, blue = by["recoloured"].image[by["recoloured"].mask].mean(axis=0)
    assert red > 2 * blue
    lit = by["light"].image.mean(axis=2)
    assert lit[48, 100] > 1.5 * lit[48, 28]


def test_leaves_cover_some_of_a_surface_each_in_one_piece_with_ribs() -> None:
    y, x = np.mgrid[-0.1:0.1:240j, -0.1:0.1:240j].astype(np.float32)
    covered = leaves(x.ravel(), y.ravel(), cell_m=0.05, coloured=False)
    colours = leaves(x.ravel(), y.ravel(), cell_m=0.05, coloured=True)
    assert set(np.unique(covered)) == {0.0, 1.0}
    assert 0.1 < covered.mean() < 0.6
    assert ((colours > 0).all(axis=1) == (covered[:, 0] > 0)).all()
    found = np.unique(colours[covered[:, 0] > 0], axis=0)
    assert len(found) == 2
    assert (found[:, 1] > found[:, 0]).all()
    moved = leaves(x.ravel() + np.float32(0.05), y.ravel(), cell_m=0.05, coloured=False)
    assert (moved != covered).mean() > 0.05  # no leaf is a copy of its neighbour


def test_a_picture_that_was_rendered_is_not_rendered_again_unless_the_job_changed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    jobs: list[bytes] = []

    def fake(blender: Blender, folder: Path, advance: Callable[[float, str], None]) -> Path:
        jobs.append((folder / "job.json").read_bytes())
        (folder / "picture.exr").write_bytes(b"a picture")
        return folder / "picture.exr"

    def half_grey(pictures: object, cameras: object, masks: list[FloatImage]) -> list[Target]:
        return [Target(np.full((*mask.shape, 3), 0.5, np.float32), mask.astype(np.bool_)) for mask in masks]

    monkeypatch.setattr(targets, "find_blender", lambda: Blender(("blender",)))
    monkeypatch.setattr(targets, "render", fake)
    monkeypatch.setattr(targets, "read_picture", lambda path: path.read_bytes())
    monkeypatch.setattr(targets, "as_seen", half_grey)
    subject = with_folder(tmp_path)
    for _ in range(2):
        rendered(subject, untold, scene="marble")
    assert len(jobs) == 1
    subject.seed = 2
    target = rendered(subject, untold, scene="marble")
    assert len(jobs) == 2
    assert b'"builtin": "marble"' in jobs[0]
    assert float(target.image.max()) == 0.5
    (tmp_path / "study-render-marble" / "picture.exr").unlink()
    rendered(subject, untold, scene="marble")
    assert len(jobs) == 3


def shown(look: Look, ours: float, model: float, alone: float) -> PhotographedLook:
    nothing = np.zeros((2, 2, 3), np.float32)
    of = partial(Quality, delta_e_p95=0.0, rmse=0.0, ssim=1.0, sharpness=1.0)
    return PhotographedLook(
        look, ReachableTarget(nothing, np.ones((2, 2), np.bool_), 1.0), 1.0, nothing, nothing, of(ours), of(ours),
        {}, {}, of(model), of(alone), 0.5, of(alone), of(ours), 1.0,
    )  # fmt: skip


def test_what_misses_its_goal_says_whether_the_solve_or_the_calibration_does() -> None:
    made = [shown(LOOKS[0], 5.0, 4.5, 20.0), shown(LOOKS[1], 5.0, 1.0, 20.0), shown(LOOKS[2], 1.0, 0.5, 2.0)]
    far = dataclasses.replace(made[2].ours, delta_e_p95=4.1)
    assert not experiment._criteria([dataclasses.replace(made[2], ours=far)], [])[1].holds, "the median hides it"
    criteria = experiment._criteria(made, [LeftOut(LOOKS[5], "No Blender.")])
    assert [one.holds for one in criteria] == [False, False, False, False]
    assert "translucent marble: No Blender." in criteria[0].reason
    assert criteria[1].reached.startswith("1 of 3: gloss 5.00 and 0.0 on 100% of the object")
    assert "gloss: by the model, too, these frames come no nearer than 4.50 in the median" in criteria[1].reason
    assert "novel light: by the model 1.00 in the median" in criteria[1].reason
    assert "recoloured" not in criteria[1].reason
    assert criteria[2].reached.startswith("2 of 3: ")
    assert "recoloured 2.00 to 1.00, 2.0 times" in criteria[2].reached
    assert "recoloured: half of it is within 2.00 with one projector" in criteria[2].reason
    assert criteria[3].reason == "Not nearer: gloss, novel light, recoloured."  # in RMSE and SSIM they are alike
