"""Real photographs of a colour chart at seven exposures; collected only where VELATURA_DATA names their folder."""

from __future__ import annotations

import itertools
import os
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import pytest
import tifffile

from controller.core.arrays import Float64
from controller.optics.capture.brackets import merge_brackets
from controller.optics.capture.demosaic import SensorLevels
from controller.optics.capture.jpeg_response import measure_response
from controller.optics.capture.linearity import RawExposure, check_series
from controller.optics.capture.profile import measure_noise

LEVELS = SensorLevels(np.array([[0, 1], [1, 2]]), np.zeros((2, 2)), np.full((2, 2), 255.0), np.full((2, 2), 250.0))
"""8-bit samples, made smaller: what lies near a clipped one holds some of its light."""


def series(filter_nm: int) -> list[RawExposure]:
    folder = Path(os.environ["VELATURA_DATA"]) / "linear_bllanos" / "color_checker"
    paths = sorted((int(path.name.split("_")[3][:-2]), path) for path in folder.glob(f"*_{filter_nm}nm_*.tif"))
    return [RawExposure(tifffile.imread(path).astype(np.uint16), ms / 1000) for ms, path in paths]


@pytest.mark.parametrize("filter_nm", [400, 450, 500, 550, 600, 650, 700])
def test_every_exposure_ratio_is_measured_as_told(filter_nm: int) -> None:
    found = check_series(series(filter_nm), LEVELS)
    for (a, b), (told_a, told_b) in zip(
        itertools.pairwise(found.ratios), itertools.pairwise(found.nominal), strict=True
    ):
        assert b / a == pytest.approx(told_b / told_a, rel=0.025)


def shape(table: npt.NDArray[Any]) -> Float64:
    """How a response differs from a linear one below the values that clipped neighbours have changed; 1 at 150."""
    values = np.arange(20, 171)
    return np.asarray(table[values] / values / (table[150] / 150), np.float64)


@pytest.mark.parametrize("filter_nm", [450, 600])
def test_the_response_of_a_linear_camera_is_found_linear_better_than_by_opencv(filter_nm: int) -> None:
    photographs = series(filter_nm)
    images = [np.repeat(one.samples.astype(np.uint8)[:, :, None], 3, axis=2) for one in photographs]
    times = np.array([one.exposure_s for one in photographs], np.float32)
    ours = shape(measure_response(images, times.tolist()).table[0])
    theirs = shape(cv2.createCalibrateDebevec(samples=400, lambda_=10.0).process(images, times)[:, 0, 0])
    assert np.abs(ours - 1).max() < 0.05
    assert np.abs(ours - 1).mean() < np.abs(theirs - 1).mean()


@pytest.mark.parametrize("held_ms", [100, 250])
@pytest.mark.parametrize("filter_nm", [450, 500, 550, 600])
def test_a_photograph_that_was_left_out_is_predicted_better_than_by_opencvs_merge(filter_nm: int, held_ms: int) -> None:
    photographs = series(filter_nm)
    held = next(one for one in photographs if one.exposure_s == held_ms / 1000)
    used = [one for one in photographs if one is not held]
    times = [one.exposure_s for one in used]
    images = [np.repeat(one.samples.astype(np.uint8)[:, :, None], 3, axis=2) for one in used]
    ours = merge_brackets([np.where(one < 255, one / np.float32(255), np.nan) for one in images], times).radiance
    line = np.repeat(np.maximum(np.arange(256) / 255, 1e-6)[:, None, None], 3, axis=2).astype(np.float32)
    theirs = np.asarray(cv2.createMergeDebevec().process(images, np.array(times, np.float32), line))
    # Near a clipped sample the photograph that judges does not say itself what the light was.
    clipped = cv2.dilate((held.samples > 220).astype(np.uint8), np.ones((13, 13), np.uint8)) > 0
    judged = (held.samples > 8) & ~clipped
    assert judged.mean() > 0.05
    off, off_theirs = (
        np.abs(one[..., 0] * held.exposure_s * 255 / np.maximum(held.samples, 1) - 1)[judged] for one in (ours, theirs)
    )
    assert np.percentile(off, 95) < 0.06
    assert np.percentile(off, 95) < np.percentile(off_theirs, 95)


def test_real_noise_is_explained_by_shot_and_read_noise() -> None:
    samples = [np.where(one.samples < 250, one.samples, np.nan) / 255 for one in series(450)[3:5]]
    found = measure_noise([(samples[0].astype(np.float32), samples[1].astype(np.float32))])
    assert found is not None
    assert 0.7 < found.misfit < 1.3
