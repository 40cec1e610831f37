"""The camera's own blur in the transport: what it keeps, and its use."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy import ndimage

from controller.core.arrays import FloatImage
from controller.optics.calibrate.values import Calibration, Metapixels, ProjectorCalibration, Radiometry
from controller.optics.transport import build_transport
from controller.optics.transport.gaussians.transport import gaussian_taps, without_blur
from tests.controller.optics.transport.conftest import products

Stage = Callable[..., Calibration]
BLUR_PX = (0.9, 0.7, 0.9)
slow_start = settings(
    max_examples=10, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture], derandomize=True
)


def blurred(image: FloatImage, sigma_px: tuple[float, float, float] = BLUR_PX) -> FloatImage:
    """By SciPy, not by the code under test."""
    channels = [
        ndimage.gaussian_filter(image[..., c].astype(np.float64), sigma_px[c], mode="constant", radius=3)
        for c in range(3)
    ]
    return np.stack(channels, axis=-1).astype(np.float32)


@slow_start
@given(seed=st.integers(0, 2**31), sigma=st.floats(0.4, 6))
def test_with_blur_the_adjoint_is_still_the_transpose(stage: Stage, seed: int, sigma: float) -> None:
    calibration = dataclasses.replace(stage(seed, largest_sigma=sigma), camera_blur_px=BLUR_PX)
    transport = build_transport(calibration)
    rng = np.random.default_rng(seed)
    frames = [rng.random((*size, 3), np.float32) for size in transport.sizes]
    r = rng.random((*transport.camera_shape, 3), np.float32)
    forward, backward = products(transport, frames, r)
    assert forward == pytest.approx(backward, rel=2e-5)


@slow_start
@given(seed=st.integers(0, 2**31))
def test_with_blur_a_projector_at_white_is_still_its_white_image(stage: Stage, seed: int) -> None:
    calibration = dataclasses.replace(stage(seed), camera_blur_px=BLUR_PX)
    transport = build_transport(calibration)
    for n, projector in enumerate(calibration.projectors):
        light = transport.forward_part(n, np.ones((*transport.sizes[n], 3), np.float32))
        lit = transport.lit[n]
        np.testing.assert_allclose(light[lit], projector.white[lit], rtol=2e-4, atol=1e-6)
        assert not light[~lit].any()


def test_the_taps_are_those_of_a_gaussian() -> None:
    taps = gaussian_taps(BLUR_PX)
    spike = np.zeros((15, 15, 3), np.float32)
    spike[7, 7] = 1
    expected = blurred(spike)
    for channel in range(3):
        kernel = np.outer(taps[channel], taps[channel])
        np.testing.assert_allclose(kernel, expected[4:11, 4:11, channel], atol=1e-6)


@given(angle=st.floats(0, np.pi), wide=st.floats(1.2, 3), narrow=st.floats(0.95, 1.2))
def test_taking_the_blur_away_undoes_adding_it(angle: float, wide: float, narrow: float) -> None:
    c, s = np.cos(angle), np.sin(angle)
    turn = np.array([[c, -s], [s, c]])
    on_object = turn @ np.diag([wide**2 - 0.6, narrow**2 - 0.6]) @ turn.T
    seen = on_object + 0.6 * np.eye(2)
    covariance = np.array([[[seen[0, 0], seen[0, 1], seen[1, 1]]]], np.float32)
    metapixels = Metapixels(np.zeros((1, 1, 2), np.float32), covariance, np.ones((1, 1), np.bool_))
    found = without_blur(metapixels, (0.6**0.5,) * 3).covariance_px2[0, 0]
    np.testing.assert_allclose(found, [on_object[0, 0], on_object[0, 1], on_object[1, 1]], atol=1e-4)


def test_at_painted_edges_the_prediction_is_better_by_far() -> None:
    """A painted, projected-on wall, photographed through a blur that this test makes itself."""
    rows, columns, pitch = 80, 100, 2.6
    size = (28, 36)
    row, column = np.mgrid[0:rows, 0:columns]
    paint = np.where((column + row) // 9 % 2, 0.8, 0.25)[..., None] * np.array([1, 0.9, 0.8])
    centre = np.stack(np.meshgrid(np.arange(size[1]) * pitch + 3, np.arange(size[0]) * pitch + 3), -1)
    own = 0.45 * pitch
    # What cancels the paint changes just where the paint does: the case that matters.
    frame = np.where((centre.sum(-1) // 9 % 2)[..., None] > 0, 0.3, 0.9) * np.ones(3)
    weights = np.exp(
        -0.5
        * ((column[..., None] - centre[..., 0].ravel()) ** 2 + (row[..., None] - centre[..., 1].ravel()) ** 2)
        / own**2
    )
    shares = weights / weights.sum(-1, keepdims=True)
    photograph = blurred((paint * (shares @ frame.reshape(-1, 3))).astype(np.float32))
    total = own**2 + np.mean(np.square(BLUR_PX))
    covariance = np.broadcast_to(np.array([total, 0, total], np.float32), (*size, 3)).copy()
    metapixels = Metapixels(centre.astype(np.float32), covariance, np.ones(size, np.bool_))
    radiometry = Radiometry(np.tile(np.linspace(0, 1, 256), (3, 1)), np.eye(3))
    projector = ProjectorCalibration("wall", metapixels, radiometry, blurred(paint.astype(np.float32)))
    plain = Calibration(
        (projector,), np.zeros((rows, columns, 3), np.float32), np.ones((rows, columns), np.bool_), np.eye(3)
    )
    errors = []
    for calibration in (plain, dataclasses.replace(plain, camera_blur_px=BLUR_PX)):
        predicted = build_transport(calibration).forward([frame.astype(np.float32)])
        inner = (slice(8, 68), slice(8, 88))
        errors.append(float(np.sqrt(np.mean((predicted[inner] - photograph[inner]) ** 2)) / photograph[inner].mean()))
    assert errors[1] < 0.4 * errors[0]
    assert errors[1] < 0.02
