# %% Another norm in the solve: iteratively reweighted least squares, by ``weights`` and ``start``
import itertools

import numpy as np
import scipy.sparse as sp

from controller import api

CAMERA, PROJECTOR = (64, 48), (20, 15)  # (width, height)
DELTA = 0.02  # Huber's norm: a square up to here, a straight line beyond
ROUNDS, SWEEPS = 8, 40

y, x = np.mgrid[0 : CAMERA[1], 0 : CAMERA[0]]
v, u = np.mgrid[0 : PROJECTOR[1], 0 : PROJECTOR[0]]
across, down = x.ravel()[:, None] - (3.2 * u.ravel() + 1.1), y.ravel()[:, None] - (3.2 * v.ravel() + 1.1)
light = np.exp(-(across**2 + down**2) / (2 * 1.6**2))
transport = api.transport_from_matrices([sp.csr_array(np.where(light > 0.01, light, 0))], CAMERA, [PROJECTOR])

# %% A target with specks that no projector pixel can make: squares let them pull at their neighbours
reach = transport.reach()
target = 0.5 * reach
target[np.random.default_rng(1).random(target.shape[:2]) < 0.02] *= 1.9


def missed(frames: list[np.ndarray]) -> np.ndarray:
    """(rows, columns): how far each camera pixel is from its target."""
    return np.linalg.norm(transport.forward(frames) - target, axis=2)


def huber(r: np.ndarray) -> float:
    return float(np.where(r < DELTA, r**2 / 2, DELTA * (r - DELTA / 2)).sum())


# %% Each round minimises sum w |r|^2, which touches the norm at the present frames and lies above it elsewhere:
# so the norm falls. For another one, w = norm'(r) / r; for the sum of |r|, 1 / max(r, a little).
solution = api.solve(transport, target, smoothness=0.0)
norms = [huber(missed(solution.frames))]
for _ in range(ROUNDS):
    weights = np.minimum(1, DELTA / np.maximum(missed(solution.frames), 1e-12))
    solution = api.solve(
        transport, target, smoothness=0.0, weights=weights, start=solution.frames, most_iterations=SWEEPS
    )
    norms.append(huber(missed(solution.frames)))
print("Huber's norm, round by round:", " ".join(f"{norm:.4f}" for norm in norms))
assert all(after <= before * (1 + 1e-4) for before, after in itertools.pairwise(norms))
assert norms[-1] < 0.98 * norms[0]

# %% What becomes of the pixels beside the specks
clean = (target <= 0.5 * reach).all(axis=2)
plain = api.solve(transport, target, smoothness=0.0)
print(f"Median error beside the specks: squares {np.median(missed(plain.frames)[clean]):.4f}, "
      f"Huber {np.median(missed(solution.frames)[clean]):.4f}")  # fmt: skip
