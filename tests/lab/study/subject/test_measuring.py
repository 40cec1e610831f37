"""What experiments measure photographs by."""

from __future__ import annotations

import numpy as np
import pytest

from controller.optics.plan.figures import last_kept
from controller.optics.solve.result.metrics import sharpness
from lab.study.experiments.frequency.experiment import bases
from lab.study.experiments.frequency.waves import COUNTS, kept_contrast, make_waves, stripes
from lab.study.subject.measuring import normalised_residual, quality, region_means, sharpness_map, unbounded_inverse
from lab.study.subject.subject import ReachableTarget
from tests.lab.study.array_stage import CAMERA, array_subject


def wanted_noise(seed: int = 1) -> ReachableTarget:
    rng = np.random.default_rng(seed)
    blocks = np.kron(rng.uniform(0.1, 0.9, (12, 16)), np.ones((8, 8)))
    return ReachableTarget(np.repeat(blocks[..., None], 3, axis=2).astype(np.float32), np.ones(CAMERA, np.bool_), 1.0)


def test_regions_with_too_few_pixels_are_told_as_unknown() -> None:
    values = np.arange(32 * 32, dtype=np.float32).reshape(32, 32)
    mask = np.zeros((32, 32), np.bool_)
    mask[:16] = True
    mask[16:18, :10] = True
    means = region_means(values, mask)
    assert means[0] == pytest.approx([values[:16, :16].mean(), values[:16, 16:].mean()])
    assert np.isnan(means[1]).all()


def test_the_residual_is_relative_to_the_targets_white() -> None:
    wanted = ReachableTarget(np.full((32, 32, 3), 2.0, np.float32), np.ones((32, 32), np.bool_), 4.0)
    off = normalised_residual(wanted.radiance + np.float32(0.2), wanted, wanted.mask)
    assert off == pytest.approx(0.05)
    assert (normalised_residual(wanted.radiance, wanted, wanted.mask) == 0).all()


def test_the_map_of_sharpness_agrees_with_the_figure_of_the_whole_picture() -> None:
    wanted = wanted_noise()
    blurred = 0.25 * sum(np.roll(wanted.radiance, (k, j), (0, 1)) for k in (0, 3) for j in (0, 3))
    local, whole = sharpness_map(np.asarray(blurred, np.float32), wanted, wanted.mask, 32)
    assert whole == pytest.approx(sharpness(np.asarray(blurred, np.float32), wanted.radiance, 1.0, wanted.mask))
    assert 0 < whole < 1
    same, one = sharpness_map(wanted.radiance, wanted, wanted.mask, 32)
    assert one == 1
    assert np.nanmin(same) == 1
    assert np.nanmean(local) < 1
    widest = 2 * max(wanted.mask.shape) + 1
    everywhere, _ = sharpness_map(np.asarray(blurred, np.float32), wanted, wanted.mask, widest)
    assert everywhere == pytest.approx(np.full(wanted.mask.shape, whole), rel=1e-6)


def test_structural_similarity_falls_with_error_and_is_one_without() -> None:
    subject, wanted = array_subject(1), wanted_noise()
    rng = np.random.default_rng(2)
    near, far = (wanted.radiance + rng.normal(0, s, (*CAMERA, 3)).astype(np.float32) for s in (0.01, 0.1))
    figures = [quality(subject, picture, wanted) for picture in (wanted.radiance, near, far)]
    assert figures[0].ssim == pytest.approx(1)
    assert figures[0].delta_e == 0
    assert figures[0].ssim > figures[1].ssim > figures[2].ssim
    assert figures[1].delta_e < figures[2].delta_e


def test_the_unbounded_inverse_makes_what_can_be_made_and_is_clipped() -> None:
    subject = array_subject(1)
    rng = np.random.default_rng(3)
    frame = rng.uniform(0.3, 0.7, (*subject.transport.sizes[0], 3)).astype(np.float32)
    black = subject.calibration.black
    within = subject.transport.forward([frame]) + black
    found = unbounded_inverse(subject.transport, within, black, iterations=25)
    again = subject.transport.forward(found) + black
    assert np.abs(again - within)[subject.mask].max() < 0.02
    beyond = unbounded_inverse(subject.transport, 3 * within, black, iterations=4)
    assert max(float(one.max()) for one in beyond) == 1


def test_contrast_is_what_is_left_of_the_wave_in_phase() -> None:
    subject = array_subject(1)
    waves = make_waves(subject, 0)
    radiance = waves.target.image
    wanted = ReachableTarget(radiance, subject.mask, 1.0)
    mean = np.float32(0.5)
    assert np.nanmax(np.abs(kept_contrast(mean + 0.6 * (radiance - mean), wanted, waves) - 0.6)) < 0.02
    assert np.nanmax(np.abs(kept_contrast(np.full_like(radiance, mean), wanted, waves))) < 0.02
    assert waves.pitch_px == pytest.approx(3.0, abs=0.05)


def test_stripes_are_right_without_contrast_and_wrong_where_they_alias_or_are_lost() -> None:
    subject = array_subject(1)
    waves = make_waves(subject, 0)
    wanted = ReachableTarget(waves.target.image, subject.mask, 1.0)
    detail = waves.target.image - np.float32(0.5)
    slope = np.linspace(0.7, 1.3, CAMERA[1], dtype=np.float32)[None, :, None]
    faint = stripes((np.float32(0.5) + 0.1 * detail) * slope, wanted, waves)
    assert np.nanmin(faint.agree) > 0.9
    assert faint.limit(waves.frequency) == waves.frequency[-1], "a tenth of the contrast, and uneven light"

    noise = np.random.default_rng(3).normal(0, 0.02, waves.phase.shape).astype(np.float32)[..., None]
    noisy = stripes(waves.target.image + noise, wanted, waves)
    slow = noisy.count[: len(waves.frequency) // 2]
    assert np.nanmax(np.abs(slow - 1)) <= COUNTS, "noise where a wave crosses its mean is no stripe"

    finer = waves.band >= len(waves.frequency) // 2
    aliased = np.repeat((0.5 + 0.1 * np.cos(0.6 * waves.phase))[..., None], 3, axis=2).astype(np.float32)
    middle = float(waves.frequency[len(waves.frequency) // 2])
    for lost in (aliased, np.full_like(aliased, 0.5), 0.5 - 0.1 * detail):
        shown = stripes(np.where(finer[..., None], lost, waves.target.image), wanted, waves)
        assert 0.8 * middle < shown.limit(waves.frequency) <= middle
    assert not stripes(aliased, wanted, waves).picture[waves.band < 0].any()


def test_the_limit_lies_between_the_bands_round_the_half() -> None:
    frequency = np.array([1.0, 2.0, 3.0, 4.0])
    assert last_kept(frequency, np.array([1.0, 0.9, 0.4, 0.8])) == pytest.approx(2.8)
    assert last_kept(frequency, np.array([1.0, np.nan, 0.6, 0.7])) == 4.0


def test_the_two_bases_share_the_detail_between_them() -> None:
    subject = array_subject(1)
    waves = make_waves(subject, 0)
    black = subject.calibration.black
    wanted = ReachableTarget(np.maximum(waves.target.image, black), subject.mask, 1.0)
    limit = float(waves.frequency[len(waves.frequency) // 2])
    high, _, low = bases(wanted, black, subject.mask, limit).values()
    kept_high, kept_low = (kept_contrast(base, wanted, waves) for base in (high, low))
    assert kept_high[-1] > 0.8 > 0.3 > kept_high[0]
    assert kept_low[0] > 0.9 > 0.3 > kept_low[-1]
