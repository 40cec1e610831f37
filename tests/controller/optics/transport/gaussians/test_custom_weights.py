"""Other models of a projector pixel in the place of metapixels."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest
import scipy.sparse as sp

from controller.core.errors import UsageError
from controller.optics.calibrate.values import Calibration, Metapixels
from controller.optics.transport import build_transport
from controller.optics.transport.gaussians.patches import patches_of_weights
from lab.study.experiments.quadrilateral import quadrilateral_weights
from tests.controller.optics.transport.conftest import random_frames
from tests.controller.optics.transport.sparse_shares import gaussian_weights, normalised, predicted

Stage = Callable[..., Calibration]


def on_grids(calibration: Calibration) -> Calibration:
    """The same stage with projectors whose pixels lie side by side."""
    parts = []
    for n, part in enumerate(calibration.projectors):
        row, column = np.mgrid[0 : part.metapixels.valid.shape[0], 0 : part.metapixels.valid.shape[1]]
        centre = np.stack([20 + 60 * n + 5.2 * column + row, 3 + 6.1 * row - 0.5 * column], -1).astype(np.float32)
        every = np.ones(row.shape, np.bool_)
        pixels = Metapixels(centre, np.ones((*row.shape, 3), np.float32), every)
        parts.append(dataclasses.replace(part, metapixels=pixels))
    return dataclasses.replace(calibration, projectors=tuple(parts))


def test_gaussians_as_a_matrix_give_the_same_transport(stage: Stage) -> None:
    calibration = stage(3)
    shape = (calibration.object_mask.shape[0], calibration.object_mask.shape[1])
    weights = [gaussian_weights(part.metapixels, shape) for part in calibration.projectors]
    direct = build_transport(calibration)
    other = build_transport(calibration, patches=patches_of_weights(weights, shape))
    frames = random_frames(direct)
    np.testing.assert_allclose(other.forward(frames), direct.forward(frames), rtol=1e-3, atol=1e-5)


def test_quadrilaterals_give_a_transport_with_the_same_white_and_their_own_shares(stage: Stage) -> None:
    calibration = on_grids(stage(3))
    shape = (calibration.object_mask.shape[0], calibration.object_mask.shape[1])
    weights = [quadrilateral_weights(part.metapixels, shape) for part in calibration.projectors]
    transport = build_transport(calibration, patches=patches_of_weights(weights, shape))
    frames = random_frames(transport)
    for n, part in enumerate(calibration.projectors):
        white = transport.forward_part(n, np.ones_like(frames[n]))
        np.testing.assert_allclose(white[transport.lit[n]], part.white[transport.lit[n]], rtol=1e-4)
        wanted, _ = predicted(normalised(weights[n]), part.white, part.radiometry.mixing, frames[n])
        got = transport.forward_part(n, frames[n])
        # weights of less than half a part in 65535 are nothing in a patch
        np.testing.assert_allclose(got[transport.lit[n]], wanted[transport.lit[n]], atol=2e-3)


@pytest.mark.parametrize("value", [-0.1, 1.5, np.nan])
def test_weights_that_are_no_weights_are_refused(value: float) -> None:
    with pytest.raises(UsageError) as refused:
        patches_of_weights([sp.csr_matrix(np.full((12, 2), value))], (3, 4))
    assert refused.value.code == "weights-wrong"


def test_weights_of_another_image_are_refused() -> None:
    with pytest.raises(UsageError) as refused:
        patches_of_weights([sp.csr_matrix(np.ones((12, 2)))], (4, 4))
    assert refused.value.code == "weights-wrong"
