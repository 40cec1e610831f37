"""What the colour of indirect light says of where it comes from: blocks whose light is made here by a formula."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from controller.core.arrays import Float64, FloatImage
from controller.optics.transport.indirect.blocks import BlockGrid
from controller.optics.transport.indirect.weights import (
    BlockLight,
    FallingColours,
    Term,
    corrected_factors,
    falling_colours,
    fit_weights,
    lamp_colours,
)

GRID, SIDE = (5, 8), 6
BLOCKS = GRID[0] * GRID[1]
SHAPE = (GRID[0] * SIDE, GRID[1] * SIDE)
LAMPS = np.array([[0.8, 1.0, 1.3], [1.1, 0.9, 1.0]])
everywhere = np.ones(SHAPE, np.bool_)


def image(blocks: npt.NDArray[np.floating]) -> FloatImage:
    """Each pixel as its block."""
    rows = blocks.reshape(*GRID, 3).repeat(SIDE, axis=0).repeat(SIDE, axis=1)
    return np.asarray(rows, np.float32)


@dataclass(frozen=True)
class Scene:
    """``factors`` (blocks, blocks) as they are; ``directs``, one (blocks, 3) for each projector; ``whole`` of all."""

    factors: Float64
    directs: list[Float64]
    whole: Float64

    @property
    def every(self) -> Float64:
        """All light that leaves a block."""
        return np.asarray(np.sum(self.directs, axis=0) + self.whole)

    def colour(self) -> Float64:
        """(blocks, 3): parts of the light that falls, in units of the lamps' mean white."""
        falling = self.factors @ self.every / np.sqrt(LAMPS.prod(axis=0))
        return np.asarray(falling / falling.sum(axis=1, keepdims=True))

    def found(self) -> FallingColours:
        whites = [image(one) for one in self.directs]
        return falling_colours(whites, image(self.whole), everywhere, GRID, SIDE)


def scene(seed: int) -> Scene:
    """Orange paint at the left and blue at the right, of any brightness; all of them see each other, some more.

    One lamp shines from the left and one from the right, with whites of their own; both light all.
    """
    rng = np.random.default_rng(seed)
    column = np.arange(BLOCKS) % GRID[1]
    paint = np.where((column < GRID[1] // 2)[:, None], (0.8, 0.4, 0.15), (0.2, 0.4, 0.8)) * rng.uniform(
        0.4, 1, (BLOCKS, 1)
    )
    apart = np.abs(np.subtract.outer(column, column))
    factors = rng.uniform(0.2, 1, (BLOCKS, BLOCKS)) * np.exp(-apart / 3)
    factors *= 0.4 / factors.sum(axis=1, keepdims=True)
    aslant = [(1 - column / 10)[:, None], (0.3 + column / 10)[:, None]]
    directs = [paint * lamp * at * rng.uniform(0.5, 1, (BLOCKS, 1)) for lamp, at in zip(LAMPS, aslant, strict=True)]
    direct = np.sum(directs, axis=0)
    every = np.stack(
        [np.linalg.solve(np.eye(BLOCKS) - paint[:, c, None] * factors, direct[:, c]) for c in range(3)], axis=1
    )
    return Scene(factors, directs, every - direct)


@settings(max_examples=20, deadline=None, derandomize=True)
@given(seed=st.integers(0, 2**16))
def test_the_colour_is_that_of_the_light_that_falls_whatever_the_paint_and_the_lamps(seed: int) -> None:
    made = scene(seed)
    found = made.found()
    assert found.known.all()
    np.testing.assert_allclose(found.part, made.colour(), atol=1e-4)
    modelled = made.factors @ made.every / found.white(made.factors @ made.every)
    np.testing.assert_allclose(modelled / modelled.sum(axis=1, keepdims=True), found.part, atol=2e-3)


def test_lamps_are_told_apart_by_paint_that_several_light() -> None:
    made = scene(3)
    found = lamp_colours([image(one) for one in made.directs], everywhere)
    wanted = LAMPS / LAMPS.prod(axis=1, keepdims=True) ** (1 / 3)
    np.testing.assert_allclose(found[0] / found[1], wanted[0] / wanted[1], rtol=1e-4)
    np.testing.assert_allclose(found.prod(axis=0), 1, rtol=1e-4)


def test_lamps_that_light_nothing_together_count_as_alike() -> None:
    made = scene(3)
    left, right = (image(one) for one in made.directs)
    left[:, SHAPE[1] // 2 :] = 0
    right[:, : SHAPE[1] // 2] = 0
    np.testing.assert_array_equal(lamp_colours([left, right], everywhere), 1)


def test_dark_paint_and_what_is_none_of_the_object_say_nothing() -> None:
    made = scene(1)
    whites, lit = [image(one) for one in made.directs], everywhere.copy()
    lit[:, : 2 * SIDE] = False
    for white in whites:
        white[: 2 * SIDE] *= 0.002
    known = falling_colours(whites, image(made.whole), lit, GRID, SIDE).known.reshape(GRID)
    assert not known[:2].any()
    assert not known[:, :2].any()
    assert known[2:, 2:].all()


def test_sources_that_count_too_little_are_found_by_their_colour() -> None:
    """For some of the blocks: the same for all would look like lamps of another white."""
    made = scene(2)
    orange, above = np.arange(BLOCKS) % GRID[1] < GRID[1] // 2, np.arange(BLOCKS) // GRID[1] < 2
    wrong = made.factors * np.where(above[:, None] & orange, 0.5, 1.0)
    every, whole = made.every.astype(np.float32), made.whole.astype(np.float32)
    white = BlockLight(every, 0 * every, whole, whole, np.ones(BLOCKS, np.float32))
    room = np.zeros((BLOCKS, BLOCKS), np.float32)

    def share(factors: npt.NDArray[np.floating]) -> Float64:
        """Of what falls, that which comes from orange paint."""
        falling = factors * made.every.sum(axis=1)
        return np.asarray((falling[:, orange].sum(axis=1) / falling.sum(axis=1))[above])

    without, _ = corrected_factors(wrong.astype(np.float32), room, [white], 1, BlockGrid(GRID, SIDE, SHAPE))
    found, _ = corrected_factors(wrong.astype(np.float32), room, [white], 1, BlockGrid(GRID, SIDE, SHAPE), made.found())
    off = [float(np.abs(share(one) - share(made.factors)).mean()) for one in (without, found)]
    assert off[1] < 0.5 * off[0]


def test_without_any_light_nothing_is_known() -> None:
    dark = np.zeros((*SHAPE, 3), np.float32)
    found = falling_colours([dark, dark], dark, everywhere, GRID, SIDE)
    assert not found.known.any()
    assert found.white(np.zeros((BLOCKS, 3))) == pytest.approx(1)


def test_where_next_to_no_light_falls_the_weights_are_those_of_the_rest() -> None:
    one, none = scene(1), np.zeros((BLOCKS, 3), np.float32)
    falls = np.where(np.arange(BLOCKS) % GRID[1] < GRID[1] // 2, 1e-41, 1)[:, None]
    ways = [np.asarray(falls * factors, np.float32) for factors in (one.factors, one.factors**2)]
    lights = [np.asarray(direct, np.float32) for direct in one.directs]
    seen = [np.asarray(ways[0] @ light + 1e-3, np.float32) for light in lights]
    whole, covered = np.asarray(np.sum(seen, axis=0), np.float32), np.ones(BLOCKS, np.float32)
    whites = [BlockLight(light, none, own, whole, covered) for light, own in zip(lights, seen, strict=True)]
    weights = fit_weights([Term(way, "all") for way in ways], whites, (), BlockGrid(GRID, SIDE, SHAPE))
    assert np.isfinite(weights).all()
    assert weights[0] > 0.5
