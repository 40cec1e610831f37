"""Real photographs; collected only where VELATURA_DATA names the folder that holds them (see conftest.py)."""

from __future__ import annotations

import os
from pathlib import Path

import cv2
import numpy as np
import pytest
import tifffile

from tests.controller.optics.calibrate.photometry.linearity import check_linearity


@pytest.mark.parametrize("filter_nm", [450, 550, 600])
def test_exposure_ratios_of_a_real_bracket_series_are_as_nominal(filter_nm: int) -> None:
    """8-bit Bayer images, made smaller: what lies near a clipped pixel holds some of it, and is left out."""
    folder = Path(os.environ["VELATURA_DATA"]) / "linear_bllanos" / "color_checker"
    series = [(int(path.name.split("_")[3][:-2]), path) for path in folder.glob(f"*_{filter_nm}nm_*.tif")]
    images = {ms: tifffile.imread(path).astype(np.float32) / np.float32(255) for ms, path in series}
    for short, long in ((50, 100), (100, 250), (250, 500)):
        clipped = cv2.dilate((images[long] > 0.8).astype(np.uint8), np.ones((7, 7))) > 0
        unclipped = np.where(clipped, np.nan, images[long]).astype(np.float32)
        measured = check_linearity(images[short], unclipped, long / short)
        assert measured.ratio == pytest.approx(long / short, rel=0.025)
