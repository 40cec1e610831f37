"""Experiments on a stage in arrays: that they run, measure what they say, and tell misses as misses."""

from __future__ import annotations

import dataclasses
import re
from functools import partial
from importlib import import_module
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from controller.core.arrays import FloatImage
from controller.optics.calibrate.values import PhaseMap
from controller.optics.capture.patterns import dot_patterns
from lab.study.catalogue import EXPERIMENTS, SCENES
from lab.study.experiments import ablation, earlier, live, plain_dots, residual_sweep
from lab.study.experiments.earlier import feathered
from lab.study.experiments.residual import BRIGHT, DIM, PAPER, ResidualResult, _criteria, residual
from lab.study.experiments.sharpness import local_sharpness
from lab.study.output.words import description
from lab.study.subject.dots import dots_as_shares, read_study_dots, write_study_dots
from lab.study.subject.measuring import Quality, Variant, unbounded_inverse
from lab.study.subject.subject import ReachableTarget
from lab.study.values import Experiment, column
from tests.controller.optics.transport.sparse_shares import gaussian_weights
from tests.lab.study.array_stage import CAMERA, ArrayLight, array_subject


def test_the_residual_is_photographed_at_both_exposures_over_all_that_is_lit() -> None:
    subject = array_subject()
    result = residual(subject)
    (table,) = result.tables
    assert column(table, "as bright as") == [BRIGHT] * 3 + [DIM] * 3
    assert column(table, "projectors") == [1, 2, 3] * 2
    photographed = [float(str(value)) for value in column(table, "photographed, mean")]
    # Where three reach it, one projector lacks light: that is what the figure is about.
    assert photographed[0] > 3 * photographed[2]
    assert photographed[5] < photographed[3]
    assert column(table, "all lit pixels leave out") == ["0.0%"] * 6
    assert all("softened by the camera's own blur" in str(cell) for cell in column(table, "target"))
    assert isinstance(subject.light, ArrayLight)
    assert subject.light.names == [f"{way}-{n}" for way in ("bright", "dim") for n in (1, 2, 3, "3-again")]


def made(exposure: str, count: int, model: float, shown: float, delta_e: float = 1.0) -> ResidualResult:
    picture = np.zeros((2, 2, 3), np.float32)
    wanted = ReachableTarget(picture, np.ones((2, 2), np.bool_), 1.0)
    by_model, by_photograph = (np.full((3, 3), value, np.float32) for value in (model, shown))
    return ResidualResult(exposure, count, wanted, picture, by_model, by_photograph, 0.004,
                          Quality(delta_e, 0, 0, 1, 1), 0.003)  # fmt: skip


def test_a_figure_above_the_papers_or_one_that_does_not_fall_is_a_miss_with_its_reason() -> None:
    bright = [made(BRIGHT, 1, 0.02, 0.03, 3.0), made(BRIGHT, 2, 0.012, 0.02, 2.0), made(BRIGHT, 3, 0.009, 0.01, 1.0)]
    dim = [made(DIM, 1, 0.005, 0.007, 0.3), made(DIM, 2, 0.004, 0.006, 0.4), made(DIM, 3, 0.003, 0.005, 0.2)]
    paper, falls, rises = _criteria([*bright, *dim])
    assert [paper.holds, falls.holds, rises.holds] == [False, True, False]
    one, two, three = (paper.reason.find(f"{count}: the solve itself is") for count in ("1 projector", "2 projectors",
                                                                                        "3 projectors"))  # fmt: skip
    assert one < 0 <= two < three
    assert "the calibration's error and noise" in paper.reason[two:three]
    assert "the solve itself is above 0.007" in paper.reason[three:]
    low = [made(BRIGHT, count, 0.001, 0.99 * asked, 1.0 / count) for count, asked in PAPER.items()]
    assert _criteria([*low, *dim])[0].holds
    assert rises.reason == "Does not fall each time: CIEDE2000."
    assert PAPER[3] == 0.007
    assert len(_criteria([*bright, made(BRIGHT, 4, 0.005, 0.007, 0.5), *dim])) == 2, "of four the paper says nothing"


def test_a_sweep_normalises_in_every_way_and_tells_where_the_papers_figures_are_met(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    target, mask = np.full((16, 16, 3), 0.25, np.float32), np.ones((16, 16), np.bool_)
    off = target + np.where(np.arange(16)[:, None] < 8, np.float32(0.1), 0)[..., None]
    found = residual_sweep.normalised(off, ReachableTarget(target, mask, 0.5), mask)
    assert list(found.values()) == pytest.approx([0.02**0.5, 0.02, 0.1, 0.08**0.5, 0.08], rel=1e-4)
    one = next(iter(residual_sweep.EXPOSURES))
    monkeypatch.setattr(residual_sweep, "SQUARES", (residual_sweep.USUAL,))
    monkeypatch.setattr(residual_sweep, "EXPOSURES", {one: 3})
    subject = array_subject()
    result = residual_sweep.sweep(subject)
    (table,) = result.tables
    assert len(table.rows) == 1 + len(residual_sweep.NORMALISED)
    assert isinstance(subject.light, ArrayLight)
    assert subject.light.names == ["8-0-1", "8-0-2", "8-0-3"]
    first, second = table.rows[1], table.rows[2]
    assert float(str(second[-2])) > float(str(first[-2])), "a square falls faster"
    made = residual_sweep.Combination(8, one, "its square", (0.06, 0.013, 0.008), (0.0, 0.0, 0.0))
    assert made.off == pytest.approx(0.06 / 0.051)
    met = residual_sweep._criteria([made, dataclasses.replace(made, shown=(0.06, 0.07, 0.08))])
    assert [each.holds for each in met] == [False, True]
    assert met[1].reached == f"8 squares, {one}, its square: 1.18 times"
    assert residual_sweep._criteria([dataclasses.replace(made, shown=(0.2, 0.1, 0.03))])[1].holds is False


def test_feathered_projectors_together_make_an_even_target() -> None:
    subject = array_subject()
    black = subject.calibration.black
    target = np.where(subject.mask[..., None], np.float32(0.3), black)
    frames = feathered(subject.calibration, target)
    light = subject.transport.forward(frames) + black
    inner = np.zeros_like(subject.mask)
    inner[16:-16, 16:-16] = True
    assert np.abs(light - target)[inner].max() < 0.03


def test_dots_become_the_shares_that_made_them() -> None:
    rows, columns, spacing = 10, 12, 4
    y, x = np.mgrid[0:40, 0:48] / 4.0 - 0.375
    seen = PhaseMap(np.stack([x, y], -1).astype(np.float32), np.zeros((rows, columns, 3), np.float32))
    white = np.full((40, 48, 3), 0.8, np.float32)
    patterns = dot_patterns((columns, rows), spacing)
    captures = {"black": np.full((40, 48, 3), 0.01, np.float32)}
    for pattern in patterns:
        near = [(np.asarray(v) - first + spacing / 2) % spacing - spacing / 2
                for v, first in ((x, pattern.column), (y, pattern.row))]  # fmt: skip
        share = np.exp(-0.5 * (near[0] ** 2 + near[1] ** 2) / 0.5**2)
        captures[pattern.name] = (0.01 + 0.8 * share[..., None] * np.ones(3)).astype(np.float32)
    shares = dots_as_shares(captures, white, seen, patterns, (rows, columns)).toarray().reshape(40, 48, rows, columns)
    assert shares.max() <= 1
    middle = shares[20, 24]
    expected = np.exp(
        -0.5 * ((np.arange(columns) - x[20, 24]) ** 2 + (np.arange(rows)[:, None] - y[20, 24]) ** 2) / 0.25
    )
    assert np.abs(middle - np.where(expected > 0.01, expected, 0)).max() < 0.01


def test_dots_are_kept_as_they_were_found(tmp_path: Path) -> None:
    subject = array_subject()
    found = subject.light.dots(1)
    write_study_dots(tmp_path, "left", found)
    kept = read_study_dots(tmp_path, "left")
    np.testing.assert_array_equal(kept.shares.toarray(), found.shares.toarray())
    assert kept.shares.shape == found.shares.shape
    for name in ("centre_px", "covariance_px2", "valid"):
        np.testing.assert_array_equal(getattr(kept.metapixels, name), getattr(found.metapixels, name))


@pytest.mark.parametrize("one", EXPERIMENTS, ids=lambda one: one.name)
def test_every_experiment_says_what_it_shows_and_explains_it_in_a_paragraph(one: Experiment) -> None:
    assert one.paper
    assert one.title
    assert one.shows.endswith(".")
    text = description(one.name) or getattr(import_module(one.run.__module__), "TEXT", "")
    assert len(text.split()) >= 40, f"{one.name} has no text in output/words.py and no TEXT in its module"


def test_the_example_of_the_guide_runs_on_a_stage() -> None:
    page = (Path(__file__).parents[3] / "docs" / "study" / "adding.md").read_text("utf-8")
    (code,) = re.findall(r"^```python\n(.*?)^```", page, re.MULTILINE | re.DOTALL)
    names: dict[str, Any] = {}
    exec(compile(code, "adding.md", "exec"), names)
    experiment = names["NOISE"]
    result = experiment.run(array_subject())
    assert experiment.scene in SCENES
    assert result.criteria[0].holds
    assert f"{column(result.tables[0], 'CIEDE2000')[0]:.2f}" == result.criteria[0].reached


def test_sharpness_is_measured_for_one_and_for_all_naive_and_full(monkeypatch: pytest.MonkeyPatch) -> None:
    few = partial(unbounded_inverse, iterations=12)
    monkeypatch.setattr("lab.study.experiments.sharpness.unbounded_inverse", few)
    subject = array_subject(2)
    result = local_sharpness(subject)
    (table,) = result.tables
    assert column(table, "target") == ["photograph"] * 4 + ["chequer"] * 4
    overall = [float(value or 0) for value in column(table, "lambda, in reach")]
    for first in (0, 4):
        naive_one, _, naive_all, full_all = overall[first : first + 4]
        assert full_all > max(naive_one, naive_all)
        assert result.criteria[first + 3].holds
    assert [figure.name for figure in result.figures] == [
        f"{target}-{what}" for target in ("photograph", "chequer") for what in ("photographs", "behind", "maps")
    ]


def quality_of(error: float) -> Quality:
    return Quality(error, 2 * error, error / 10, 1 - error / 10, 1 - error / 10)


def test_an_ablation_whose_steps_each_help_holds_and_one_step_back_is_told() -> None:
    nothing = np.zeros((2, 2, 3), np.float32)
    names = (*ablation.FALLS, ablation.QUADRILATERALS, ablation.OURS)

    def judged(*errors: float) -> list[bool | None]:
        steps = [Variant(n, 1.0, nothing, quality_of(e)) for n, e in zip(names, errors, strict=True)]
        return [criterion.holds for criterion in ablation._criteria(steps)]

    assert judged(7, 6, 5, 4, 3, 4, 2) == [True] * 6
    assert judged(7, 6, 6.5, 4, 3, 2, 2.5) == [True, False, True, True, False, True]


def test_plain_dots_keep_their_own_light_and_every_step_is_compared_with_the_one_before(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    subject = array_subject(2)
    plain, shape = subject.calibration, subject.mask.shape
    dots = [subject.light.dots(n) for n in range(2)]
    half = [0.5 * one.shares for one in dots]
    light = plain_dots.unscaled_transport(plain, half).forward([np.ones((32, 43, 3), np.float32)] * 2)
    expected = sum(
        part.white[40, 60] * one[40 * shape[1] + 60].sum() for part, one in zip(plain.projectors, half, strict=True)
    )
    np.testing.assert_allclose(light[40, 60], expected, rtol=1e-4)
    even = np.ones(dots[0].metapixels.valid.size)
    ours = plain_dots.gaussian_shares(dots[0].metapixels, even, (shape[0], shape[1]))
    assert abs(ours - gaussian_weights(dots[0].metapixels, CAMERA)).max() < 1e-6
    twice = dataclasses.replace(dots[0], shares=0.7 * ours)
    np.testing.assert_allclose(plain_dots.peaks_of(twice, CAMERA)[ours.sum(axis=0).A1 > 0], 0.7, rtol=1e-6)
    few = partial(unbounded_inverse, iterations=12)
    monkeypatch.setattr("lab.study.experiments.plain_dots.unbounded_inverse", few)
    result = plain_dots.plain_ablation(subject)
    assert [one.asked.split(":")[0] for one in result.criteria] == [
        f"{after} is better than {before}" for before, after in pairwise(ablation.FALLS)
    ]
    assert result.criteria[1].holds, "a Gaussian has less of the noise of a faint dot"


def test_ours_is_compared_with_every_earlier_system() -> None:
    nothing = np.zeros((2, 2, 3), np.float32)
    made = [Variant(f"system {e}", 1.0, nothing, quality_of(e)) for e in (3, 1, 2)]
    first, second = earlier._criteria(made)
    assert first.holds
    assert second.holds is False
    assert "CIEDE2000 and RMSE and SSIM" in second.reason


def test_earlier_systems_are_asked_for_what_the_room_does_not_give(monkeypatch: pytest.MonkeyPatch) -> None:
    subject = array_subject()
    flat = np.full((*subject.mask.shape, 3), 0.2, np.float32)
    wanted = ReachableTarget(flat, subject.mask, 1.0, np.float32(0.75) * flat)
    asked: list[FloatImage] = []
    monkeypatch.setattr(earlier, "traditional_compensation", lambda calibration, target, n: asked.append(target))
    monkeypatch.setattr(earlier, "feathered", lambda calibration, target: asked.append(target))
    for name, make in earlier._ways(subject, wanted, 0)[:2]:
        make()
        np.testing.assert_array_equal(asked.pop(), wanted.direct, name)


def test_live_pictures_are_judged_for_both_bases_and_the_full_solve_is_best() -> None:
    subject = array_subject()
    result = live.live_pictures(subject)
    assert [criterion.holds for criterion in result.criteria] == [True, True]
    (table,) = result.tables
    rmse = dict(zip(column(table, "way"), column(table, "RMSE"), strict=True))
    assert min(rmse, key=lambda way: float(str(rmse[way]))) == live.FULL
    assert {figure.name for figure in result.figures} == {"photographs", "crops"}
