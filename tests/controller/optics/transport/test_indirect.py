"""Light by way of other surfaces: the operator against dense matrices, and its fit against stages that are known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from controller.core.arrays import Float64, FloatImage, Mask
from controller.optics.calibrate.values import Calibration, PhaseMap
from controller.optics.capture.patterns import plan_patterns
from controller.optics.transport.indirect import indirect_light
from controller.optics.transport.indirect.blocks import BlockGrid, down_up
from controller.optics.transport.indirect.fit import beside, fit_indirect
from controller.optics.transport.indirect.form_factors import form_factors
from controller.optics.transport.indirect.indirect_light import IndirectLight
from controller.optics.transport.indirect.stripes import blocks_of, coarse_stripes, dark_light, stripe_parts
from controller.optics.transport.indirect.weights import ALIKE_BLOCKS, PART_NOISE, UNSURE, BlockLight, corrected_factors
from tests.controller.optics.solve.conftest import plane_calibration

SHAPE = (22, 27)


def some(seed: int, *, side: int = 5, strength: float = 0.4) -> IndirectLight:
    rng = np.random.default_rng(seed)
    grid = -(-SHAPE[0] // side), -(-SHAPE[1] // side)
    blocks = grid[0] * grid[1]
    factors = rng.random((blocks, blocks)).astype(np.float32)
    factors /= factors.sum(axis=1, keepdims=True)
    scale = (strength * rng.random((*SHAPE, 3))).astype(np.float32)
    lit: Mask = rng.random(SHAPE) < 0.9
    return IndirectLight(factors, scale, lit, grid, side)


def some_paint(seed: int) -> FloatImage:
    return np.random.default_rng(seed).uniform(-0.1, 0.1, (3, 3, *SHAPE)).astype(np.float32)


def dense(light: IndirectLight, channel: int) -> Float64:
    """Column by column."""
    columns = []
    for at in range(light.lit.size):
        one = np.zeros((*SHAPE, 3), np.float32)
        one.reshape(-1, 3)[at, channel] = 1
        columns.append(light.forward(one)[..., channel].ravel())
    return np.stack(columns, axis=1).astype(np.float64)


def picture(seed: int) -> FloatImage:
    return np.random.default_rng(seed).random((*SHAPE, 3)).astype(np.float32)


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 1000), st.integers(1, 9), st.booleans())
def test_adjoint_is_the_transpose(seed: int, side: int, paint: bool) -> None:
    light, d, r = some(seed, side=side), picture(seed + 1), picture(seed + 2)
    light = replace(light, paint=some_paint(seed + 3)) if paint else light
    forward, back = np.vdot(light.forward(d).astype(np.float64), r), np.vdot(d, light.adjoint(r).astype(np.float64))
    assert forward == pytest.approx(back, rel=1e-5)


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 1000), st.floats(-3, 3))
def test_linear_and_never_negative(seed: int, factor: float) -> None:
    light, a, b = some(seed), picture(seed + 1), picture(seed + 2)
    both = light.forward((a + np.float32(factor) * b).astype(np.float32))
    np.testing.assert_allclose(both, light.forward(a) + np.float32(factor) * light.forward(b), atol=1e-5)
    assert (light.forward(a) >= 0).all()


def test_as_its_matrix_and_its_inverse() -> None:
    light = replace(some(1), lit=np.ones(SHAPE, np.bool_))
    matrix, d = dense(light, 1), picture(5)
    np.testing.assert_allclose(light.forward(d)[..., 1].ravel(), matrix @ d[..., 1].ravel(), atol=1e-5)
    total = (d + light.forward(d)).astype(np.float32)
    solved = np.linalg.solve(np.eye(len(matrix)) + matrix, total[..., 1].ravel())
    np.testing.assert_allclose(light.direct_target(total)[..., 1].ravel(), solved, atol=1e-4)
    np.testing.assert_allclose(light.direct_target(total), d, atol=1e-4)


def test_paint_changes_light_before_it_falls_on_other_surfaces() -> None:
    light = replace(some(1), lit=np.ones(SHAPE, np.bool_), paint=some_paint(2))
    d = picture(5)
    painted = d + np.einsum("kmyx,yxm->yxk", some_paint(2), d)
    total = painted + replace(some(1), lit=np.ones(SHAPE, np.bool_)).forward(painted)
    np.testing.assert_allclose(d + light.forward(d), total, atol=1e-5)
    np.testing.assert_allclose(light.direct_target(total.astype(np.float32)), d, atol=1e-4)


def test_a_third_of_the_light_from_other_surfaces_is_found_in_seven_rounds(monkeypatch: pytest.MonkeyPatch) -> None:
    """Round by round, without looking where they lead, it takes twelve."""
    y, x = np.divmod(np.arange(30), 6)
    near = np.exp(-0.5 * (np.subtract.outer(y, y) ** 2 + np.subtract.outer(x, x) ** 2))
    factors = (near / near.sum(axis=1, keepdims=True)).astype(np.float32)
    light = replace(some(1, strength=1.0), factors=factors, lit=np.ones(SHAPE, np.bool_))
    d = picture(5)
    total = (d + light.forward(d)).astype(np.float32)
    monkeypatch.setattr(indirect_light, "ROUNDS", 7)
    np.testing.assert_allclose(light.direct_target(total), d, atol=1e-4)


def test_light_is_one_number_for_even_light() -> None:
    light = some(2)
    np.testing.assert_allclose(light.falling(np.ones((*SHAPE, 3), np.float32))[:20, :25], 1, atol=0.35)


def test_more_than_is_wanted_is_less_than_nothing() -> None:
    light = replace(some(3, strength=1.0), lit=np.ones(SHAPE, np.bool_))
    total = np.ones((*SHAPE, 3), np.float32)
    total[:11] = 0.0
    direct = light.direct_target(total)
    assert (direct[:11] <= 0).all()
    assert direct[:11].min() < -0.05
    np.testing.assert_allclose(direct + light.forward(np.maximum(direct, 0)), total, atol=1e-4)


def test_out_of_reach_throws_nothing_back() -> None:
    light = replace(some(4, strength=0.8), lit=np.ones(SHAPE, np.bool_))
    total, reach = np.full((*SHAPE, 3), 2.0, np.float32), np.full((*SHAPE, 3), 0.5, np.float32)
    limited, unlimited = light.direct_target(total, reach=reach), light.direct_target(total)
    np.testing.assert_allclose(limited + light.forward(np.clip(limited, 0, reach)), total, atol=1e-4)
    assert limited.mean() > unlimited.mean()


def corner(shape: tuple[int, int] = (60, 80)) -> tuple[FloatImage, FloatImage]:
    """Points and normals of two planes that meet at a right angle, open towards the camera."""
    y, x = np.mgrid[0 : shape[0], 0 : shape[1]]
    ray = np.stack([(x - shape[1] / 2) / 80, (y - shape[0] / 2) / 80, np.ones(shape)], axis=2)
    left = x < shape[1] / 2
    normal = np.where(left[..., None], [np.sqrt(0.5), 0, -np.sqrt(0.5)], [-np.sqrt(0.5), 0, -np.sqrt(0.5)])
    at = np.array([0, 0, 2.0])
    depth = np.sum(normal * at, axis=2) / np.sum(normal * ray, axis=2)
    return (ray * depth[..., None]).astype(np.float32), normal.astype(np.float32)


def test_form_factors_add_up_to_the_part_of_the_view_that_is_taken() -> None:
    points, normals = corner()
    factors = form_factors(points, normals, (12, 16), 5)
    grid = factors.sum(axis=1).reshape(12, 16)
    assert (factors >= 0).all()
    np.testing.assert_array_equal(factors.reshape(12, 16, 12, 16)[:, 2, :, :8], 0)  # a plane gives itself nothing
    # beside the edge nearly half of the half-space is the other plane
    assert 0.3 < grid[6, 7] < 0.55
    assert grid[6, 7] > 2 * grid[6, 1]


def paint_of(white: FloatImage) -> FloatImage:
    """What a surface makes of light that falls on it, which has the colours of its direct light."""
    return np.asarray(0.3 * white / white.max(axis=2, keepdims=True), np.float32)


def thrown_back(truth: IndirectLight, direct: FloatImage) -> FloatImage:
    """Indirect light of direct light, where surfaces throw back that of others, too."""
    indirect = np.zeros_like(direct)
    lit = truth.lit[..., None]
    for _ in range(30):
        every = direct + indirect
        indirect = truth.forward(np.where(lit, every, np.float32(0)), np.where(lit, np.float32(0), every))
    return indirect


def fitted(kernel: FloatImage, *, projectors: int = 3) -> tuple[IndirectLight, list[FloatImage], list[FloatImage]]:
    """The fit for a stage whose blocks give each other light by ``kernel``; its direct and indirect whites."""
    stage = plane_calibration(projectors=projectors)
    truth = IndirectLight(kernel, paint_of(stage.projectors[0].white), stage.object_mask, *blocks_of((60, 80)))
    parts = []
    for n, part in enumerate(stage.projectors):
        white = part.white.copy()
        white[:, : 20 * n] = 0
        white[:, 60 - 15 * n :] *= 0.3
        parts.append(replace(part, white=white, indirect=thrown_back(truth, white)))
    points, normals = corner()
    found = fit_indirect(replace(stage, projectors=tuple(parts)), stage.object_mask, points, normals)
    assert found is not None
    return found, [part.white for part in parts], [thrown_back(truth, part.white) for part in parts]


def test_indirect_light_of_all_whites_is_as_measured() -> None:
    found, direct, indirect = fitted(form_factors(*corner(), *blocks_of((60, 80))))
    both = found.forward(np.sum(direct, axis=0)), np.sum(indirect, axis=0)
    np.testing.assert_allclose(*both, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("even", [0.0, 1.0])
def test_each_projectors_is_told_by_the_terms_that_fit(even: float) -> None:
    shape = form_factors(*corner(), *blocks_of((60, 80)))
    kernel = (even / len(shape) * np.ones_like(shape) + (1 - even) * shape).astype(np.float32)
    found, direct, indirect = fitted(kernel)
    for one, wanted in zip(direct, indirect, strict=True):
        error = found.forward(one) - wanted
        assert np.sqrt(np.mean(error**2)) < 0.1 * np.sqrt(np.mean(wanted**2))


def test_without_shape_or_measurement() -> None:
    stage = plane_calibration()
    assert fit_indirect(stage, stage.object_mask, None, None) is None
    parts = tuple(replace(part, indirect=0.1 * part.white) for part in stage.projectors)
    found = fit_indirect(replace(stage, projectors=parts), stage.object_mask, None, None)
    assert found is not None
    whole = np.sum([part.white for part in parts], axis=0)
    np.testing.assert_allclose(found.forward(whole), 0.1 * whole, rtol=1e-3, atol=1e-5)


def test_light_beside_the_object_is_that_of_the_frame() -> None:
    stage = plane_calibration()
    lit = np.zeros((60, 80), np.bool_)
    lit[:30] = True
    found = beside(stage.projectors[0], np.full((20, 26, 3), 0.5, np.float32), lit)
    np.testing.assert_array_equal(found[:30], 0)
    np.testing.assert_allclose(found[30:], 0.5 * stage.projectors[0].white[30:], rtol=1e-5)


def with_and_without_stripes(own: float, room: float, far: float) -> tuple[float, float]:
    """Relative error of the object's indirect light, from whites and stripes, and from whites alone.

    Of a stage whose object gives ``own`` of the form factors, its room ``room`` of them and ``far`` of even light.
    """
    stage = plane_calibration(projectors=3, projector=(72, 96))
    grid, side = blocks_of((60, 80))
    points, normals = corner()
    shape = form_factors(points, normals, grid, side)
    even = np.full_like(shape, 1 / len(shape))
    y, x = np.mgrid[0:60, 0:80].astype(np.float32)
    lit: Mask = np.asarray((x > 15) & (x < 60))
    paint, away = paint_of(stage.projectors[0].white), np.float32(room) * shape + np.float32(far) * even
    truth = IndirectLight(np.float32(own) * shape, paint, lit, grid, side, away)
    plan, parts = plan_patterns((96, 72)), []

    for n, part in enumerate(stage.projectors):
        at = np.stack([1.2 * x - 2.0 * n, 1.2 * y], axis=-1)
        white = part.white.copy()
        white[:, 60 - 15 * n :] *= 0.3
        pictures = {"black": np.zeros_like(white)}
        for pattern in coarse_stripes(plan):
            shown, dark = stripe_parts(pattern, (96, 72), at)
            assert 0.1 < dark.mean() < 0.7
            assert not shown[dark].any()
            direct = white * shown[..., None]
            pictures[pattern.name] = direct + thrown_back(truth, direct)
        stripes = dark_light(pictures, plan, at)
        phase_map = PhaseMap(at, np.ones((60, 80, 3), np.float32))
        parts.append(
            replace(part, white=white, indirect=thrown_back(truth, white), phase_map=phase_map, stripes=stripes)
        )

    def error(calibration: Calibration) -> float:
        found = fit_indirect(calibration, lit, points, normals)
        assert found is not None
        light = np.where(lit[..., None], parts[0].white, np.float32(0))
        wanted = thrown_back(truth, light)[lit]
        return float(np.sqrt(np.mean((found.forward(light)[lit] - wanted) ** 2) / np.mean(wanted**2)))

    blind = replace(stage, projectors=tuple(replace(part, stripes=None) for part in parts))
    return error(replace(stage, projectors=tuple(parts))), error(blind)


def test_stripes_tell_the_light_of_the_object_from_that_of_the_room() -> None:
    """White images alone can't: in them, table and walls are as bright as ever."""
    known, blind = with_and_without_stripes(0.6, 0.1, 0.3)
    # the rest is what holds both together
    assert known < 0.2
    assert blind > 2 * known


def test_stripes_make_nothing_worse_where_object_and_room_are_alike() -> None:
    known, blind = with_and_without_stripes(0.5, 0.5, 0.0)
    assert known < 0.01 + blind
    assert known < 0.05


class Shapes:
    """A stage of blocks, whose light between blocks is that of the terms times factors that change slowly."""

    grid, side, shape = (9, 12), 5, (45, 60)

    def __init__(self, seed: int, *, strength: float, stripes: bool = True) -> None:
        rng = np.random.default_rng(seed)
        count = self.grid[0] * self.grid[1]
        row, column = np.divmod(np.arange(count), self.grid[1])
        apart = np.hypot(np.subtract.outer(row, row), np.subtract.outer(column, column))
        self.terms = np.asarray(np.exp(-apart / 4) / 20, np.float32)
        bend = np.cos(column / 5 + rng.uniform(0, 6, count)[:, None]) * np.cos(row / 5 + rng.uniform(0, 6))
        self.true = np.asarray(self.terms * (1 + strength * bend), np.float32)
        self.room = np.zeros_like(self.terms)
        lights = [(column < 8), (column > 3), np.ones(count, np.bool_)]
        cuts = [column < 6, column >= 6, row < 4, row >= 4, (column // 3) % 2 == 0, (row // 2) % 2 == 0]
        self.whites = [np.repeat(one[:, None], 3, axis=1).astype(np.float32) for one in lights]
        self.stripes = [white * cut[:, None] for white in self.whites for cut in cuts] if stripes else []
        self.whole = self.true @ np.sum(self.whites, axis=0)

    def pictures(self) -> list[BlockLight]:
        """As measured, without the interpolation between blocks."""
        none, full = np.zeros_like(self.whole), np.ones(len(self.whole), np.float32)
        return [BlockLight(one, none, self.true @ one, self.whole, full) for one in (*self.whites, *self.stripes)]

    def corrected(self) -> FloatImage:
        return corrected_factors(
            self.terms, self.room, self.pictures(), 3, BlockGrid(self.grid, self.side, self.shape)
        )[0]


def part_of(factors: FloatImage, light: FloatImage, whole: FloatImage) -> FloatImage:
    """A picture's part of all whites' indirect light, which the scale makes of it."""
    return np.asarray((factors @ light) / (factors @ whole), np.float32)


@settings(max_examples=8, deadline=None)
@given(st.integers(0, 1000), st.floats(0.3, 0.8))
def test_shape_comes_nearer_for_pictures_that_were_not_measured(seed: int, strength: float) -> None:
    stage = Shapes(seed, strength=strength)
    rng = np.random.default_rng(seed + 1)
    waves = np.kron(rng.random((3, 4)), np.ones((3, 3))).reshape(-1, 1)
    light, whole = np.repeat(waves, 3, axis=1).astype(np.float32), np.sum(stage.whites, axis=0)
    wanted = part_of(stage.true, light, whole)
    before, after = (part_of(one, light, whole) - wanted for one in (stage.terms, stage.corrected()))
    assert np.sqrt(np.mean(after**2)) < 0.7 * np.sqrt(np.mean(before**2))
    assert (stage.corrected() >= 0).all()


def test_no_shape_is_changed_that_already_fits() -> None:
    stage = Shapes(4, strength=0.0)
    across = down_up(stage.grid, stage.side, stage.shape)
    none, full = np.zeros_like(stage.whole), np.ones(len(stage.whole), np.float32)
    whole = across(stage.whole)
    pictures = [BlockLight(one, none, across(stage.true @ one), whole, full) for one in (*stage.whites, *stage.stripes)]
    found, room = corrected_factors(
        stage.terms, stage.room, pictures, 3, BlockGrid(stage.grid, stage.side, stage.shape)
    )
    np.testing.assert_allclose(found, stage.terms, rtol=1e-4)
    np.testing.assert_array_equal(room, 0)


def test_a_blocks_factors_are_the_mean_of_the_gaussian_process() -> None:
    """By the whole covariance between sources, instead of its factors."""
    stage = Shapes(7, strength=0.5)
    pictures, block = stage.pictures(), 31
    across, every = down_up(stage.grid, stage.side, stage.shape), np.sum(stage.whites, axis=0)
    whole = across(stage.terms @ every)
    row, column = np.divmod(np.arange(len(stage.terms)), stage.grid[1])
    apart = np.hypot(np.subtract.outer(row, row), np.subtract.outer(column, column)) / ALIKE_BLOCKS
    covariance = UNSURE**2 * np.exp(-0.5 * apart.astype(np.float64) ** 2)
    equations, left = [], []
    for one in pictures:
        for channel in range(3):
            part = float(one.seen[block, channel] / one.whole[block, channel])
            source = (one.own - part * every)[:, channel] * stage.terms[block] / whole[block, channel]
            equations.append(source)
            left.append(part - across(stage.terms @ one.own)[block, channel] / whole[block, channel])
    a, noise = np.array(equations, np.float64), PART_NOISE**2 * np.eye(len(left))
    factor = covariance @ a.T @ np.linalg.inv(a @ covariance @ a.T + noise) @ np.array(left)
    np.testing.assert_allclose(stage.corrected()[block] / stage.terms[block], 1 + factor, atol=3e-3)
