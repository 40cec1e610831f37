"""Targets bent into what the stage can make: the object's own pattern doesn't show, and little else changes."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from controller.config.models import SolveTable
from controller.core.arrays import Float64, FloatImage
from controller.core.errors import UsageError
from controller.optics.solve.reach.adaptation import adapted_target
from controller.optics.solve.reach.drive_levels import DriveLevels
from controller.optics.solve.reach.feasibility import feasibility
from controller.optics.transport import build_transport
from tests.controller.optics.solve.conftest import plane_calibration

STAGE = plane_calibration(projector=(40, 52), camera=(120, 160), spill=0.0)
TRANSPORT = build_transport(STAGE)
DRIVE = DriveLevels.of_transport(TRANSPORT)
REACH = TRANSPORT.reach()


def adapted(wanted: FloatImage, floor: FloatImage = STAGE.black, *, strength: float = 1.0) -> FloatImage:
    return adapted_target(DRIVE, wanted, floor, strength=strength)


def shown(target: FloatImage, floor: FloatImage = STAGE.black) -> FloatImage:
    """What the projectors make of a target at best, pixel by pixel."""
    levels = np.clip(DRIVE.of(target - floor), 0, 1)
    return np.asarray(floor + np.einsum("cmyx,yxm->yxc", DRIVE.matrices, levels), np.float32)


def checked(size_px: int) -> FloatImage:
    """(rows, columns) of 0 and 1."""
    y, x = np.mgrid[0:120, 0:160]
    return np.asarray((y // size_px + x // size_px) % 2, np.float32)


def patches(random: np.random.Generator, power: int) -> Float64:
    """(rows, columns, 3) squares of random colours from 0 to 1, the darker the higher the ``power``."""
    return np.asarray(np.kron(random.random((6, 8, 3)) ** power, np.ones((20, 20, 1))), np.float64)


def highlight(peak: float) -> FloatImage:
    """A brown surface with a soft white highlight of ``peak`` times the light of the stage's darkest place."""
    y, x = np.mgrid[0:120, 0:160].astype(np.float32)
    bump = np.exp(-((x - 80) ** 2 + (y - 60) ** 2) / (2 * 18**2))[..., None]
    brown = np.array([0.3, 0.18, 0.12], np.float32) * 0.4
    return np.asarray(float(np.median(REACH)) * (brown + peak * bump), np.float32)


def test_where_light_suffices_nothing_changes() -> None:
    wanted = np.asarray(STAGE.black + 0.5 * REACH, np.float32)
    np.testing.assert_array_equal(adapted(wanted), wanted)


@pytest.mark.parametrize("light", [0.2, 0.05, 0.0])
def test_a_shadow_or_dark_paint_pulls_down_nothing_around(light: float) -> None:
    """A third of an even grey gets a part of the light, or is painted dark: all the rest stays as asked."""
    shape = plane_calibration(projector=(40, 52), camera=(120, 160), spill=0.0)
    shadow = np.s_[:, 50:100]
    for part in shape.projectors:
        part.white[shadow] *= np.float32(light)
    transport = build_transport(shape)
    wanted = np.full_like(shape.black, 0.6 * float(np.median(REACH)))
    bent = adapted_target(DriveLevels.of_transport(transport), wanted, shape.black)
    np.testing.assert_array_equal(bent, wanted)


def test_a_highlight_out_of_reach_keeps_all_in_reach_as_it_is() -> None:
    wanted = highlight(2.0)
    bent = adapted(wanted)
    in_reach = feasibility(DRIVE, wanted, STAGE.black).reachable
    assert 0.3 < in_reach.mean() < 0.98
    np.testing.assert_array_equal(bent[in_reach], wanted[in_reach])


def test_dark_places_of_the_object_do_not_show_through_a_highlight() -> None:
    """Light of other surfaces falls in squares; what is darker than that shows them if it is cut off."""
    squares = checked(8)[..., None] * np.float32(0.1 * np.median(REACH))
    floor = np.asarray(STAGE.black + squares, np.float32)
    wanted = np.full_like(STAGE.black, 0.02 * float(np.median(REACH)))
    cut = np.maximum(wanted, floor)
    bent = shown(adapted(wanted, floor), floor)
    inside = np.s_[20:-20, 20:-20, 1]
    assert np.log(bent[inside]).std() < 0.25 * np.log(cut[inside]).std()


def test_the_default_hides_what_a_cut_off_target_shows_and_spares_what_is_in_reach() -> None:
    """Light of other surfaces in squares: full adaptation costs pixels in reach more than what they hide is worth."""
    squares = checked(8)[..., None] * np.float32(0.1 * np.median(REACH))
    floor = np.asarray(STAGE.black + squares, np.float32)
    rising = np.linspace(0.2, 1.2, 160, dtype=np.float32)[None, :, None]
    wanted = np.asarray(STAGE.black + 0.02 * float(np.median(REACH)) * rising, np.float32)
    wanted = np.broadcast_to(wanted, floor.shape).copy()
    inside = np.s_[20:-20, 20:-20]
    reach = feasibility(DRIVE, wanted - squares, STAGE.black).reachable[inside]
    pattern, costs = [], []
    for strength in (0.0, SolveTable().adapt, 1.0):
        seen = shown(adapted(wanted, floor, strength=strength), floor)
        error = np.log(seen / wanted)[..., 1][inside]
        pattern.append(float(error.std()))
        costs.append(float(np.percentile(np.abs(error[reach]), 95)))
    cut, default, full = pattern
    assert full < default < 0.65 * cut
    assert costs[1] < 0.75 * costs[2]


def test_coloured_light_that_no_grey_outshines_lifts_nothing_around() -> None:
    """Red light of other surfaces on a patch, brighter than any grey that can be shown there: it stays red."""
    floor = np.array(STAGE.black, np.float32)
    patch = np.s_[40:80, 60:100]
    floor[patch] += np.array([2.0, 0.1, 0.1], np.float32) * REACH[patch]
    wanted = np.asarray(STAGE.black + 0.3 * REACH, np.float32)
    bent = adapted(wanted, floor)
    around = np.ones(wanted.shape[:2], np.bool_)
    around[patch] = False
    np.testing.assert_array_equal(bent[around], wanted[around])
    floor[patch] = STAGE.black[patch] + np.array([0.2, 0.05, 0.05], np.float32) * REACH[patch]
    assert (adapted(wanted, floor)[60, 58] > 1.02 * wanted[60, 58]).all(), "light that a grey outshines lifts it"


def test_chroma_goes_before_lightness() -> None:
    """A colour more saturated than can be shown becomes paler, of the same hue and lightness."""
    floor = np.asarray(STAGE.black + np.array([0, 0, 0.08], np.float32) * np.median(REACH), np.float32)
    colour = np.array([0.5, 0.25, 0.02], np.float32)
    wanted = np.broadcast_to(colour * np.float32(np.median(REACH)), floor.shape).copy()
    bent = adapted(wanted, floor)[60, 80]
    grey = np.array([0.25, 0.5, 0.25])
    before = wanted[60, 80]
    assert bent @ grey == pytest.approx(before @ grey, rel=0.02)
    part = (bent - bent @ grey) / (before - before @ grey)
    np.testing.assert_allclose(part, part[0], rtol=0.02)
    assert 0.3 < part[0] < 0.98
    assert DRIVE.of(adapted(wanted, floor) - floor)[60, 80].min() > -0.01


@settings(max_examples=15, deadline=None, derandomize=True)
@given(seed=st.integers(0, 10_000), bright=st.floats(0.05, 20), strength=st.floats(0, 1))
def test_any_target_stays_finite_and_comes_nearer_to_what_can_be_shown(
    seed: int, bright: float, strength: float
) -> None:
    random = np.random.default_rng(seed)
    wanted = (patches(random, 3) * REACH * bright).astype(np.float32)
    bent = adapted(wanted, strength=strength)
    assert np.isfinite(bent).all()
    assert (bent >= 0).all()
    outside = ~TRANSPORT.object_mask
    np.testing.assert_array_equal(bent[outside], wanted[outside])
    levels = (DRIVE.of(one - STAGE.black) for one in (wanted, bent))
    lacking = [float(np.abs(one - np.clip(one, 0, 1))[np.isfinite(one)].mean()) for one in levels]
    assert lacking[1] <= lacking[0] * (1 + 1e-4) + 1e-6


@settings(max_examples=25, deadline=None, derandomize=True)
@given(seed=st.integers(0, 10_000), bright=st.floats(0.05, 1), coloured=st.floats(0, 3))
def test_light_of_any_colour_from_other_surfaces_never_puts_more_out_of_reach(
    seed: int, bright: float, coloured: float
) -> None:
    random = np.random.default_rng(seed)
    wanted, floor = (np.asarray(patches(random, power) * REACH, np.float32) for power in (3, 6))
    wanted, floor = wanted * np.float32(bright), STAGE.black + floor * np.float32(coloured)
    bent = adapted(wanted, floor)
    before, after = (np.abs(off - np.clip(off, 0, 1)) for off in (DRIVE.of(one - floor) for one in (wanted, bent)))
    mask = TRANSPORT.object_mask
    in_reach = [float((np.nan_to_num(off).max(axis=2) <= 0.02)[mask].mean()) for off in (before, after)]
    assert in_reach[1] >= in_reach[0] - 0.02


def test_no_strength_leaves_a_target_as_it_is_and_a_wrong_one_is_refused() -> None:
    wanted = highlight(2.0)
    np.testing.assert_array_equal(adapted(wanted, strength=0.0), wanted)
    half, whole = adapted(wanted, strength=0.5), adapted(wanted)
    np.testing.assert_allclose(half, 0.5 * (wanted + whole), rtol=1e-4, atol=1e-6)
    with pytest.raises(UsageError) as refused:
        adapted(wanted, strength=1.5)
    assert refused.value.code == "adapt-strength"
