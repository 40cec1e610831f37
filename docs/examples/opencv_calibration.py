# %% A camera and a projector that OpenCV calibrated (cv2.stereoCalibrate), and the surface as the camera sees it
import cv2
import numpy as np
import scipy.sparse as sp

from controller import api

CAMERA, PROJECTOR = (96, 72), (64, 48)  # (width, height)
camera_matrix = np.array([[110.0, 0, 47.5], [0, 110.0, 35.5], [0, 0, 1]])
projector_matrix = np.array([[85.0, 0, 31.5], [0, 85.0, 23.5], [0, 0, 1]])
projector_distortion = np.array([-0.05, 0.01, 0.0, 0.0])  # k1, k2, p1, p2
rotation, translation_m = cv2.Rodrigues(np.array([0.0, 0.15, 0.0]))[0], np.array([-0.15, 0.0, 0.02])

# From your scanner or from COLMAP: the point that each camera pixel sees, (rows, columns, 3), metres, camera frame.
x, y = np.meshgrid(np.arange(CAMERA[0]), np.arange(CAMERA[1]))
depth_m = 1.0 + 0.05 * np.cos(x / 20) * np.cos(y / 15)
points_m = np.stack([(x - 47.5) / 110 * depth_m, (y - 35.5) / 110 * depth_m, depth_m], axis=-1)

# %% Where each point lies in the projector's picture, as four bilinear shares: one row of the matrix
at, _ = cv2.projectPoints(points_m.reshape(-1, 1, 3), rotation, translation_m, projector_matrix, projector_distortion)
u, v = at.reshape(-1, 2).T
left, top = np.floor(u).astype(int), np.floor(v).astype(int)
inside = (left >= 0) & (left + 1 < PROJECTOR[0]) & (top >= 0) & (top + 1 < PROJECTOR[1])
rows, columns, shares = [], [], []
for right in (0, 1):
    for below in (0, 1):
        share = np.abs(1 - right - (u - left)) * np.abs(1 - below - (v - top))
        rows.append(np.flatnonzero(inside))
        columns.append(((top + below) * PROJECTOR[0] + left + right)[inside])
        shares.append(share[inside])
size = (CAMERA[0] * CAMERA[1], PROJECTOR[0] * PROJECTOR[1])
matrix = sp.csr_array((np.concatenate(shares), (np.concatenate(rows), np.concatenate(columns))), shape=size)

# %% A photograph of the object, lit by this projector at white, less one with all projectors at black: linear light
white = np.where(inside.reshape(points_m.shape[:2])[..., None], 0.8 - 0.3 * ((x // 12 + y // 12) % 2)[..., None], 0)
white = np.repeat(white, 3, axis=2)
transport = api.transport_from_matrices([matrix], CAMERA, [PROJECTOR], whites=[white])

# %% Cancel the object's own pattern: even light
target = api.reachable_target(transport, np.ones((CAMERA[1], CAMERA[0], 3)), share=0.98)
solution = api.solve(transport, target.radiance)
seen = transport.forward(solution.frames)[target.reachable]
print(
    f"white varies by {white[target.reachable].std() / white[target.reachable].mean():.1%}, "
    f"the result by {seen.std() / seen.mean():.1%}"
)
api.export("projector.png", solution.frames[0])
