"""Contrast adaptation: within reach, local contrast kept, nothing changed where light suffices."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from controller.calibrate.values import Calibration
from controller.core.arrays import FloatImage
from controller.core.errors import UsageError
from controller.solve.adapt import GIVEN_UP, adapt, adapt_gently, contrast_kept
from controller.solve.drive_levels import DriveLevels
from controller.transport import build_transport
from tests.controller.solve.conftest import plane_calibration

Stage = Callable[..., Calibration]
STAGE = plane_calibration(projector=(40, 52), camera=(120, 160), spill=0.0)
TRANSPORT = build_transport(STAGE)
DRIVE = DriveLevels(TRANSPORT)
WHITE = float(TRANSPORT.reach().max())


def wallpaper(bright: float) -> FloatImage:
    """A fine pattern; its left half needs up to ``bright`` of the light there, its right half at most half of it."""
    y, x = np.mgrid[0:120, 0:160].astype(np.float32)
    pattern = 0.75 + 0.25 * np.sin(x / 2) * np.sin(y / 2)
    level = np.where(x < 60, bright, np.where(x > 100, 0.5, 0.0))
    between = (x >= 60) & (x <= 100)
    level = np.where(between, bright + (0.5 - bright) * (x - 60) / 40, level)
    return np.asarray(STAGE.black + TRANSPORT.reach() * (level * pattern)[..., None], np.float32)


def clipped(wanted: FloatImage) -> FloatImage:
    """What the projectors show at best of a target beyond their reach."""
    return np.clip(wanted, STAGE.black, STAGE.black + TRANSPORT.reach())


def test_an_adapted_target_is_in_reach_and_keeps_more_contrast_than_cutting_off() -> None:
    wanted = wallpaper(1.8)
    adapted = adapt(TRANSPORT, wanted, STAGE.black, drive=DRIVE)
    assert adapted.before.share < 0.75
    assert adapted.after.share > 0.99
    mask = TRANSPORT.object_mask
    hard = contrast_kept(clipped(wanted), wanted, mask, white=WHITE)
    gentle = contrast_kept(clipped(adapted.target), wanted, mask, white=WHITE)
    assert gentle > hard + 0.1


def test_a_few_highlights_are_cut_off_rather_than_their_surroundings_dimmed() -> None:
    wanted = wallpaper(0.6)
    wanted[30:33, 40:43] *= 4
    adapted, cut_off, kept = adapt_gently(TRANSPORT, wanted, STAGE.black, white=WHITE, drive=DRIVE)
    assert kept == pytest.approx(cut_off, abs=1e-6)
    np.testing.assert_allclose(adapted.gain, 1)
    much, cut_off, kept = adapt_gently(TRANSPORT, wallpaper(1.8), STAGE.black, white=WHITE, drive=DRIVE)
    assert kept > cut_off + 0.1
    assert much.after.share > 1 - GIVEN_UP[0]


def test_pixels_that_hardly_any_light_reaches_do_not_darken_the_rest() -> None:
    wanted = wallpaper(1.8)
    wanted[::25, ::25] *= 300
    adapted, cut_off, kept = adapt_gently(TRANSPORT, wanted, STAGE.black, white=WHITE, drive=DRIVE)
    assert adapted.gain.min() > 0.3
    assert kept > cut_off + 0.05
    assert adapt(TRANSPORT, wanted, STAGE.black, drive=DRIVE).gain.min() < 0.01


def test_where_light_suffices_nothing_changes() -> None:
    wanted = wallpaper(1.8)
    adapted = adapt(TRANSPORT, wanted, STAGE.black, drive=DRIVE)
    np.testing.assert_allclose(adapted.gain[:, 120:], 1)
    np.testing.assert_allclose(adapted.target[:, 120:], wanted[:, 120:], rtol=1e-5)
    enough = adapt(TRANSPORT, wallpaper(0.65), STAGE.black, drive=DRIVE)
    np.testing.assert_allclose(enough.target, wallpaper(0.65), rtol=1e-5)


def test_the_gain_varies_slowly() -> None:
    gain = adapt(TRANSPORT, wallpaper(2.5), STAGE.black, drive=DRIVE).gain
    assert np.abs(np.diff(gain, axis=1)).max() < 0.1
    assert gain[:, :40].max() < 0.5


def test_the_darkest_tones_keep_their_order_above_the_black_image() -> None:
    wanted = np.empty_like(STAGE.black)
    wanted[:] = np.linspace(0, 0.006, 160, dtype=np.float32)[None, :, None]
    adapted = adapt(TRANSPORT, wanted, STAGE.black, drive=DRIVE)
    assert (np.diff(adapted.target[60, :, 1]) > 0).all()
    assert (adapted.target > STAGE.black).all()


@settings(max_examples=20, deadline=None, derandomize=True)
@given(seed=st.integers(0, 10_000), bright=st.floats(0.1, 20))
def test_any_target_comes_within_reach(seed: int, bright: float) -> None:
    random = np.random.default_rng(seed)
    wanted = (random.random((120, 160, 1)) ** 3 * TRANSPORT.reach() * bright).astype(np.float32)
    adapted = adapt(TRANSPORT, wanted, STAGE.black, drive=DRIVE)
    assert adapted.after.share >= adapted.before.share
    assert adapted.after.too_bright.max() < 1e-3
    assert 0 < adapted.gain.min() <= adapted.gain.max() <= 1


def test_no_strength_leaves_a_target_as_it_is_and_a_wrong_one_is_refused() -> None:
    wanted = wallpaper(1.8)
    np.testing.assert_allclose(adapt(TRANSPORT, wanted, STAGE.black, strength=0, drive=DRIVE).target, wanted, rtol=1e-5)
    with pytest.raises(UsageError) as refused:
        adapt(TRANSPORT, wanted, STAGE.black, strength=1.5, drive=DRIVE)
    assert refused.value.code == "adapt-strength"


def test_contrast_that_is_not_the_targets_does_not_count() -> None:
    wanted = wallpaper(0.9)
    mask = TRANSPORT.object_mask
    assert contrast_kept(wanted, wanted, mask, white=WHITE) == pytest.approx(1, abs=1e-3)
    noise = np.random.default_rng(0).uniform(0, WHITE, wanted.shape).astype(np.float32)
    assert contrast_kept(noise, wanted, mask, white=WHITE) < 0.5
    assert contrast_kept(np.full_like(wanted, 0.3), wanted, mask, white=WHITE) < 1e-3
