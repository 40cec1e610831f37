"""The vector kernels against plain NumPy, at any place of arrays of any size; nothing else may be touched."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from hypothesis import given, settings
from hypothesis import strategies as st

from controller.core.arrays import ByteImage, FloatImage
from controller.core.jit import compiled
from controller.optics.transport.simd import gaussians, scaling, small_windows, windows
from controller.optics.transport.windows.profiles import (
    GROUP,
    LANES,
    PHASES,
    SKEW_STEPS,
    STRIP,
    SmallProfiles,
    Windows,
    build_small_profiles,
)
from tests.controller.optics.transport.simd import reference

WEIGHTS = gaussians.LANES
seeds = st.integers(0, 2**32 - 1)
spare = st.integers(0, 21)
"""So many elements stand before and behind those that a kernel uses: no multiple of a register is preferred."""
quick = settings(max_examples=40, deadline=None, derandomize=True)

Size = tuple[int, int]
Shear = tuple[int, int, int]

# An intrinsic runs in compiled code only.


@compiled()
def spread_lanes(
    red: FloatImage, green: FloatImage, blue: FloatImage, at: int, weights: npt.NDArray[np.uint16], k: int,
    light: FloatImage,
) -> None:  # fmt: skip
    gaussians.spread_lanes(red, green, blue, at, weights, k, light[0], light[1], light[2])


@compiled()
def collect_lanes(
    red: FloatImage, green: FloatImage, blue: FloatImage, at: int, weights: npt.NDArray[np.uint16], k: int,
    sums: FloatImage,
) -> None:  # fmt: skip
    gaussians.collect_lanes(red, green, blue, at, weights, k, sums)


@compiled()
def window_sum(light: FloatImage, at: int, side: int, table: FloatImage, shares: int, down: int, size: Size) -> float:
    return windows.window_sum(light, at, side, table, shares, down, size[1], size[0])


@compiled()
def window_add(
    sums: FloatImage, at: int, side: int, table: FloatImage, shares: int, down: int, size: Size, value: float
) -> None:
    windows.window_add(sums, at, side, table, shares, down, size[1], size[0], value)


@compiled()
def sheared_sum(
    light: FloatImage, at: int, side: int, table: FloatImage, shares: int, down: int, size: Size, shear: Shear
) -> float:
    return windows.sheared_sum(light, at, side, table, shares, down, size[1], size[0], shear[0], shear[1], shear[2])


@compiled()
def sheared_add(
    sums: FloatImage, at: int, side: int, table: FloatImage, shares: int, down: int, size: Size, shear: Shear,
    value: float,
) -> None:  # fmt: skip
    windows.sheared_add(sums, at, side, table, shares, down, size[1], size[0], shear[0], shear[1], shear[2], value)


@compiled()
def see(some: Windows, small: SmallProfiles, e: int, strips: FloatImage, out: FloatImage, skewed: bool) -> None:
    if skewed:
        small_windows.see_skewed(some, small, e, strips, out)
    else:
        small_windows.see_upright(some, small, e, strips, out)


@compiled()
def spread(some: Windows, small: SmallProfiles, e: int, values: FloatImage, strips: FloatImage, skewed: bool) -> None:
    if skewed:
        small_windows.spread_skewed(some, small, e, values, strips)
    else:
        small_windows.spread_upright(some, small, e, values, strips)


@compiled()
def look_ahead(some: Windows, sites: FloatImage, near: int, far: int) -> None:
    small_windows.look_ahead(some, sites, near, far)


@compiled()
def fill_strips(light: FloatImage, at: int, side: int, strips: FloatImage, to: int) -> None:
    small_windows.fill_strips(light, at, side, strips, to)


@compiled()
def pour_strips(strips: FloatImage, at: int, sums: FloatImage, to: int, side: int) -> None:
    small_windows.pour_strips(strips, at, sums, to, side)


@compiled()
def window_steps(
    scale: FloatImage,
    at: int,
    side: int,
    shares: ByteImage,
    i: int,
    gain: FloatImage,
    unmix: FloatImage,
    segment: np.float32,
) -> Any:
    if segment == 0:
        return scaling.window_steps(scale, at, side, shares, i, gain, unmix)
    return scaling.own_steps(scale, at, side, shares, i, gain, unmix, segment)


@compiled()
def scale_of_four(
    picture: FloatImage, a: int, b: int, gain: FloatImage, offset: FloatImage, i: int, scale: FloatImage, k: int
) -> float:
    return scaling.scale_of_four(picture, a, b, gain, offset, i, scale, k)


@compiled()
def scale_of_one(light: FloatImage, gain: FloatImage, offset: FloatImage, i: int, scale: FloatImage, k: int) -> None:
    scaling.scale_of_one(light[0], light[1], light[2], gain, offset, i, scale, k)


def floats(random: np.random.Generator, count: int) -> FloatImage:
    """Beginning at an element that no register begins at."""
    return random.uniform(-1, 1, count + 1).astype(np.float32)[1:]


def close(got: npt.NDArray[Any], expected: npt.NDArray[Any], size: float = 1.0) -> None:
    np.testing.assert_allclose(got, expected, rtol=2e-5, atol=3e-6 * size)


@quick
@given(seed=seeds, before=spare, behind=spare, ahead=spare)
def test_weights_of_a_patch_are_spread_and_collected(seed: int, before: int, behind: int, ahead: int) -> None:
    random = np.random.default_rng(seed)
    planes = [floats(random, before + WEIGHTS + behind) for _ in range(3)]
    weights = random.integers(0, 65536, ahead + WEIGHTS + behind).astype(np.uint16)
    light, sums = floats(random, 3), floats(random, 3 * WEIGHTS)
    expected = [plane.astype(np.float64) for plane in planes]
    reference.spread_lanes(expected, before, weights, ahead, light)
    spread_lanes(planes[0], planes[1], planes[2], before, weights, ahead, light)
    for plane, wanted in zip(planes, expected, strict=True):
        close(plane, wanted, 65535)
    total = sums.astype(np.float64)
    reference.collect_lanes([plane.astype(np.float64) for plane in planes], before, weights, ahead, total)
    collect_lanes(planes[0], planes[1], planes[2], before, weights, ahead, sums)
    close(sums, total, 65535**2)


@quick
@given(
    seed=seeds,
    fours=st.tuples(st.integers(1, 5), st.integers(1, 5)),
    before=spare,
    behind=spare,
    value=st.floats(-3, 3, width=32),
    shear=st.one_of(st.none(), st.integers(-77, 77)),
)
def test_large_windows_are_summed_and_added(
    seed: int, fours: tuple[int, int], before: int, behind: int, value: float, shear: int | None
) -> None:  # fmt: skip
    random, size = np.random.default_rng(seed), (LANES * fours[0], LANES * fours[1])
    side, shares, down = size[1] + int(random.integers(0, 9)), int(random.integers(0, 20)), int(random.integers(0, 20))
    sheared = None if shear is None else (int(random.integers(0, PHASES)), shear, int(random.integers(-5000, 5000)))
    table = floats(random, 20 + max(size[1] * PHASES, size[0]))
    place, weights = reference.rows_of_window(side, table, shares, down, size, sheared)
    at = before - min(int(place.min()), 0)
    light = floats(random, at + int(place.max()) + 1 + behind)
    wanted = (light.astype(np.float64)[at + place] * weights).sum()
    expected = light.astype(np.float64)
    np.add.at(expected, at + place, value * weights)
    where = light, at, side, table, shares, down, size
    if sheared is None:
        found = window_sum(*where)
        window_add(*where, value)
    else:
        found = sheared_sum(*where, sheared)
        sheared_add(*where, sheared, value)
    close(np.array(found), wanted, 40)
    close(light, expected, 40)


def some_windows(random: np.random.Generator, groups: int, sites: int, places: int) -> Windows:
    """Small windows at random places, several of one site and of one place."""
    count = groups * GROUP
    small = build_small_profiles().table.size // LANES
    nothing = np.zeros(0, np.int64)
    return Windows(
        random.integers(0, sites, count).astype(np.int32), random.integers(0, places, count).astype(np.uint16),
        random.integers(0, small, count).astype(np.uint16), random.integers(0, small, count).astype(np.uint16),
        random.integers(-SKEW_STEPS, SKEW_STEPS + 1, count).astype(np.int8), floats(random, count),
        nothing, np.zeros((0, 4), np.int64), nothing, nothing, nothing, np.zeros((0, 2), np.int64), nothing, nothing,
    )  # fmt: skip


@quick
@given(seed=seeds, groups=st.integers(1, 3), sites=st.integers(1, 40), places=st.integers(1, 90), skewed=st.booleans())
def test_small_windows_see_and_spread(seed: int, groups: int, sites: int, places: int, skewed: bool) -> None:
    random, small = np.random.default_rng(seed), build_small_profiles()
    some = some_windows(random, groups, sites, places)
    strips, values = floats(random, LANES * (places - 1) + GROUP), floats(random, sites)
    e = GROUP * int(random.integers(0, groups))
    size = float(np.abs(small.skews).max()) if skewed else 1.0
    expected = values.astype(np.float64)
    reference.see(some, small, e, strips.astype(np.float64), expected, skewed=skewed)
    got = values.copy()
    see(some, small, e, strips, got, skewed)
    close(got, expected, 10 * size)
    expected = strips.astype(np.float64)
    reference.spread(some, small, e, values.astype(np.float64), expected, skewed=skewed)
    spread(some, small, e, values, strips, skewed)
    close(strips, expected, 10 * size)


@quick
@given(seed=seeds, groups=st.integers(1, 3), sites=st.integers(1, 40))
def test_looking_ahead_changes_nothing(seed: int, groups: int, sites: int) -> None:
    random = np.random.default_rng(seed)
    some, values = some_windows(random, groups, sites, 20), floats(random, sites)
    before = [part.copy() for part in (*some, values)]
    look_ahead(some, values, GROUP * int(random.integers(0, groups)), 4096)
    for ours, kept in zip((*some, values), before, strict=True):
        np.testing.assert_array_equal(ours, kept)


@quick
@given(seed=seeds, before=spare, behind=spare, wider=spare)
def test_strips_are_filled_and_poured(seed: int, before: int, behind: int, wider: int) -> None:
    random = np.random.default_rng(seed)
    side = STRIP + wider
    light = floats(random, before + 3 * side + LANES + behind)
    strips = floats(random, behind + GROUP + before)
    expected = strips.copy()
    reference.fill_strips(light, before, side, expected, behind)
    fill_strips(light, before, side, strips, behind)
    np.testing.assert_array_equal(strips, expected)
    every = floats(random, before + LANES * STRIP * (STRIP - LANES) + GROUP)
    sums = floats(random, behind + 3 * side + STRIP + before)
    total = sums.astype(np.float64)
    reference.pour_strips(every.astype(np.float64), before, total, behind, side)
    pour_strips(every, before, sums, behind, side)
    close(sums, total)


@quick
@given(
    seed=seeds, wider=spare, pixels=st.integers(1, 5), bright=st.floats(0, 3), segment=st.just(0.0) | st.floats(0, 0.6)
)
def test_a_window_of_the_scale_gives_steps_of_the_device_table(
    seed: int, wider: int, pixels: int, bright: float, segment: float
) -> None:
    random = np.random.default_rng(seed)
    side, i = scaling.SIDE + wider, int(random.integers(0, pixels))
    first = int(random.integers(0, 9))
    scale = np.abs(floats(random, 4 * (first + 3 * side + scaling.SIDE)))
    shares = random.integers(0, 256, 16 * pixels).astype(np.uint8)
    gain = np.append(np.abs(floats(random, 3 * pixels)), np.float32(0)) * np.float32(bright / 1000)
    unmix = np.zeros((3, 4), np.float32)
    unmix[:, :3] = np.eye(3) + random.uniform(-0.2, 0.2, (3, 3))
    steps = np.array(window_steps(scale, first, side, shares, i, gain, unmix.ravel(), np.float32(segment)))
    light = reference.own_light(reference.window_light(scale, first, side, shares, i, gain, unmix.ravel()), segment)
    slack = 1e-6 * (1 + np.abs(light)) * (1 + segment) / (1 - segment)
    assert (steps >= reference.table_steps(light - slack) - 0.51).all()
    assert (steps <= reference.table_steps(light + slack) + 0.51).all()


@quick
@given(seed=seeds, before=spare, behind=spare, blocks=st.integers(1, 5), broken=st.booleans())
def test_light_becomes_the_scale_of_a_block(seed: int, before: int, behind: int, blocks: int, broken: bool) -> None:
    random = np.random.default_rng(seed)
    picture = floats(random, before + 12 + behind)
    a, b = before, before + 6
    if broken:
        picture[a + int(random.integers(0, 12))] = np.nan
    gain, offset = (np.append(np.abs(floats(random, 3 * blocks)), np.float32(0)) for _ in range(2))
    i, k = (int(random.integers(0, blocks)) for _ in range(2))
    scale = floats(random, 4 * blocks + 3)
    for kernel in ("four", "one"):
        kept = scale.copy()
        if kernel == "four":
            light = reference.mean_of_four(picture, a, b)
            total = scale_of_four(picture, a, b, gain, offset, i, scale, k)
            close(np.array(total), light.sum())
            assert np.isnan(total) == broken
        else:
            light = picture[a : a + 3].astype(np.float64)
            scale_of_one(picture[a : a + 3], gain, offset, i, scale, k)
        close(scale[4 * k : 4 * k + 3], reference.above_black(light, gain, offset, i))
        np.testing.assert_array_equal(
            np.delete(scale, range(4 * k, 4 * k + 4)), np.delete(kept, range(4 * k, 4 * k + 4))
        )
