"""Colours that depend on the paint, at camera pixels, against what spectra say."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from controller.core.arrays import Float64
from controller.optics.calibrate.values import Calibration, ProjectorCalibration, Radiometry
from controller.optics.transport.indirect.fit import fit_indirect, paint_colours
from tests.controller.optics.calibrate.spectra import colours
from tests.controller.optics.solve.conftest import plane_calibration

LIKE_WHITE = np.einsum("kjc,jm->kcm", colours(), np.linalg.inv(colours().sum(axis=2)))
"""B of the three paints."""


def painted(seed: int, strengths: Float64) -> tuple[Calibration, Float64]:
    """A stage of random paints that two projectors light, and the albedos (rows, columns, 3)."""
    calibration = plane_calibration(2, camera=(24, 30), projector=(12, 15), projectors=2)
    paint = np.random.default_rng(seed).uniform(0.1, 1.0, (*calibration.black.shape[:2], 3))
    parts = []
    for part, strength in zip(calibration.projectors, strengths, strict=True):
        white = strength * np.einsum("kjc,yxj->yxk", colours(), paint)
        radiometry = Radiometry(part.radiometry.response, colours().sum(axis=1), paint=LIKE_WHITE)
        parts.append(replace(part, white=white.astype(np.float32), radiometry=radiometry))
    return replace(calibration, projectors=tuple(parts)), paint


@pytest.mark.parametrize("seed", [1, 2])
def test_light_of_any_colour_on_any_paint_becomes_what_spectra_say(seed: int) -> None:
    calibration, paint = painted(seed, np.array([1.0, 0.4]))
    lit = np.ones(paint.shape[:2], np.bool_)
    light = fit_indirect(calibration, lit, None, None)
    assert light is not None
    shown = np.random.default_rng(seed + 10).uniform(0, 1, paint.shape)
    first: ProjectorCalibration = calibration.projectors[0]
    said = (first.white * (shown @ first.radiometry.mixing.T)).astype(np.float32)
    seen = np.einsum("kjc,yxj,yxc->yxk", colours(), paint, shown)
    np.testing.assert_allclose(said + light.forward(said), seen, atol=2e-3)
    assert np.abs(said - seen).max() > 0.02
    np.testing.assert_allclose(light.direct_target(seen.astype(np.float32)), said, atol=4e-3)
    np.testing.assert_allclose(first.white + light.forward(first.white), first.white, atol=1e-3)


def test_pixels_that_nothing_lights_and_stages_of_one_mixing() -> None:
    calibration, paint = painted(3, np.array([1.0, 1.0]))
    lit = np.zeros(paint.shape[:2], np.bool_)
    lit[:5] = True
    found = paint_colours(calibration, lit)
    assert found is not None
    assert not found[:, :, 5:].any()
    alone = replace(calibration.projectors[1].radiometry, paint=None)
    one = replace(
        calibration, projectors=(calibration.projectors[0], replace(calibration.projectors[1], radiometry=alone))
    )
    assert paint_colours(one, lit) is None
    assert fit_indirect(one, lit, None, None) is None
