"""The methods that are entered, on a stage in arrays."""

from __future__ import annotations

import numpy as np
import pytest

from lab.compare.entries import BUILT_IN
from lab.compare.evaluation import Evaluation, evaluate, fixed_targets
from lab.compare.methods import divided, feathers
from lab.study.subject.subject import ReachableTarget, Subject
from tests.lab.compare.arena import ArrayShower, counted
from tests.lab.study.array_stage import CAMERA, array_subject

EVERYWHERE = tuple(entry for entry in BUILT_IN if entry.name != "superresolution")
"""Those that need no plane and no lens, which this stage has not; see test_planar."""


@pytest.fixture(scope="module")
def subject() -> Subject:
    return array_subject()


@pytest.fixture(scope="module")
def found(subject: Subject) -> dict[str, Evaluation]:
    """Each method on one smooth target that all of them can reach, one projector alone too."""
    y, x = np.mgrid[0 : CAMERA[0], 0 : CAMERA[1]] / 20.0
    wave = (0.25 + 0.1 * np.sin(x) * np.cos(y)).astype(np.float32)
    image = wave[..., None] * np.array([1.0, 0.9, 0.8], np.float32)
    inner = np.zeros_like(subject.mask)
    inner[24:-24, 24:-24] = True
    targets = {"wave": ReachableTarget(image, inner, 0.5, None, subject.mask)}
    judged = {}
    for entry in EVERYWHERE:
        shower = ArrayShower(subject)
        judged[entry.name] = evaluate(entry, counted(subject, shower, most=400), targets, shower)
    return judged


@pytest.mark.parametrize("name", [entry.name for entry in EVERYWHERE])
def test_every_method_makes_an_easy_target(found: dict[str, Evaluation], name: str) -> None:
    judged = found[name]
    assert judged.failed is None
    (score,) = judged.scores
    assert score.failed is None
    median = score.pixels["in_reach"].delta_e00_median
    assert median is not None
    assert median < 1.5


def test_each_pays_for_the_photographs_that_it_needs(found: dict[str, Evaluation]) -> None:
    all_projectors, dots, own = 5 + 60, 600, 2 * (1 + 9)
    assert {name: judged.photographs for name, judged in found.items()} == {
        "ours": all_projectors,
        "paper": all_projectors + dots,
        "inversion": all_projectors + dots,
        "feathering": all_projectors + own,
        "single": 5 + 10 + own,
        "regression": 2 * (3 + 120),
    }


def test_feathers_add_up_and_end_where_the_light_ends() -> None:
    left, right = np.zeros((20, 60), np.bool_), np.zeros((20, 60), np.bool_)
    left[:, :40] = right[:, 20:] = True
    a, b = feathers([left, right])
    assert np.allclose((a + b), 1)
    assert (a[:, 40:] == 0).all()
    assert (b[:, :20] == 0).all()
    assert np.allclose(a[10, 28:32], b[10, 31:27:-1])
    assert a[10, 21] > 0.8 > 0.2 > a[10, 38]


def test_division_undoes_each_pixels_own_mixing_of_colours(subject: Subject) -> None:
    rng = np.random.default_rng(3)
    part = subject.calibration.projectors[0]
    mixing = np.diag([0.5, 0.4, 0.6]) + rng.uniform(0, 0.08, (3, 3))
    colours = np.broadcast_to(mixing, (*CAMERA, 3, 3))
    light = np.broadcast_to(np.float32(mixing @ [0.2, 0.5, 0.7]), (*CAMERA, 3))
    assert np.allclose(divided(part, colours, light), [0.2, 0.5, 0.7], atol=1e-5)
    blind = np.zeros((*CAMERA, 3, 3))
    assert (divided(part, blind, light) == 1).all()
    assert (divided(part, blind, np.zeros_like(light)) == 0).all()


def test_the_fixed_targets_are_in_reach_and_the_dim_one_is_darker(subject: Subject) -> None:
    targets = fixed_targets(subject)
    assert list(targets) == ["grey", "checkerboard", "photograph", "photograph-dim"]
    assert targets["photograph-dim"].white < 0.6 * targets["photograph"].white
    for wanted in targets.values():
        assert wanted.mask.sum() > 0.5 * subject.mask.sum()
        assert np.isfinite(wanted.radiance).all()
    part = np.zeros_like(subject.mask)
    part[20:50, 30:90] = True
    for wanted in fixed_targets(subject, part).values():
        assert not (wanted.valid & ~part).any()
        assert not (wanted.mask & ~part).any()
        assert (wanted.mask & part).sum() > 0.5 * (subject.mask & part).sum()
    inside = targets["grey"].radiance[subject.mask]
    assert np.allclose(inside, inside[0])
    assert np.ptp(targets["checkerboard"].radiance[subject.mask]) > 0.5 * targets["checkerboard"].white
