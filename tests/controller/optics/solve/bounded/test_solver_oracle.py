"""The bounded solver by camera samples against Clarabel: a crop, folds, occlusions, a projector that misses."""

from __future__ import annotations

import dataclasses

import clarabel
import numpy as np
import pytest
import scipy.sparse as sp

from controller.config.defaults import SMOOTHNESS
from controller.core.arrays import Float64, FloatImage
from controller.optics.calibrate.values import Calibration, PhaseMap
from controller.optics.solve.bounded.equations import Problem, SolveSettings, build_problem
from controller.optics.solve.bounded.solver import solve_bounded
from controller.optics.transport import LightTransport, build_transport
from controller.optics.transport.planes import CameraBox
from lab.timings.tools.synthetic import crop_calibration, synthetic_calibration


def equations(problem: Problem) -> tuple[sp.csr_matrix[np.float64], Float64]:
    """All rows of the problem, square roots of the weights included, and their right side."""
    transport = problem.transport
    everything = np.arange(transport.pixels)
    root = np.sqrt(np.tile(problem.weights.ravel(), 3).astype(np.float64))
    data = sp.diags(root) @ transport.submatrix(CameraBox(0, 0, *transport.camera_shape), everything, (0, 1, 2))
    rows = [data]
    for n, (height, width) in enumerate(transport.sizes):
        span = transport.span(n)
        index = np.arange(height * width).reshape(height, width) + span.start
        for edge_weights, a, b in (
            (problem.across, index[:, :-1], index[:, 1:]),
            (problem.down, index[:-1], index[1:]),
        ):
            for c in range(3):
                weight = np.sqrt(problem.strength_per_step * edge_weights[c, a.ravel()].astype(np.float64))
                k = np.arange(a.size)
                shape = (a.size, 3 * transport.pixels)
                offset = c * transport.pixels
                one = sp.csr_matrix((weight, (k, a.ravel() + offset)), shape=shape)
                rows.append(one - sp.csr_matrix((weight, (k, b.ravel() + offset)), shape=shape))
    matrix = sp.csr_matrix(sp.vstack(rows))
    right = np.zeros(matrix.shape[0])
    right[: root.size] = root * problem.target().ravel()
    return matrix, right


def exact(problem: Problem) -> float:
    """The least objective, by an interior-point method."""
    matrix, right = equations(problem)
    used = np.flatnonzero(np.diff(matrix.tocsc().indptr) > 0)
    matrix = matrix[:, used]
    count = matrix.shape[1]
    quadratic = sp.triu(2 * matrix.T @ matrix).tocsc()
    constraints = sp.vstack([sp.identity(count), -sp.identity(count)]).tocsc()
    bounds = np.r_[np.ones(count), np.zeros(count)]
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    cones = [clarabel.NonnegativeConeT(2 * count)]
    solver = clarabel.DefaultSolver(quadratic, -2 * matrix.T @ right, constraints, bounds, cones, settings)
    x = np.clip(np.array(solver.solve().x), 0, 1)
    return float(((matrix @ x - right) ** 2).sum())


def bent(calibration: Calibration, how: str) -> Calibration:
    first, *others = calibration.projectors
    assert first.phase_map is not None
    place = first.phase_map.projector_px.copy()
    half = place.shape[1] // 2
    if how == "fold":
        place[:, half:] = place[:, :half][:, ::-1]
    elif how == "occlusion":
        place[:, half:, 0] -= 4
    elif how == "misses":
        place[:] = np.nan
    folded = dataclasses.replace(first, phase_map=PhaseMap(place, first.phase_map.spread_px2))
    return dataclasses.replace(calibration, projectors=(folded, *others))


def unreachable_in_parts(transport: LightTransport, black: FloatImage) -> FloatImage:
    y, x = np.mgrid[0 : transport.camera_shape[0], 0 : transport.camera_shape[1]]
    part = 0.1 + 1.1 * ((x // 5 + y // 7) % 2) * np.sin(0.2 * x) ** 2
    return np.asarray(black + transport.reach() * part[..., None], np.float32)


@pytest.mark.parametrize("how", ["fold", "occlusion", "misses"])
def test_the_objective_is_the_least_for_any_geometry(how: str) -> None:
    calibration = bent(synthetic_calibration(projector=(14, 18), camera=(36, 50)), how)
    check(calibration)


def test_the_objective_is_the_least_on_a_crop_of_64_by_64_camera_pixels() -> None:
    check(crop_calibration(synthetic_calibration(projector=(52, 70), camera=(260, 388)), 96, 130, 64))


def check(calibration: Calibration) -> None:
    transport = build_transport(calibration)
    target = unreachable_in_parts(transport, calibration.black)
    best = exact(build_problem(transport, target, calibration.black, SMOOTHNESS, None))
    found = solve_bounded(transport, target, calibration.black, SolveSettings(tolerance=1e-6, most_iterations=4000))
    assert found.objective == pytest.approx(best, rel=1e-4)
