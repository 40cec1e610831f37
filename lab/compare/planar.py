"""Several projectors on a plane as one of a higher resolution."""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np

from controller.core.arrays import ByteImage, Float64, FloatImage, Mask
from controller.core.errors import WorkError
from controller.optics.calibrate.values import Geometry, Metapixels, Pinhole
from controller.optics.solve.reach.feasibility import direct_part
from controller.optics.transport import LightTransport, build_transport
from controller.stage.steps.appearance.solving import device_frames
from lab.compare.api import ComparisonTarget, MakeFrames
from lab.compare.metered_stage import MeteredStage
from lab.study.experiments.ablation import paper_model, with_metapixels

OFF_PX: Final = 0.5
"""A projector pixel belongs to the plane if the homography misses its place by no more, in camera pixels."""
LEAST_SHARE: Final = 0.4
"""Of the projector's pixels that the plane must hold."""
STEPS: Final = 150
POWERS: Final = 12
FIRST: Final = 0.5
OFF_PLANE_M: Final = 0.0015
TRIALS: Final = 300
EDGE_PX: Final = 7


def superresolution(stage: MeteredStage) -> MakeFrames:
    """Super-resolution on a plane (Damera-Venkata and Chang 2009, Majumder 2005): homographies, then descent."""
    known = stage.calibrated()
    plain = paper_model(known.calibration)
    found = [
        planar(part.metapixels, known.geometry.camera, lens)
        for part, lens in zip(plain.projectors, known.geometry.projectors, strict=True)
    ]
    model = with_metapixels(plain, found)
    transport = build_transport(model)

    def frames(target: ComparisonTarget) -> list[ByteImage]:
        wanted = direct_part(transport.reach(), target.radiance, plain.black, known.indirect)
        light = np.where(target.valid[..., None], np.maximum(wanted - plain.black, 0), 0).astype(np.float32)
        return list(device_frames(model, descended(transport, light, target.valid)).values())

    return frames


def planar(seen: Metapixels, camera: Pinhole, projector: Pinhole) -> Metapixels:
    """The pixels as one homography and one shape put them, where they lie on the plane.

    The homography is between both pictures without their lenses' distortion. The shape, a Gaussian in projector pixels,
    is the median over the plane. Raises WorkError("benchmark-no-plane").
    """
    usable = seen.valid & np.isfinite(seen.centre_px).all(axis=-1)
    rows, columns = np.nonzero(usable)
    here = np.stack([columns, rows], axis=-1).astype(np.float64)
    there = seen.centre_px[usable].astype(np.float64)
    limit = OFF_PX / float(camera.matrix[0, 0])
    matrix, inside = (
        cv2.findHomography(_straight(projector, here), _straight(camera, there), cv2.RANSAC, limit, maxIters=5000)
        if len(here) >= 4
        else (None, np.zeros(0, np.uint8))
    )
    on_plane = np.asarray(inside, bool).ravel()
    if matrix is None or on_plane.mean() < LEAST_SHARE:
        raise WorkError(
            "benchmark-no-plane",
            what="The object has no flat part that most pixels of a projector light.",
            remedy="Use this method on the scene flat.",
        )
    plane = np.asarray(matrix, np.float64)
    back = np.linalg.inv(_slopes(projector, plane, camera, here[on_plane]))
    measured = _matrices(seen.covariance_px2[rows[on_plane], columns[on_plane]])
    own = np.median(back @ measured @ back.transpose(0, 2, 1), axis=0)

    found = np.zeros(usable.shape, np.uint8)
    found[rows[on_plane], columns[on_plane]] = 1
    # The homography knows better than the measurement of one pixel: those between pixels of the plane lie on it, too.
    valid = np.asarray(cv2.morphologyEx(found, cv2.MORPH_CLOSE, np.ones((EDGE_PX, EDGE_PX), np.uint8)), bool)
    rows, columns = np.nonzero(valid)
    here = np.stack([columns, rows], axis=-1).astype(np.float64)
    centre = np.full(seen.centre_px.shape, np.nan, np.float32)
    shape = np.full(seen.covariance_px2.shape, np.nan, np.float32)
    centre[valid] = _through(projector, plane, camera, here)
    slope = _slopes(projector, plane, camera, here)
    spread = slope @ own @ slope.transpose(0, 2, 1)
    shape[valid] = np.stack([spread[:, 0, 0], spread[:, 0, 1], spread[:, 1, 1]], axis=-1)
    return Metapixels(centre, shape, valid)


def descended(transport: LightTransport, light: FloatImage, where: Mask, *, steps: int = STEPS) -> list[FloatImage]:
    """Frames in [0, 1] whose light is nearest to ``light`` (camera rows, columns, 3) ``where`` it counts.

    Steepest descent, clipped after each step, as the paper's: its limit is the best of all frames that can be shown.
    Pixels that light nothing of ``where`` stay black.
    """
    counts = where[..., None].astype(np.float32)

    def back(image: FloatImage) -> list[FloatImage]:
        return list(transport.adjoint(np.ascontiguousarray(image * counts)))

    first = [np.where(one > 0, np.float32(FIRST), np.float32(0)) for one in back(np.ones_like(light))]
    frames = first
    length = 1.0
    for _ in range(POWERS):
        ahead = back(transport.forward(frames))
        length = float(np.sqrt(sum(float(np.sum(np.square(one, dtype=np.float64))) for one in ahead)))
        frames = [np.asarray(one / np.float32(max(length, 1e-30)), np.float32) for one in ahead]
    # A little less than the largest step that surely descends: the power method ends just below the true length.
    step = np.float32(0.95 / max(length, 1e-30))
    frames = first
    for _ in range(steps):
        missing = back(light - transport.forward(frames))
        frames = [np.clip(one + step * more, 0, 1) for one, more in zip(frames, missing, strict=True)]
    return frames


def flat_part(geometry: Geometry, mask: Mask) -> Mask:
    """Where most of the object's points lie in one plane, without the edge of that part; (camera rows, columns)."""
    known = mask & np.isfinite(geometry.points_m).all(axis=-1)
    points = geometry.points_m[known].astype(np.float64)
    if len(points) < 3:
        return known
    rng = np.random.default_rng(0)
    best = np.zeros(len(points), bool)
    for _ in range(TRIALS):
        near = _near(points, points[rng.choice(len(points), 3, replace=False)])
        best = near if near.sum() > best.sum() else best
    best = _near(points, points[best])
    found = np.zeros(mask.shape, np.uint8)
    found[known] = best
    # single points that were measured badly are no holes of the plane
    closed = cv2.morphologyEx(found, cv2.MORPH_CLOSE, np.ones((EDGE_PX, EDGE_PX), np.uint8))
    return np.asarray(cv2.erode(closed, np.ones((EDGE_PX, EDGE_PX), np.uint8)), bool) & mask


def _near(points: Float64, of_plane: Float64) -> Mask:
    middle = of_plane.mean(axis=0)
    normal = np.linalg.svd(of_plane - middle, full_matrices=False)[2][2]
    return np.asarray(np.abs((points - middle) @ normal) < OFF_PLANE_M)


def _straight(lens: Pinhole, places_px: Float64) -> Float64:
    """(n, 2) places in a picture as slopes of rays, without the lens's distortion."""
    found = cv2.undistortPoints(places_px.reshape(-1, 1, 2), lens.matrix, lens.distortion)
    return np.asarray(found, np.float64).reshape(-1, 2)


def _through(projector: Pinhole, matrix: Float64, camera: Pinhole, places_px: Float64) -> Float64:
    """Where the camera sees (n, 2) places of the projector's picture by the homography."""
    slopes = cv2.perspectiveTransform(_straight(projector, places_px).reshape(-1, 1, 2), matrix).reshape(-1, 2)
    rays = np.concatenate([slopes, np.ones((len(slopes), 1))], axis=1)
    found, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), camera.matrix, camera.distortion)
    return np.asarray(found, np.float64).reshape(-1, 2)


def _slopes(projector: Pinhole, matrix: Float64, camera: Pinhole, places_px: Float64) -> Float64:
    """(n, 2, 2): how the camera's place moves with x and y of the projector's picture."""
    moves = [np.array(move) for move in ((0.5, 0.0), (0.0, 0.5))]
    return np.stack(
        [_through(projector, matrix, camera, places_px + move) - _through(projector, matrix, camera, places_px - move)
         for move in moves], axis=-1,
    )  # fmt: skip


def _matrices(covariance: FloatImage) -> Float64:
    xx, xy, yy = covariance.astype(np.float64).T
    return np.stack([np.stack([xx, xy], -1), np.stack([xy, yy], -1)], -2)
