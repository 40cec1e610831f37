# %% Two projectors as sparse matrices: each projector pixel lights a round spot of the camera picture
import numpy as np
import scipy.sparse as sp

from controller import api

CAMERA, PROJECTOR = (64, 48), (20, 15)  # (width, height)


def spots(shift_px: float) -> sp.csr_array:
    y, x = np.mgrid[0 : CAMERA[1], 0 : CAMERA[0]]
    v, u = np.mgrid[0 : PROJECTOR[1], 0 : PROJECTOR[0]]
    across = x.ravel()[:, None] - (3.2 * u.ravel() + 1.1 + shift_px)
    down = y.ravel()[:, None] - (3.2 * v.ravel() + 1.1 + shift_px)
    light = np.exp(-(across**2 + down**2) / (2 * 1.6**2))
    return sp.csr_array(np.where(light > 0.01, light, 0))  # rows: camera pixels, columns: projector pixels


transport = api.transport_from_matrices([spots(0.0), spots(1.5)], CAMERA, [PROJECTOR, PROJECTOR])

# %% A target as bright as the projectors can show it, and the compensation images for it
y, x = np.mgrid[0 : CAMERA[1], 0 : CAMERA[0]]
squares = (x // 16 + y // 16) % 2
picture = np.stack([0.3 + 0.5 * squares, 0.6 - 0.2 * squares, 0.4 + 0.2 * np.sin(x / 9)], axis=-1)
target = api.reachable_target(transport, picture)
solution = api.solve(transport, target.radiance)
print(f"{solution.iterations} iterations, converged: {solution.converged}, {target.share:.0%} reachable")

# %% How near the result is: T p, compared with the target
result = api.compare(transport.forward(solution.frames), target.radiance, target.reachable, white=target.exposure)
print(f"CIEDE2000 {result.delta_e00_median:.2f}, RMSE {100 * result.rmse:.2f} %, lambda {result.sharpness_lambda:.2f}")

# %% Another target of the same base, without a solve
base = api.solve_base(transport, 0.4 * transport.reach())
other = api.reachable_target(transport, np.roll(picture, 20, axis=1))
frames = api.scale(transport, base, other.radiance)
api.export("frames.npz", {"left": frames[0], "right": frames[1]})
api.export("left.png", solution.frames[0])
