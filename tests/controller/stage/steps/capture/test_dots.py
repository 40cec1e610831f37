"""Hundreds of photographs of dots: in batches, resumed at any of them, refused before the first if they don't fit."""

from __future__ import annotations

import dataclasses
import shutil
import threading
from collections import namedtuple
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from controller.core.arrays import save_arrays
from controller.core.errors import UsageError, WorkError
from controller.optics.capture.patterns import dot_frame, dot_patterns
from controller.run.journal import Journal
from controller.run.progress import Silent
from controller.run.runner import Context
from controller.stage.artefacts.photographs import PhotographSet, codes_of
from controller.stage.artefacts.projectors import mode_of, read_metapixels
from controller.stage.rig.rig import Rig
from controller.stage.steps.capture.dots import (
    BATCH,
    check_disk,
    of_sinusoids,
    planned,
    read_batches,
    spacing_of,
    take_in_batches,
)
from controller.stage.steps.capture.photographs import Planned, take_all
from controller.stage.steps.modes import DotOptions, dot_options, mode_step
from hal.deadline import Cancelled, in_seconds
from tests.controller.stage.rig.rig_model import ModelRig

R = 5
DOTS = PhotographSet("dots", "left")


@pytest.fixture
def stage(tmp_path: Path) -> ModelRig:
    return ModelRig(tmp_path)


@pytest.fixture
def told() -> list[float]:
    return []


@pytest.fixture
def context(tmp_path: Path, told: list[float]) -> Iterator[Context]:
    with Journal(tmp_path / "run") as journal:
        yield Context(
            journal.folder, journal, in_seconds(60), Silent(), {}, lambda fraction, note: told.append(fraction)
        )


def wide(stage: ModelRig) -> Rig:
    """The model's rig with projectors that have room for a grid of dots."""
    projectors = tuple(dataclasses.replace(projector, size_px=(8, 6)) for projector in stage.rig.projectors)
    return dataclasses.replace(stage.rig, projectors=projectors)


def plan(stage: ModelRig) -> list[Planned]:
    projector = wide(stage).projectors[0]
    return [
        planned(projector, pattern.name, partial(dot_frame, pattern, projector.size_px), 0.5)
        for pattern in dot_patterns(projector.size_px, R)
    ]


def test_every_pixel_is_lit_once_and_progress_never_goes_back(
    stage: ModelRig, context: Context, told: list[float]
) -> None:
    take_in_batches(wide(stage), context, plan(stage), into=DOTS)
    lit = np.sum([frames["P1"] > 0 for frames in stage.display.shown], axis=0)
    assert (lit == 1).all()
    assert told == sorted(told)
    assert told[-1] < 1
    names = [taken.name for taken in read_batches(context.folder, DOTS, R * R)]
    assert names == [one.name for one in plan(stage)]
    assert R * R > BATCH


def test_a_stop_in_the_second_batch_costs_no_photograph_of_the_first(stage: ModelRig, context: Context) -> None:
    shots = plan(stage)
    stop = threading.Event()
    stopping = Context(
        context.folder,
        context.journal,
        in_seconds(60, stop),
        Silent(),
        {},
        lambda fraction, note: stop.set() if note == shots[BATCH + 3].name else None,
    )
    with pytest.raises(Cancelled):
        take_in_batches(wide(stage), stopping, shots, into=DOTS)
    before = len(stage.camera.taken)
    assert before >= BATCH + 3
    take_in_batches(wide(stage), context, shots, into=DOTS)
    assert len(set(stage.camera.taken)) == len(stage.camera.taken) == R * R


def test_a_full_disk_is_told_before_the_first_photograph(
    stage: ModelRig, context: Context, monkeypatch: pytest.MonkeyPatch
) -> None:
    projector = stage.rig.projectors[0]
    take_all(wide(stage), context, plan(stage)[:1], into=codes_of(projector.name))
    check_disk(context.folder, DOTS, 10)
    usage = namedtuple("usage", "total used free")
    monkeypatch.setattr(shutil, "disk_usage", lambda folder: usage(10**9, 10**9, 1000))
    with pytest.raises(WorkError) as refused:
        check_disk(context.folder, DOTS, 256)
    assert refused.value.code == "no-space"


@pytest.mark.parametrize(
    ("mode", "spacing", "wanted"),
    [
        ("fast", None, DotOptions("fast", None)),
        ("paper", None, DotOptions("paper", 16)),
        ("paper", "6", DotOptions("paper", 6)),
        ("paper", "auto", DotOptions("paper", None)),
    ],
)
def test_a_mode_has_its_own_spacing_unless_one_is_given(mode: str, spacing: str | None, wanted: DotOptions) -> None:
    assert dot_options(mode, spacing) == wanted


@pytest.mark.parametrize(
    ("mode", "spacing", "code"),
    [
        ("slow", None, "calibration-mode-unknown"),
        ("auto", None, "calibration-mode-unknown"),
        ("fast", "6", "dot-spacing-unused"),
        ("fast", "auto", "dot-spacing-unused"),
        ("paper", "3", "dot-spacing-wrong"),
        ("paper", "six", "dot-spacing-wrong"),
        ("paper", "-6", "dot-spacing-wrong"),
        ("paper", "²", "dot-spacing-wrong"),
    ],
)
def test_wrong_options_are_refused_in_words(mode: str, spacing: str | None, code: str) -> None:
    with pytest.raises(UsageError) as refused:
        dot_options(mode, spacing)
    assert refused.value.code == code


def write_metapixels(path: Path, spacing: float, sigma: float) -> None:
    y, x = np.mgrid[0:20, 0:30].astype(np.float32)
    centre = spacing * np.stack([x, y], axis=-1)
    covariance = np.broadcast_to(np.array([sigma**2, 0, sigma**2], np.float32), (20, 30, 3))
    seen = np.ones((20, 30), np.bool_)
    rest = {"projector_px": centre, "modulation": centre[..., 0], "seen": seen, "reason": seen}
    save_arrays(path, {"centre_px": centre, "covariance_px2": covariance.copy(), "valid": seen, **rest})


def test_the_mode_of_a_run_says_which_metapixels_count(context: Context) -> None:
    write_metapixels(context.folder / "pixels-left.npz", 3.0, 1.0)
    write_metapixels(context.folder / "dots-left.npz", 3.0, 2.0)
    assert mode_of(context.folder) == "fast"
    for mode, sigma in (("fast", 1.0), ("paper", 2.0)):
        mode_step(dot_options(mode, None), ()).run(context)
        assert mode_of(context.folder) == mode
        assert read_metapixels(context.folder, "left").covariance_px2[3, 3, 0] == sigma**2


def test_the_spacing_follows_the_blur_and_stays_at_most_the_papers(context: Context) -> None:
    for sigma, wanted in ((3.0, 7), (4.5, 10), (30.0, 16)):
        write_metapixels(context.folder / "pixels-left.npz", 3.0, sigma)
        known = of_sinusoids(context.folder, "left")
        assert spacing_of(dot_options("paper", "auto"), known) == wanted
        assert spacing_of(dot_options("paper", "12"), known) == 12
