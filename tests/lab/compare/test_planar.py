"""Super-resolution on a plane: the homography, the descent against SciPy's optimiser, the plane of a scene."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from scipy.optimize import minimize

from controller.core.arrays import Float64, FloatImage
from controller.core.errors import WorkError
from controller.optics.calibrate.values import Geometry, Metapixels, Pinhole
from controller.optics.transport import build_transport
from lab.compare.planar import descended, flat_part, planar
from tests.controller.optics.solve.conftest import plane_calibration

PROJECTOR, CAMERA = (80, 60), (240, 180)
NOISE_PX = 0.08


def lens(size: tuple[int, int], focal: float, distortion: tuple[float, float]) -> Pinhole:
    matrix = np.array([[focal, 0, size[0] / 2 + 3], [0, focal, size[1] / 2 - 2], [0, 0, 1.0]])
    return Pinhole(matrix, np.array(distortion), np.eye(3), np.zeros(3), size)


def seen_by(camera: Pinhole, points: Float64) -> Float64:
    px, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), camera.matrix, camera.distortion)
    return np.asarray(px, np.float64).reshape(-1, 2)


@pytest.fixture(scope="module")
def lenses() -> tuple[Pinhole, Pinhole]:
    return lens(CAMERA, 300.0, (-0.08, 0.02)), lens(PROJECTOR, 130.0, (0.05, 0.0))


def measured(lenses: tuple[Pinhole, Pinhole], bend: float) -> tuple[Metapixels, Float64]:
    """A projector's pixels on a tilted plane whose left part is bent back, with noise, and where they truly are."""
    camera, projector = lenses
    turn = cv2.Rodrigues(np.array([0.05, -0.3, 0.02]))[0]
    x, y = np.meshgrid(np.arange(PROJECTOR[0]), np.arange(PROJECTOR[1]))
    px = np.stack([x, y], -1).reshape(-1, 1, 2).astype(np.float64)
    slope = cv2.undistortPoints(px, projector.matrix, projector.distortion).reshape(-1, 2)
    rays = np.concatenate([slope, np.ones((len(slope), 1))], 1) @ turn.T
    centre = np.array([0.3, 0.02, 0.1])
    normal, at = np.array([0.1, -0.05, 1.0]), np.array([0.0, 0.0, 1.0])
    far = ((at - centre) @ normal / (rays @ normal))[:, None]
    far = far + bend * np.maximum(0.35 - x.ravel()[:, None] / PROJECTOR[0], 0)
    place = seen_by(camera, centre + rays * far).reshape(PROJECTOR[1], PROJECTOR[0], 2)
    rng = np.random.default_rng(2)
    noisy = (place + rng.normal(0, NOISE_PX, place.shape)).astype(np.float32)
    valid = rng.random(place.shape[:2]) > 0.02
    noisy[~valid] = np.nan
    shape = np.broadcast_to(np.array([1.4, 0.1, 1.2], np.float32), (*valid.shape, 3)).copy()
    return Metapixels(noisy, shape, valid), place


def test_the_homography_evens_the_noise_out_and_leaves_out_what_is_off_the_plane(
    lenses: tuple[Pinhole, Pinhole],
) -> None:
    metapixels, truth = measured(lenses, bend=0.6)
    found = planar(metapixels, *lenses)
    on = np.arange(PROJECTOR[0]) > 0.4 * PROJECTOR[0]
    off = np.arange(PROJECTOR[0]) < 0.25 * PROJECTOR[0]
    assert found.valid[:, on].mean() > 0.99, "a pixel that was not measured lies on the plane, too"
    assert found.valid[:, off].mean() < 0.02
    error = np.linalg.norm(found.centre_px - truth, axis=-1)[found.valid & on]
    assert np.percentile(error, 95) < 0.5 * NOISE_PX
    np.testing.assert_allclose(np.median(found.covariance_px2[found.valid], axis=0), [1.4, 0.1, 1.2], atol=0.15)
    assert np.isnan(found.centre_px[~found.valid]).all()


def test_a_surface_without_a_plane_is_refused(lenses: tuple[Pinhole, Pinhole]) -> None:
    metapixels, _ = measured(lenses, bend=0.0)
    x = np.arange(PROJECTOR[0]) / PROJECTOR[0] * 6
    waves = 8 * np.sin(x)[None, :, None] * np.sin(np.arange(PROJECTOR[1]) / 6)[:, None, None]
    with pytest.raises(WorkError) as refused:
        planar(
            Metapixels((metapixels.centre_px + waves).astype(np.float32), metapixels.covariance_px2, metapixels.valid),
            *lenses,
        )
    assert refused.value.code == "benchmark-no-plane"


def test_the_descent_ends_where_scipys_optimiser_ends() -> None:
    transport = build_transport(plane_calibration(projector=(5, 6), camera=(15, 20)))
    rng = np.random.default_rng(5)
    light = (rng.random((15, 20, 3)) * transport.reach().mean()).astype(np.float32)
    where = np.ones((15, 20), np.bool_)
    where[:, :10] = False
    frames = descended(transport, light, where, steps=500)
    shapes = [one.shape for one in frames]
    sizes = np.cumsum([0, *(int(np.prod(shape)) for shape in shapes)])

    def missed(values: list[FloatImage]) -> FloatImage:
        return np.asarray((transport.forward(values) - light) * where[..., None], np.float32)

    def objective(x: Float64) -> tuple[float, Float64]:
        values = [
            np.ascontiguousarray(x[a:b].reshape(shape), np.float32)
            for a, b, shape in zip(sizes[:-1], sizes[1:], shapes, strict=True)
        ]
        error = missed(values)
        back = np.concatenate([one.ravel() for one in transport.adjoint(error)])
        return 0.5 * float(np.sum(np.square(error, dtype=np.float64))), back.astype(np.float64)

    best = minimize(objective, np.full(sizes[-1], 0.5), jac=True, method="L-BFGS-B", bounds=[(0, 1)] * int(sizes[-1]),
                    options={"maxiter": 500, "ftol": 1e-12})  # fmt: skip
    ours = 0.5 * float(np.sum(np.square(missed(frames), dtype=np.float64)))
    assert all(((one >= 0) & (one <= 1)).all() for one in frames)
    assert ours <= 1.01 * best.fun
    beside = [np.asarray(one == 0) for one in transport.adjoint(np.where(where[..., None], np.ones_like(light), 0))]
    assert any(one.any() for one in beside)
    for frame, unseen in zip(frames, beside, strict=True):
        assert not frame[unseen].any(), "what lights nothing that counts stays black"


def test_the_flat_part_is_the_plate_without_its_rim(lenses: tuple[Pinhole, Pinhole]) -> None:
    y, x = np.mgrid[0:180, 0:240]
    u, v = (x - 120) / 110, (y - 90) / 80
    beyond = np.maximum(np.maximum(abs(u), abs(v)) - 0.75, 0)
    points = np.stack([0.18 * u, 0.15 * v, 1.0 + 0.1 * u + 0.24 * beyond], -1)
    points += np.random.default_rng(1).normal(0, 3e-4, points.shape)
    points[80:82, 100:102] = np.nan
    mask = (abs(u) < 1) & (abs(v) < 1)
    camera, projector = lenses
    empty = np.zeros(points.shape, np.float32)
    geometry = Geometry(camera, (projector,), points.astype(np.float32), empty, 0.0, scale_known=True)
    found = flat_part(geometry, mask)
    inner = np.maximum(abs(u), abs(v)) < 0.70
    outer = np.maximum(abs(u), abs(v)) > 0.78
    assert found[inner].mean() > 0.99
    assert not found[outer].any()
