"""The light transport as SciPy's solvers take it."""

from __future__ import annotations

import pickle
from collections.abc import Callable

import numpy as np
import pytest
from scipy.optimize import lsq_linear
from scipy.sparse.linalg import LinearOperator, lsqr

from controller.core.arrays import FloatImage
from controller.optics.calibrate.values import Calibration
from controller.optics.transport import LightTransport, build_transport
from controller.optics.transport.planes import CameraBox, frame_planes, image_planes
from tests.controller.optics.transport.conftest import random_frames
from tests.controller.optics.transport.windows.test_transport import mapped

Stage = Callable[..., Calibration]


@pytest.fixture(params=["patches", "windows"])
def transport(stage: Stage, request: pytest.FixtureRequest) -> LightTransport:
    calibration = stage(3, camera=(20, 30), sizes=((5, 6), (3, 4)))
    return build_transport(mapped(calibration, 3, ordered=True) if request.param == "windows" else calibration)


def dense(transport: LightTransport) -> FloatImage:
    """T written out; channels, then pixels."""
    rows, columns = transport.camera_shape
    everything = np.arange(transport.pixels)
    matrix = transport.submatrix(CameraBox(0, 0, rows, columns), everything, (0, 1, 2))
    return np.asarray(matrix.toarray(), np.float32)


def test_it_is_the_matrix_that_its_rows_say(transport: LightTransport) -> None:
    matrix, random = dense(transport), np.random.default_rng(1)
    x, y = random.random(transport.shape[1]), random.random(transport.shape[0])
    assert isinstance(transport, LinearOperator)
    assert transport.shape == matrix.shape
    assert transport.dtype == np.float32
    np.testing.assert_allclose(transport @ x, matrix @ x, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(transport.H @ y, matrix.T @ y, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(transport.rmatvec(y), matrix.T @ y, rtol=1e-4, atol=1e-5)
    several = random.random((transport.shape[1], 3))
    np.testing.assert_allclose(transport @ several, matrix @ several, rtol=1e-4, atol=1e-5)


def test_its_vectors_are_the_planes_of_its_pictures(transport: LightTransport) -> None:
    frames = random_frames(transport, 2)
    light = transport.forward(frames)
    np.testing.assert_array_equal(transport @ frame_planes(frames).ravel(), image_planes(light).ravel())
    back = frame_planes(transport.adjoint(light))
    np.testing.assert_array_equal(transport.rmatvec(image_planes(light).ravel()), back.ravel())


def test_its_parts_are_its_columns_of_one_projector(transport: LightTransport) -> None:
    frames = random_frames(transport, 4)
    r = np.random.default_rng(4).random((*transport.camera_shape, 3), np.float32)
    total = np.zeros(transport.shape[0])
    for n, frame in enumerate(frames):
        part, x = transport.part(n), frame_planes([frame]).ravel()
        total += part @ x
        np.testing.assert_array_equal(part @ x, image_planes(transport.forward_part(n, frame)).ravel())
        back = transport.adjoint(r)[n]
        np.testing.assert_array_equal(part.rmatvec(image_planes(r).ravel()), frame_planes([back]).ravel())
    np.testing.assert_allclose(transport @ frame_planes(frames).ravel(), total, rtol=1e-5, atol=1e-6)


def test_solvers_take_it_as_it_is(transport: LightTransport) -> None:
    x = np.random.default_rng(5).uniform(0.2, 0.8, transport.shape[1])
    b = np.asarray(transport @ x, np.float64)
    free = lsqr(transport, b, atol=1e-6, btol=1e-6, iter_lim=400)[0]
    assert np.linalg.norm(transport @ free - b) < 1e-3 * np.linalg.norm(b)
    bounded = lsq_linear(transport, b, (0, 1), lsmr_tol="auto", max_iter=40).x
    assert 0 <= bounded.min() <= bounded.max() <= 1
    assert np.linalg.norm(transport @ bounded - b) < 1e-2 * np.linalg.norm(b)


def test_it_goes_to_another_process_and_back(transport: LightTransport) -> None:
    again: LightTransport = pickle.loads(pickle.dumps(transport))
    frames = random_frames(transport, 6)
    assert again.shape == transport.shape
    np.testing.assert_array_equal(again.forward(frames), transport.forward(frames))


def test_a_sensor_buffer_is_light_as_the_camera_samples_it(transport: LightTransport) -> None:
    """D' w (D s - c), by buffers, is T_n' w (T p - c), by pictures."""
    random = np.random.default_rng(7)
    p = frame_planes(random_frames(transport, 7))
    weights = random.random(transport.camera_shape, np.float32)
    wanted = random.random((3, *transport.camera_shape), np.float32)
    buffer = transport.sensor_buffer()
    assert buffer.ndim == 1
    for n in range(len(transport.sizes)):
        transport.accumulate_forward(n, p, buffer)
    residual, gradient = np.empty_like(buffer), np.zeros_like(p)
    transport.normal_residual(buffer, weights, transport.right_hand_side(wanted.copy(), weights), residual)
    for n in range(len(transport.sizes)):
        transport.adjoint_of_buffer(n, residual, gradient)
    expected = transport.adjoint_planes(weights * (transport.forward_planes(p) - wanted))
    np.testing.assert_allclose(gradient, expected, rtol=1e-3, atol=1e-4)
