"""Light by way of several surfaces, against the solution of the linear system."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from controller.core.arrays import FloatImage
from controller.optics.transport.indirect.blocks import parted
from controller.optics.transport.indirect.fit import Both, by_all_ways, with_bounces

COUNT = 12


def stage(seed: int, *, grey: bool) -> tuple[Both, Both, Both]:
    """Factors, what is thrown back, and direct light, of object and room."""
    rng = np.random.default_rng(seed)

    def some(*shape: int) -> Both:
        own, room = rng.random((2, *shape)).astype(np.float32)
        return own, room

    own, room = some(COUNT, COUNT)
    factors: Both = (own / np.float32(COUNT), room / np.float32(COUNT))
    own, room = some(COUNT, 1 if grey else 3)
    back: Both = (0.35 * own * np.ones(3, np.float32), 0.35 * room * np.ones(3, np.float32))
    return factors, back, some(COUNT, 3)


def solved(factors: Both, back: Both, direct: Both, channel: int) -> FloatImage:
    """Light that leaves object and room, of one colour, (2 x blocks,)."""
    falling = np.concatenate(factors, axis=1).astype(np.float64)
    thrown = np.concatenate([one[:, channel, None] * falling for one in back])
    wanted = np.linalg.solve(np.eye(2 * COUNT) - thrown, np.concatenate(direct)[:, channel])
    return np.asarray(wanted, np.float32)


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 1000))
def test_all_light_that_leaves_is_that_of_the_linear_system(seed: int) -> None:
    factors, back, direct = stage(seed, grey=False)
    # of two pictures, each is as it is alone
    both = np.stack([direct[0], direct[1][::-1]], axis=1), np.stack([direct[1], direct[0][::-1]], axis=1)
    found = np.concatenate(with_bounces(both, factors, (back[0][:, None], back[1][:, None])))
    for number in range(2):
        alone = both[0][:, number], both[1][:, number]
        for channel in range(3):
            np.testing.assert_allclose(found[:, number, channel], solved(factors, back, alone, channel), rtol=0.01)


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 1000))
def test_factors_by_all_ways_make_falling_light_of_direct_light(seed: int) -> None:
    factors, back, direct = stage(seed, grey=True)
    own, room = by_all_ways(factors, back)
    assert min(own.min(), room.min()) >= 0
    falling = own @ direct[0] + room @ direct[1]
    for channel in range(3):
        leaving = solved(factors, back, direct, channel)
        np.testing.assert_allclose(falling[:, channel], np.concatenate(factors, axis=1) @ leaving, rtol=0.01)


def test_what_blocks_throw_back_is_parted_by_object_and_room() -> None:
    scale = np.random.default_rng(4).random((6, 8, 3)).astype(np.float32)
    lit = np.zeros((6, 8), np.bool_)
    lit[:, :3] = True
    own, room = parted(scale, lit, (3, 4), 2)
    assert own[3] == pytest.approx(0)
    assert room[0] == pytest.approx(0)
    np.testing.assert_allclose((own + room)[1], scale[:2, 2:4].mean(axis=(0, 1)), rtol=1e-5)
