"""The light transport against its definition, written out as a dense matrix."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numba
import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from controller.core.errors import UsageError
from controller.optics.calibrate.values import Calibration, Metapixels
from controller.optics.transport import build_transport
from tests.controller.optics.transport.conftest import products, random_frames

Stage = Callable[..., Calibration]
slow_start = settings(
    max_examples=12, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture], derandomize=True
)


def dense_shares(calibration: Calibration, n: int) -> npt.NDArray[np.float64]:
    """G_n as (camera pixels, projector pixels), from the formula alone."""
    metapixels = calibration.projectors[n].metapixels
    rows, columns = calibration.object_mask.shape
    y, x = np.mgrid[0:rows, 0:columns]
    shares = np.zeros((rows * columns, metapixels.valid.size))
    for v, index in enumerate(np.ndindex(metapixels.valid.shape)):
        (cx, cy), (xx, xy, yy) = metapixels.centre_px[index], metapixels.covariance_px2[index].astype(np.float64)
        determinant = xx * yy - xy * xy
        if not metapixels.valid[index] or determinant <= 0:
            continue
        dx, dy = x - np.float64(cx), y - np.float64(cy)
        squared = (yy * dx * dx - 2 * xy * dx * dy + xx * dy * dy) / determinant
        shares[:, v] = np.where(squared <= 9, np.exp(-0.5 * squared), 0).ravel()
    shares[~calibration.object_mask.ravel()] = 0
    total = shares.sum(1, keepdims=True)
    normalised: npt.NDArray[np.float64] = np.divide(shares, total, out=np.zeros_like(shares), where=total > 0)
    return normalised


def test_a_product_follows_the_definition_of_the_model(stage: Stage) -> None:
    calibration = stage(1)
    transport = build_transport(calibration)
    frames = random_frames(transport, 2)
    expected = np.zeros((*transport.camera_shape, 3))
    for n, (projector, frame) in enumerate(zip(calibration.projectors, frames, strict=True)):
        light = dense_shares(calibration, n) @ (frame.reshape(-1, 3) @ projector.radiometry.mixing.T)
        expected += projector.white * light.reshape(expected.shape)
    assert np.abs(transport.forward(frames) - expected).max() < 1e-3  # weights of 16 bits


@slow_start
@given(seed=st.integers(0, 2**31), sigma=st.floats(0.4, 8), masked=st.booleans())
def test_the_adjoint_is_the_transpose_for_any_geometry(stage: Stage, seed: int, sigma: float, masked: bool) -> None:
    transport = build_transport(stage(seed, largest_sigma=sigma, masked=masked))
    frames = random_frames(transport, seed)
    r = np.random.default_rng(seed + 1).random((*transport.camera_shape, 3), np.float32)
    forward, backward = products(transport, frames, r)
    assert forward == pytest.approx(backward, rel=2e-6)


@slow_start
@given(seed=st.integers(0, 2**31))
def test_a_projector_at_white_reproduces_its_white_image_where_lit(stage: Stage, seed: int) -> None:
    calibration = stage(seed)
    transport = build_transport(calibration)
    for n, projector in enumerate(calibration.projectors):
        light = transport.forward_part(n, np.ones((*transport.sizes[n], 3), np.float32))
        lit = transport.lit[n]
        np.testing.assert_allclose(light[lit], projector.white[lit], rtol=1e-5)
        assert not light[~lit].any()
        assert not lit[~calibration.object_mask].any()
    whole = sum(transport.forward_part(n, np.ones((*s, 3), np.float32)) for n, s in enumerate(transport.sizes))
    np.testing.assert_allclose(transport.reach(), whole, rtol=1e-5)


def test_many_projector_pixels_folded_onto_one_camera_pixel_share_its_light(stage: Stage) -> None:
    calibration = stage(3, masked=False)
    folded = calibration.projectors[0].metapixels
    centre = np.full_like(folded.centre_px, 20.0)
    covariance = np.full_like(folded.covariance_px2, 1.0) * np.array([1, 0, 1], np.float32)
    everywhere = Metapixels(centre, covariance, np.ones_like(folded.valid))
    projector = dataclasses.replace(calibration.projectors[0], metapixels=everywhere)
    transport = build_transport(dataclasses.replace(calibration, projectors=(projector,)))
    frame = random_frames(transport, 0)[0]
    mean = frame.reshape(-1, 3).mean(0) @ projector.radiometry.mixing.T
    light = transport.forward([frame])
    np.testing.assert_allclose(light[20, 20], projector.white[20, 20] * mean, rtol=1e-4)


def test_the_mean_over_a_metapixel_uses_its_normalised_gaussian(stage: Stage) -> None:
    calibration = stage(4, masked=False)
    transport = build_transport(calibration)
    image = np.random.default_rng(0).random((*transport.camera_shape, 3), np.float32)
    metapixels = calibration.projectors[0].metapixels
    means = transport.gaussian_mean(image, 0)
    y, x = np.mgrid[0 : transport.camera_shape[0], 0 : transport.camera_shape[1]]
    for index in [(3, 4), (5, 6), (8, 11)]:
        assert metapixels.valid[index]
        d = np.stack([x, y], -1) - metapixels.centre_px[index].astype(np.float64)
        xx, xy, yy = metapixels.covariance_px2[index].astype(np.float64)
        squared = np.einsum("...i,ij,...j", d, np.linalg.inv([[xx, xy], [xy, yy]]), d)
        weights = np.where((squared <= 9) & transport.lit[0], np.exp(-0.5 * squared), 0)
        expected = (weights[..., None] * image).sum((0, 1)) / max(weights.sum(), 1e-9)
        np.testing.assert_allclose(means[index], expected, atol=1e-4)


def test_products_are_the_same_to_the_bit_for_any_number_of_threads(stage: Stage) -> None:
    transport = build_transport(stage(5, camera=(150, 600), sizes=((60, 80), (50, 70))))
    frames = random_frames(transport, 5)
    r = np.random.default_rng(5).random((*transport.camera_shape, 3), np.float32)
    several = transport.forward(frames), transport.adjoint(r)
    threads = numba.get_num_threads()
    numba.set_num_threads(1)
    try:
        one = transport.forward(frames), transport.adjoint(r)
    finally:
        numba.set_num_threads(threads)
    np.testing.assert_array_equal(several[0], one[0])
    for a, b in zip(several[1], one[1], strict=True):
        np.testing.assert_array_equal(a, b)


def test_an_image_of_another_size_is_refused(stage: Stage) -> None:
    transport = build_transport(stage(8))
    with pytest.raises(UsageError) as refused:
        transport.adjoint(np.zeros((3, 3, 3), np.float32))
    assert refused.value.code == "image-wrong-size"


def test_a_white_image_that_is_not_finite_is_refused(stage: Stage) -> None:
    calibration = stage(9)
    calibration.projectors[0].white[2, 2] = np.nan
    with pytest.raises(UsageError) as refused:
        build_transport(calibration)
    assert refused.value.code == "calibration-inconsistent"


def test_one_camera_pixel_and_one_projector_pixel_are_a_stage(stage: Stage) -> None:
    calibration = stage(10, camera=(1, 1), sizes=((1, 1),), masked=False)
    metapixels = Metapixels(
        np.zeros((1, 1, 2), np.float32), np.array([[[1, 0, 1]]], np.float32), np.ones((1, 1), np.bool_)
    )
    white = np.full((1, 1, 3), 0.5, np.float32)
    projector = dataclasses.replace(calibration.projectors[0], metapixels=metapixels, white=white)
    transport = build_transport(dataclasses.replace(calibration, projectors=(projector,)))
    frame = np.full((1, 1, 3), 0.25, np.float32)
    np.testing.assert_allclose(transport.forward([frame]), 0.125, rtol=1e-5)


def test_a_projector_that_misses_the_object_lights_nothing(stage: Stage) -> None:
    calibration = stage(11)
    away = calibration.projectors[0].metapixels.centre_px + 10_000
    metapixels = dataclasses.replace(calibration.projectors[0].metapixels, centre_px=away)
    projectors = (dataclasses.replace(calibration.projectors[0], metapixels=metapixels), calibration.projectors[1])
    transport = build_transport(dataclasses.replace(calibration, projectors=projectors))
    assert not transport.lit[0].any()
    assert not transport.adjoint(np.ones((*transport.camera_shape, 3), np.float32))[0].any()
    assert transport.reach().any()
