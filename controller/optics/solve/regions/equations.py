"""The equations of one region of the camera image, cut out of the whole solve (paper 3.2, eq. 7).

The same T, camera blur and colour mixing included, and the same smoothness as in ``bounded``; what the pixels that are
held fixed contribute stands on the right-hand side.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from controller.core.arrays import Float64, FloatImage
from controller.optics.solve.bounded.problem import Problem
from controller.optics.solve.regions.box_solvers import BoxProblem
from controller.optics.transport import LightTransport
from controller.optics.transport.camera_box import CameraBox
from controller.optics.transport.planes import planes_above

Pixels = npt.NDArray[np.int64]


def channel_groups(transport: LightTransport) -> list[tuple[int, ...]]:
    """Channels that have to be solved together: all three, or each alone where no projector mixes colours."""
    apart = all(np.count_nonzero(mixing - np.diag(np.diag(mixing))) == 0 for mixing in transport.mixing)
    return [(0,), (1,), (2,)] if apart else [(0, 1, 2)]


def box_problem(
    problem: Problem, box: CameraBox, unknown: Pixels, channels: tuple[int, ...], x: FloatImage, light: FloatImage
) -> BoxProblem:
    """The equations at the camera pixels of ``box`` for some projector pixels.

    Parameters
    ----------
    unknown : (n,) rising indices of pixels of all projectors
    channels : to be solved together; unknowns stand in the order (channel, pixel)
    x, light : (3, pixels) current values, and (3, rows, columns) T x
    """
    weights = np.sqrt(problem.weights[box.window].astype(np.float64)).ravel()
    start = x[list(channels)][:, unknown].astype(np.float64).ravel()
    A = problem.transport.submatrix(box, unknown, channels)
    window = (list(channels), *box.window)
    wanted = planes_above(problem.picture[box.window], problem.black[box.window])[list(channels)]
    missing = (wanted - light[window]).astype(np.float64).ravel()
    data_side = missing + A @ start
    scale = np.tile(weights, len(channels))
    rows = np.flatnonzero(scale)
    scale = scale[rows]
    data = sp.diags_array(scale) @ A[rows]
    S, smooth_side = _smoothness(problem, unknown, channels, x)
    matrix = sp.csr_matrix(sp.vstack([data, S]))
    return BoxProblem(matrix, np.concatenate([scale * data_side[rows], smooth_side]), start)


def _smoothness(
    problem: Problem, unknown: Pixels, channels: tuple[int, ...], x: FloatImage
) -> tuple[sp.csr_matrix[np.float64], Float64]:
    """One row alpha (p_i - p_j) for each pair of which at least one pixel is unknown (paper 2.4, eq. 3)."""
    sizes = problem.transport.sizes
    start = np.cumsum([0, *(rows * columns for rows, columns in sizes)])
    owner = np.searchsorted(start, unknown, side="right") - 1
    width = np.array([size[1] for size in problem.transport.sizes], np.int64)[owner]
    rows, columns, values, right_hand_side, count = [], [], [], [], 0
    for edges, step in ((problem.across, np.ones_like(width)), (problem.down, width)):
        before = unknown - step >= start[owner]
        pairs = np.concatenate([np.stack([unknown, unknown + step]), np.stack([unknown - step, unknown])[:, before]], 1)
        pairs = np.unique(pairs, axis=1)
        for index, c in enumerate(channels):
            here = pairs[:, edges[c, pairs[0]] > 0]
            alpha = np.sqrt(problem.strength_per_step * edges[c, here[0]].astype(np.float64))
            known = np.zeros(alpha.size)
            for pixel, sign in ((here[0], 1.0), (here[1], -1.0)):
                at = np.minimum(np.searchsorted(unknown, pixel), unknown.size - 1)
                found = unknown[at] == pixel
                rows.append(count + np.flatnonzero(found))
                columns.append(index * unknown.size + at[found])
                values.append(sign * alpha[found])
                known[~found] -= sign * alpha[~found] * x[c, pixel[~found]]
            right_hand_side.append(known)
            count += alpha.size
    entries = (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns)))
    return sp.csr_matrix(entries, shape=(count, unknown.size * len(channels))), np.concatenate(right_hand_side)
