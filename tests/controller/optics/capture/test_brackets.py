from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from controller.core.arrays import FloatImage, Mask
from controller.core.errors import UsageError
from controller.optics.capture.brackets import (
    RELATIVE_NOISE,
    choose_brackets,
    choose_exposure,
    merge_brackets,
    minimum_level,
)
from controller.optics.capture.profile import CameraNoise

EXPOSURES = tuple(2.0**stop for stop in np.arange(-12, 3, 1 / 3))
NOISE = CameraNoise(shot=1 / 5000, read=8 / 5000)


def expose(radiance: FloatImage, exposure_s: float, seed: int = 0) -> FloatImage:
    signal = radiance * exposure_s
    random = np.random.default_rng(seed)
    value = signal + np.sqrt(NOISE.shot * signal + NOISE.read**2) * random.standard_normal(signal.shape)
    value = np.round(value * 4095) / 4095
    return np.where(value < 0.985, value, np.nan).astype(np.float32)


def scene(decades: float = 3.0) -> FloatImage:
    return np.broadcast_to(np.geomspace(1, 10**decades, 200)[None, :, None], (150, 200, 3)).astype(np.float32)


def test_a_merged_bracket_is_unbiased_over_its_whole_range_and_knows_its_noise() -> None:
    truth = scene()
    times = (1 / 1200, 1 / 150, 1 / 19)
    merged = merge_brackets([expose(truth, t, n) for n, t in enumerate(times)], times, noise=NOISE)
    assert np.isfinite(merged.radiance).all()
    mean = merged.radiance.mean(axis=(0, 2))
    np.testing.assert_allclose(mean, truth[0, :, 0], rtol=0.02)
    pull = (merged.radiance - truth) / merged.sigma
    assert 0.9 < pull.std() < 1.1
    alone = expose(truth, times[0]) / times[0]
    assert np.std((merged.radiance / truth)[:, :50]) < 0.2 * np.std((alone / truth)[:, :50])


def test_saturated_in_every_exposure_is_not_measured() -> None:
    truth = scene()
    merged = merge_brackets([expose(truth, 0.01), expose(truth, 0.1)], (0.01, 0.1), noise=NOISE)
    lost = truth * 0.01 > 1.1
    assert np.all(np.isnan(merged.radiance[lost]))
    assert np.isfinite(merged.radiance[truth * 0.01 < 0.9]).all()


def made_smaller(radiance: FloatImage, exposure_s: float, seed: int) -> FloatImage:
    """A photograph of 8 bits, made smaller after it was clipped: what is mixed with clipped light does not say so."""
    full = np.nan_to_num(expose(radiance, exposure_s, seed), nan=1.0)
    rows, columns, _ = full.shape
    small = full.reshape(rows // 2, 2, columns // 2, 2, 3).mean(axis=(1, 3))
    value = np.clip(np.round(small * 255), 0, 255) / 255
    return np.where(value < 1, value, np.nan).astype(np.float32)


@pytest.mark.parametrize("decades", [0.5, 1.0])
def test_light_that_was_clipped_before_a_picture_was_made_smaller_does_not_count(decades: float) -> None:
    """OpenCV's MergeDebevec, which trusts values near clipping little, gets the same pictures, a channel at a time."""
    over_the_picture = np.arange(160)[None, :, None] / 160
    random = np.random.default_rng(4)
    radiance = (10 ** (random.uniform(0, decades, (120, 160, 3)) + over_the_picture)).astype(np.float32)
    parts = radiance.reshape(60, 2, 80, 2, 3)
    truth = parts.mean(axis=(1, 3))
    times = np.array([1 / 100, 1 / 25, 1 / 6], np.float32) * 10 ** (1 - decades)
    images = [made_smaller(radiance, float(one), n) for n, one in enumerate(times)]
    ours = merge_brackets(images, times.tolist()).radiance
    pictures = [np.round(np.nan_to_num(one, nan=1.0) * 255).astype(np.uint8) for one in images]
    line = np.repeat(np.maximum(np.arange(256) / 255, 1e-6)[:, None, None], 3, axis=2).astype(np.float32)
    grey = [[np.repeat(one[..., c : c + 1], 3, axis=2) for one in pictures] for c in range(3)]
    merged = [np.asarray(cv2.createMergeDebevec().process(one, times, line))[..., 0] for one in grey]
    theirs = np.stack(merged, axis=-1)
    judged = (truth * times[0] > 8 / 255) & (parts.max(axis=(1, 3)) * times[0] < 0.9)
    assert judged.mean() > 0.9
    off, off_theirs = (float(np.percentile(np.abs(one / truth - 1)[judged], 95)) for one in (ours, theirs))
    assert off < 0.045
    assert off < 0.5 * off_theirs


FIVE, FOUR, APART = [4.0**k for k in range(-4, 1)], [4.0**k for k in range(-3, 1)], [1 / 16, 1.0]


@pytest.mark.parametrize(
    ("times", "noise", "bits", "darkest"),
    [
        (FIVE, CameraNoise(1 / 30_000, 6 / 30_000), 12, 3e-5),
        (FIVE, NOISE, 12, 2e-4),
        (APART, CameraNoise(1 / 30_000, 6 / 30_000), 12, 3e-4),
        (FOUR, CameraNoise(0, 0.006), 8, 1e-3),
        (FOUR, CameraNoise(0.001, 0.003), 8, 1e-3),
        (APART, CameraNoise(0, 0.0005), 8, 2e-3),
    ],
)
def test_noise_alone_takes_no_exposure_out_of_a_bracket(
    times: list[float], noise: CameraNoise, bits: int, darkest: float
) -> None:
    """A short exposure that is bright by chance must not overrule a long one. With 8 bits, the noise is unknown."""
    lightest = 0.9 / times[0]
    truth = np.geomspace(darkest * lightest, lightest, 500, dtype=np.float32)[None, :, None].repeat(400, 0).repeat(3, 2)
    random, full = np.random.default_rng(8), 2**bits - 1
    images = []
    for seconds in times:
        signal = truth * seconds
        value = signal + np.sqrt(noise.shot * signal + noise.read**2) * random.standard_normal(signal.shape)
        value = np.round(value * full) / full
        value = np.clip(value, 0, None) if bits == 8 else value  # a file of whole numbers has nothing below black
        images.append(np.where(value < 1, value, np.nan).astype(np.float32))
    merged = merge_brackets(images, times, noise=None if bits == 8 else noise).radiance
    off = merged / truth
    usable = np.max([np.where(truth * t < 0.9, truth * t, 0) for t in times], axis=0)
    sure = np.sqrt(noise.shot * usable + noise.read**2) < 0.12 * usable
    assert sure.mean() > 0.8
    assert np.abs(off - 1)[sure].max() < 0.5
    for part in np.array_split(np.arange(500), 5):
        assert off[:, part][sure[:, part]].mean() == pytest.approx(1, abs=0.004)


@pytest.mark.parametrize("change", [0.97, 1.0, 1.03, 1.5])
def test_a_flickering_lamp_takes_no_exposure_out_of_the_bracket(change: float) -> None:
    """Nor does light that came on during the longer one: only what clipping does is looked for."""
    radiance = scene(0.5)
    times = (0.02, 0.2)
    images = [expose(radiance, times[0]), expose(radiance * change, times[1], 1)]
    merged = merge_brackets(images, times, noise=NOISE)
    longer = np.isfinite(images[1])
    alone = np.sqrt(NOISE.shot * merged.radiance / times[0] + (NOISE.read / times[0]) ** 2)
    assert longer.mean() > 0.5
    assert (merged.sigma < 0.5 * alone)[longer].mean() > 0.98


def test_a_bracket_that_does_not_fit_together_is_refused() -> None:
    image = scene()
    for images, times in (([image], (0.1, 0.2)), ([], ()), ([image, image[:5]], (0.1, 0.2)), ([image], (0.0,))):
        with pytest.raises(UsageError) as caught:
            merge_brackets(images, times)
        assert caught.value.code == "bracket-mismatch"


@settings(max_examples=40, deadline=None)
@given(st.floats(0.3, 300), st.floats(-10, 1))
def test_the_exposure_for_patterns_is_found_from_any_first_photograph(brightest: float, first_stop: float) -> None:
    radiance = brightest * np.random.default_rng(1).uniform(0.2, 1.0, (40, 60, 3)).astype(np.float32)
    exposure_s = 2.0**first_stop
    for _ in range(8):
        choice = choose_exposure(expose(radiance, exposure_s), exposure_s, EXPOSURES)
        exposure_s = choice.exposure_s
        if choice.settled:
            break
    assert choice.settled
    level = np.nanpercentile((radiance * exposure_s).max(axis=2), 99.5)
    assert 0.55 < level < 0.83


def test_dark_and_blinding_scenes_settle_at_the_cameras_limits() -> None:
    dark = np.zeros((20, 20, 3), np.float32)
    assert choose_exposure(dark, EXPOSURES[-1], EXPOSURES).settled
    assert choose_exposure(dark, EXPOSURES[-1], EXPOSURES).exposure_s == EXPOSURES[-1]
    blind = np.full((20, 20, 3), np.nan, np.float32)
    assert not choose_exposure(blind, 1.0, EXPOSURES).settled
    assert choose_exposure(blind, EXPOSURES[0], EXPOSURES).settled


def bracketed(radiance: FloatImage, lit: Mask | None = None) -> tuple[float, ...]:
    """The exposures chosen from a first photograph that may be far off."""
    exposure_s = 0.5
    while True:
        choice = choose_brackets(expose(radiance, exposure_s), exposure_s, EXPOSURES, lit=lit, noise=NOISE)
        if choice.settled:
            return choice.exposures_s
        assert len(choice.exposures_s) == 1
        exposure_s = choice.exposures_s[0]


@pytest.mark.parametrize("decades", [0.3, 1.0, 2.0, 2.8])
def test_brackets_measure_the_brightest_and_the_darkest(decades: float) -> None:
    radiance = scene(decades)
    chosen = bracketed(radiance, np.ones(radiance.shape[:2], np.bool_))
    assert list(chosen) == sorted(set(chosen))
    assert set(chosen) <= set(EXPOSURES)
    assert 2 <= len(chosen) <= 4
    assert radiance.max() * chosen[0] < 0.95
    signal = np.percentile(radiance, 2) * chosen[-1]
    assert np.sqrt(NOISE.shot * signal + NOISE.read**2) / signal < 0.03 or len(chosen) == 4


@settings(max_examples=20, deadline=None)
@given(st.floats(0.3, 300))
def test_a_bracket_begins_with_the_exposure_of_the_patterns(brightest: float) -> None:
    radiance = brightest * np.random.default_rng(1).uniform(0.2, 1.0, (40, 60, 3)).astype(np.float32)
    exposure_s, fine = 0.5 / brightest, tuple(0.001 * 1.001**step for step in range(9000))
    image = expose(radiance, exposure_s)
    chosen = choose_exposure(image, exposure_s, fine)
    assert chosen.settled
    assert choose_brackets(image, exposure_s, fine, noise=NOISE).exposures_s[0] == chosen.exposure_s


def test_everything_between_two_exposures_is_measured_well() -> None:
    radiance = scene(1.5)
    chosen = bracketed(radiance)
    merged = merge_brackets([expose(radiance, t, n) for n, t in enumerate(chosen)], chosen, noise=NOISE)
    relative = merged.sigma / radiance
    assert np.nanpercentile(relative, 98) < 0.05
    assert np.median(relative) < 0.02


@pytest.mark.parametrize(("decades", "count"), [(0.2, 2), (1.0, 2), (1.4, 2)])
def test_two_exposures_are_enough_for_a_camera_as_the_papers(decades: float, count: int) -> None:
    radiance = scene(decades)
    first_s = 0.8 / float(radiance.max())
    image = (radiance * first_s).astype(np.float32)
    assert len(choose_brackets(image, first_s, EXPOSURES).exposures_s) == count


def test_the_least_level_is_where_noise_is_the_share_asked_for() -> None:
    level = minimum_level(NOISE)
    assert np.sqrt(NOISE.shot * level + NOISE.read**2) == pytest.approx(RELATIVE_NOISE * level)


def test_a_camera_without_exposures_is_explained() -> None:
    with pytest.raises(UsageError) as caught:
        choose_exposure(scene(), 1.0, ())
    assert caught.value.code == "no-exposures"
