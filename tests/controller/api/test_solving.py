"""The solver through the API, against SciPy's; comparison against scikit-image's and OpenCV's colours; files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import scipy.sparse as sp
import trimesh
from scipy.optimize import lsq_linear
from skimage import color

from controller import api
from controller.core.arrays import Float64
from lab.timings.tools.synthetic import write_synthetic_run
from tests.controller.optics.solve.conftest import plane_calibration
from tests.lab.study.array_stage import shell

CAMERA, PROJECTOR = (32, 24), (8, 6)


def spots(seed: int, shift_px: float = 0.0) -> sp.csr_array[np.float64]:
    """Overlapping round spots on an uneven surface, (camera pixels, projector pixels)."""
    y, x = np.mgrid[0 : CAMERA[1], 0 : CAMERA[0]]
    v, u = np.mgrid[0 : PROJECTOR[1], 0 : PROJECTOR[0]]
    across = x.ravel()[:, None] - (4 * u.ravel() + 1.5 + shift_px)
    down = y.ravel()[:, None] - (4 * v.ravel() + 1.5)
    light = np.exp(-(across**2 + down**2) / (2 * 2.2**2))
    light[light < 0.01] = 0
    return sp.csr_array(light * np.random.default_rng(seed).uniform(0.2, 1, (light.shape[0], 1)))


def frames(seed: int, count: int) -> list[np.ndarray[tuple[int, ...], np.dtype[np.float32]]]:
    random = np.random.default_rng(seed)
    return [random.random((PROJECTOR[1], PROJECTOR[0], 3), np.float32) for _ in range(count)]


def test_a_transport_of_matrices_is_their_product() -> None:
    matrices = [spots(1), spots(2, 2.0)]
    transport = api.transport_from_matrices(matrices, CAMERA, [PROJECTOR, PROJECTOR])
    p = frames(3, 2)
    wanted = sum(A @ one.reshape(-1, 3) for A, one in zip(matrices, p, strict=True))
    assert isinstance(wanted, np.ndarray)
    np.testing.assert_allclose(transport.forward(p).reshape(-1, 3), wanted, rtol=1e-4, atol=1e-4)
    r = np.random.default_rng(4).random((CAMERA[1], CAMERA[0], 3), np.float32)
    for A, back in zip(matrices, transport.adjoint(r), strict=True):
        np.testing.assert_allclose(back.reshape(-1, 3), A.T @ r.reshape(-1, 3), rtol=1e-4, atol=1e-4)


def test_whites_and_mixing_give_the_light_and_its_colour() -> None:
    A = spots(1).toarray()
    white = np.random.default_rng(5).uniform(0.1, 1, (CAMERA[1], CAMERA[0], 3)).astype(np.float32)
    white[A.sum(axis=1).reshape(white.shape[:2]) == 0] = 0
    mixing = np.array([[0.9, 0.1, 0.0], [0.05, 0.9, 0.05], [0.0, 0.2, 0.8]])
    transport = api.transport_from_matrices([A], CAMERA, [PROJECTOR], whites=[white], mixing=mixing[None])
    (p,) = frames(6, 1)
    shares = A / np.maximum(A.sum(axis=1, keepdims=True), 1e-12)
    wanted = white * (shares @ (p.reshape(-1, 3) @ mixing.T)).reshape(white.shape)
    np.testing.assert_allclose(transport.forward([p]), wanted, rtol=1e-4, atol=1e-4)


def test_without_smoothness_the_solve_is_bounded_least_squares() -> None:
    A = spots(1)
    transport = api.transport_from_matrices([A], CAMERA, [PROJECTOR])
    target = 0.8 * np.random.default_rng(7).random((CAMERA[1], CAMERA[0], 3))
    solution = api.solve(transport, target, smoothness=0, tolerance=1e-6, most_iterations=5000)
    wanted = np.stack([lsq_linear(A.toarray(), target[..., c].ravel(), (0, 1), tol=1e-12).x for c in range(3)], axis=-1)
    assert solution.converged
    assert np.mean((wanted < 1e-6) | (wanted > 1 - 1e-6)) > 0.01  # some pixels are at a bound
    # T is in single precision and its entries have 16 bits
    np.testing.assert_allclose(solution.frames[0].reshape(-1, 3), wanted, atol=5e-4)


def test_the_objective_is_the_squared_error_of_the_camera_pixels_that_have_light() -> None:
    A = spots(1).toarray()
    lit = np.arange(A.shape[0]) % CAMERA[0] >= 10
    A[~lit] = 0
    transport = api.transport_from_matrices([A], CAMERA, [PROJECTOR])
    target = np.random.default_rng(7).random((CAMERA[1], CAMERA[0], 3))
    solution = api.solve(transport, target, smoothness=0)
    error = (A @ solution.frames[0].reshape(-1, 3) - target.reshape(-1, 3)) ** 2
    assert solution.objective == pytest.approx(float(error[lit].sum()), rel=1e-3)
    np.testing.assert_array_equal(transport.object_mask.ravel(), lit)


def test_weights_and_black_are_those_of_the_least_squares() -> None:
    A, random = spots(1), np.random.default_rng(8)
    transport = api.transport_from_matrices([A], CAMERA, [PROJECTOR])
    black = np.full((CAMERA[1], CAMERA[0], 3), 0.05)
    target, weights = 0.1 + 0.7 * random.random(black.shape), random.uniform(0.1, 1, black.shape[:2])
    solution = api.solve(transport, target, black, smoothness=0, weights=weights, tolerance=1e-6, most_iterations=5000)
    root = np.sqrt(weights).ravel()
    right = root[:, None] * (target - black).reshape(-1, 3)
    wanted = [lsq_linear(root[:, None] * A.toarray(), right[:, c], (0, 1), tol=1e-12).x for c in range(3)]
    np.testing.assert_allclose(solution.frames[0].reshape(-1, 3), np.stack(wanted, axis=-1), atol=5e-4)


@pytest.mark.parametrize(
    "matrix",
    [np.ones((5, 48)), np.full((768, 48), -0.1), np.full((768, 48), np.nan), np.ones((768, 47))],
    ids=["rows", "negative", "not a number", "columns"],
)
def test_a_wrong_matrix_is_refused(matrix: Float64) -> None:
    with pytest.raises(api.VelaturaError) as error:
        api.transport_from_matrices([matrix], CAMERA, [PROJECTOR])
    assert error.value.code == "weights-wrong"


def test_a_reachable_target_is_reached_by_a_solve_and_by_the_scale_of_a_base() -> None:
    calibration = plane_calibration(albedo_from=0.6)
    transport = api.build_transport(calibration)
    y, x = np.mgrid[0:60, 0:80]
    picture = np.stack([0.6 + 0.2 * np.sin(x / 15), 0.6 + 0.2 * np.cos(y / 12), np.full(x.shape, 0.5)], axis=-1)
    target = api.reachable_target(transport, picture, calibration.black, share=0.9)
    assert target.share >= 0.9
    np.testing.assert_allclose(target.radiance, np.maximum(target.exposure * picture, calibration.black), rtol=1e-5)
    base = api.solve_base(transport, api.base_image(calibration), calibration.black)
    solved = api.solve(transport, target.radiance, calibration.black).frames
    scaled = api.scale(transport, base, target.radiance, calibration.black)
    for made, worst in ((solved, 3.0), (scaled, 4.0)):
        seen = transport.forward(made) + calibration.black
        found = api.compare(
            seen, target.radiance, target.reachable, white=target.exposure, camera_to_xyz=calibration.camera_to_xyz
        )
        assert found.delta_e00_median < worst
        assert 0 <= min(one.min() for one in made) <= max(one.max() for one in made) <= 1


CIEDE2000: Any = color.deltaE_ciede2000  # its functions carry no types


def test_differences_of_colour_are_those_of_other_libraries() -> None:
    random = np.random.default_rng(9)
    target = random.uniform(0.05, 0.9, (40, 30, 3)).astype(np.float32)
    achieved = np.clip(target * random.uniform(0.8, 1.2, target.shape), 0, 1).astype(np.float32)
    found = api.compare(achieved, target)

    def encoded(light: np.ndarray[tuple[int, ...], np.dtype[np.float32]]) -> Float64:
        return np.where(light <= 0.0031308, 12.92 * light, 1.055 * np.maximum(light, 1e-9) ** (1 / 2.4) - 0.055)

    by_scikit = CIEDE2000(color.rgb2lab(encoded(target)), color.rgb2lab(encoded(achieved)))
    np.testing.assert_allclose(found.error_map, by_scikit, atol=0.02)
    by_opencv = CIEDE2000(*(cv2.cvtColor(image, cv2.COLOR_LRGB2Lab) for image in (target, achieved)))
    # OpenCV's conversion reads its cube root from a table
    np.testing.assert_allclose(found.error_map, by_opencv, atol=0.05)
    assert found.delta_e00_median == pytest.approx(np.median(by_scikit), abs=0.01)
    assert found.rmse == pytest.approx(np.sqrt(np.mean((achieved - target) ** 2)), rel=1e-5)


def test_encoded_frames_have_the_light_that_was_wanted() -> None:
    radiometry = plane_calibration().projectors[0].radiometry
    frame = np.broadcast_to(np.array([0.1, 0.4, 0.8]), (64, 64, 3))
    device = api.encode(frame, radiometry)
    light = np.stack([radiometry.response[c][device[..., c]] for c in range(3)], axis=-1)
    np.testing.assert_allclose(light.mean(axis=(0, 1)), [0.1, 0.4, 0.8], atol=1e-3)


def test_arrays_pictures_and_meshes_open_in_other_libraries(tmp_path: Path) -> None:
    image = np.random.default_rng(1).random((5, 6, 3), np.float32)
    with np.load(api.export(tmp_path / "deeper" / "a.npz", {"image": image})) as arrays:
        np.testing.assert_array_equal(arrays["image"], image)
    device = np.rint(255 * image).astype(np.uint8)
    for content, wanted in ((device, device), (np.full((2, 3, 3), 0.5), np.full((2, 3, 3), 188, np.uint8))):
        read = cv2.imread(str(api.export(tmp_path / "a.png", content)), cv2.IMREAD_UNCHANGED)
        assert read is not None
        np.testing.assert_array_equal(read[..., ::-1], wanted)
    surface = shell()
    meshes: list[Any] = [
        trimesh.load(api.export(tmp_path / name, surface), force="mesh") for name in ("a.ply", "a.glb")
    ]
    assert {len(mesh.vertices) for mesh in meshes} == {np.isfinite(surface.points_m[..., 2]).sum()}
    assert meshes[0].area == pytest.approx(meshes[1].area, rel=1e-4)


@pytest.mark.parametrize(
    ("name", "content", "code"),
    [
        ("a.txt", {}, "export-kind-unknown"),
        ("a.npz", np.zeros((2, 2, 3)), "export-content-wrong"),
        ("a.png", {}, "export-content-wrong"),
        ("a.exr", np.zeros(3), "export-content-wrong"),
        ("a.ply", {}, "export-content-wrong"),
    ],
)
def test_a_file_that_cannot_hold_the_content_is_refused(tmp_path: Path, name: str, content: Any, code: str) -> None:
    with pytest.raises(api.VelaturaError) as error:
        api.export(tmp_path / name, content)
    assert error.value.code == code
    assert list(tmp_path.iterdir()) == []


def test_a_run_predicts_frames_and_reads_its_appearances(tmp_path: Path) -> None:
    names = write_synthetic_run(tmp_path, projector=(14, 18), camera=(36, 50))
    run = api.CalibratedRun(tmp_path, names)
    frames = [np.full((14, 18, 3), 0.1 * (n + 1), np.float32) for n in range(len(names))]
    light = run.predicted(frames)
    np.testing.assert_allclose(light, run.calibration.black + run.transport.forward(frames), rtol=1e-5)
    with pytest.raises(api.VelaturaError) as missing:
        run.appearance("gold")
    assert missing.value.code == "appearance-not-solved"
    device = dict(zip(names, (np.zeros((14, 18, 3), np.uint8) for _ in names), strict=True))
    everywhere = np.ones((36, 50), np.bool_)
    solved = api.Solved(device, dict(zip(names, frames, strict=True)), light, everywhere, {"exposure": 2.0})
    solved.write(tmp_path, "gold")
    found = run.appearance("gold")
    np.testing.assert_array_equal(found.linear[names[1]], frames[1])
    np.testing.assert_array_equal(found.target, light)
    assert found.exposure == 2.0
