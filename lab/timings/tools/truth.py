"""What the emulated stage really is. For lab.timings alone, after the work that they judge has ended."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
from embreex import rtcore_scene
from embreex.mesh_construction import TriangleMesh

from controller.core.arrays import ByteImage, Float64, FloatImage, Mask
from controller.optics.capture.raw import develop
from lab.emulated.bumps import bumped, read_bumps
from plugins.emulated.core.truth import BUMPS_FILE as BUMPS
from plugins.emulated.core.truth import FOLDER, BenchTruth, CameraTruth, read_truth
from plugins.emulated.optics.indirect.transfers import IndirectTransfers
from plugins.emulated.optics.light_cache import light_folder
from plugins.emulated.optics.objects import StageObject
from plugins.emulated.optics.rays import SIGMA_STEP_PX, Samples, directions, samples_of
from plugins.emulated.optics.render import Renderer, response
from plugins.emulated.optics.world import object_of

RGGB = np.array([[0, 1], [1, 2]])
REACH_SIGMAS = 4.5
STEEPEST = 3.0
"""Times the typical slope between adjacent camera pixels; more is another surface."""


class Truth:
    """The truth of a stage folder, and pictures of it without noise.

    ``bumps``: with what was done to it after it was set up. Only bumps that leave all rays where they are will do.
    """

    def __init__(self, stage: Path, *, bumps: bool = False) -> None:
        set_up = read_truth(stage)
        self.bench: BenchTruth = bumped(set_up, read_bumps(stage / BUMPS, set_up)) if bumps else set_up
        self.stage_object: StageObject = object_of(stage, self.bench.object)
        kept = light_folder(stage / FOLDER)
        self.samples = samples_of(set_up, self.stage_object, kept, lambda share: None)
        indirect = IndirectTransfers(self.stage_object, kept)
        transfer = indirect.transfer(set_up, self.samples.pixels, lambda share: None, keep=True)
        self._renderer = Renderer(self.bench, self.samples, transfer)
        self._direct = Renderer(*_direct_alone(self.bench, self.samples))
        width, height = self.bench.camera.lens.size_px
        self.shape = (height, width)

    def picture(self, frames: Sequence[ByteImage], *, direct: bool = False) -> FloatImage:
        """Linear light (rows, columns, 3) before the sensor of a frame for each projector, all of them lit.

        ``direct``: without light from other surfaces and stray light of lenses.
        """
        renderer = self._direct if direct else self._renderer
        return np.asarray(renderer.light(frames, [1.0] * len(frames)), np.float32)

    def light(self, n: int, frame: ByteImage, *, direct: bool = False) -> FloatImage:
        """As ``picture``, of projector ``n`` alone less that of its black."""
        renderer = self._direct if direct else self._renderer
        levels = [float(index == n) for index in range(len(self.bench.projectors))]
        black = [np.zeros((p.lens.size_px[1], p.lens.size_px[0], 3), np.uint8) for p in self.bench.projectors]
        shown = [frame if index == n else dark for index, dark in enumerate(black)]
        lit = renderer.light(shown, levels)
        return np.asarray(lit - renderer.light(black, levels), np.float32)

    def white(self, n: int, *, direct: bool = False) -> FloatImage:
        """``light`` of full white."""
        width, height = self.bench.projectors[n].lens.size_px
        return self.light(n, np.full((height, width, 3), 255, np.uint8), direct=direct)

    def response(self, n: int) -> Float64:
        """(3, 256): 0 at black, 1 at white."""
        return np.ascontiguousarray(response(self.bench.projectors[n].light).T)

    def mixing(self, n: int) -> Float64:
        """(3, 3), rows summing to 1, as ``Radiometry.mixing``."""
        mixing = np.asarray(self.bench.projectors[n].light.mixing, np.float64)
        return np.asarray(mixing / mixing.sum(axis=1, keepdims=True))

    def projector_px(self, n: int) -> Float64:
        """(rows, columns, 2): mean of where a camera pixel's lit rays meet the projector's image; NaN if none is."""
        return self._mean_of_lit(n, self.samples.at_px[n].astype(np.float64))

    def blur_px(self, n: int) -> Float64:
        """(rows, columns): defocus in projector px, standard deviation; NaN where unlit."""
        sigma = self.samples.blur[n].astype(np.float64)[:, None] * SIGMA_STEP_PX
        return np.asarray(self._mean_of_lit(n, sigma)[..., 0])

    def wholly_lit(self, n: int) -> Mask:
        """(rows, columns): every ray of the pixel meets the object where the projector lights it."""
        lit = np.add.reduceat((self.samples.gain[n] > 0).astype(np.int64), self.samples.starts[:-1])
        whole = np.zeros(self.shape[0] * self.shape[1], np.bool_)
        whole[self.samples.pixels] = lit == self.bench.subsamples**2
        return whole.reshape(self.shape)

    def one_surface(self, n: int, radius_px: int) -> Mask:
        """(rows, columns): no edge of the lit surface or of its image, and no fold, within ``radius_px``."""
        at = self.projector_px(n)
        steps = [np.hypot(*np.moveaxis(np.diff(at, axis=axis), 2, 0)) for axis in (0, 1)]
        typical = float(np.nanmedian(np.concatenate([step.ravel() for step in steps])))
        broken = ~self.wholly_lit(n)
        broken[1:] |= ~(steps[0] < STEEPEST * typical)
        broken[:, 1:] |= ~(steps[1] < STEEPEST * typical)
        side = 2 * radius_px + 1
        return np.asarray(cv2.dilate(broken.astype(np.uint8), np.ones((side, side), np.uint8)) == 0)

    def points_m(self) -> Float64:
        """(rows, columns, 3): where the middle of each camera pixel sees the object, in the camera's frame; or NaN."""
        return points_from(self.bench.camera, self.stage_object)

    def _mean_of_lit(self, n: int, values: Float64) -> Float64:
        lit = (self.samples.gain[n] > 0).astype(np.float64)[:, None]
        starts = self.samples.starts[:-1]
        count = np.add.reduceat(lit, starts)
        total = np.add.reduceat(np.where(lit > 0, values, 0.0), starts)
        mean = np.full((self.shape[0] * self.shape[1], values.shape[1]), np.nan)
        mean[self.samples.pixels] = np.divide(total, count, out=np.full_like(total, np.nan), where=count > 0)
        return mean.reshape(*self.shape, -1)


def points_from(camera: CameraTruth, stage_object: StageObject) -> Float64:
    """(rows, columns, 3): as ``surface_points``, in the camera's own frame."""
    return np.asarray((surface_points(stage_object, camera) - camera.pose.position_m) @ camera.pose.rotation.T)


def surface_points(stage_object: StageObject, camera: CameraTruth) -> Float64:
    """(rows, columns, 3): where the middle of each pixel of a camera sees the object, world metres; NaN elsewhere."""
    return seen_values(stage_object, camera, stage_object.vertices[stage_object.faces])


def seen_values(stage_object: StageObject, camera: CameraTruth, corners: npt.NDArray[np.float32]) -> Float64:
    """(rows, columns, K): what the middle of each pixel sees of values at the faces' corners (F, 3, K); NaN beside."""
    columns, rows = camera.lens.size_px
    y, x = np.mgrid[0:rows, 0:columns].astype(np.float64)
    ray = directions(camera.pose, camera.lens, x.ravel(), y.ravel())
    scene = rtcore_scene.EmbreeScene(robust=True)
    mesh = TriangleMesh(scene, stage_object.vertices, stage_object.faces)
    origin = np.broadcast_to(np.asarray(camera.pose.position_m, np.float32), ray.shape).copy()
    found = scene.run(origin, ray.astype(np.float32), output=1)
    del mesh
    hit = found["primID"] >= 0
    u, v = found["u"][hit].astype(np.float64), found["v"][hit].astype(np.float64)
    values = np.full((rows * columns, corners.shape[2]), np.nan)
    of_face = corners[found["primID"][hit]].astype(np.float64)
    values[hit] = np.einsum("nk,nkc->nc", np.stack((1 - u - v, u, v), -1), of_face)
    return values.reshape(rows, columns, -1)


def _direct_alone(truth: BenchTruth, samples: Samples) -> tuple[BenchTruth, Samples]:
    """Without stray light of lenses, which the light that goes straight then lacks."""
    clear = 1 - truth.camera.glare
    straight = np.array([clear * (1 - one.light.glare) for one in truth.projectors], np.float32)
    projectors = tuple(
        dataclasses.replace(one, light=dataclasses.replace(one.light, glare=0.0)) for one in truth.projectors
    )
    red, green, blue = (clear * value for value in truth.ambient)
    camera = dataclasses.replace(truth.camera, glare=0.0)
    alone = dataclasses.replace(truth, indirect=0.0, ambient=(red, green, blue), camera=camera, projectors=projectors)
    # the samples hold the projectors' brightness already
    return alone, dataclasses.replace(samples, gain=samples.gain * straight[:, None])


@dataclass(frozen=True, slots=True)
class Window:
    """Rows and columns around a footprint, and (rows, columns) which of these pixels belong to its ellipse."""

    rows: slice
    columns: slice
    inside: Mask


def window_around(centre: Float64, covariance: Float64, shape: tuple[int, int]) -> Window | None:
    """All of a footprint, and little else: an ellipse of 4.5 standard deviations and a pixel more.

    ``centre`` (2,) x, y; ``covariance`` (3,) xx, xy, yy; None where it leaves the picture of ``shape``.
    """
    x_px, y_px = (REACH_SIGMAS * float(np.sqrt(v)) + 1 for v in (covariance[0], covariance[2]))
    left, right = int(np.floor(centre[0] - x_px)), int(np.ceil(centre[0] + x_px))
    top, bottom = int(np.floor(centre[1] - y_px)), int(np.ceil(centre[1] + y_px))
    if left < 0 or top < 0 or right >= shape[1] or bottom >= shape[0]:
        return None
    matrix = np.array([[covariance[0], covariance[1]], [covariance[1], covariance[2]]])
    narrow = float(np.sqrt(max(np.linalg.eigvalsh(matrix)[0], 1e-6)))
    inverse = np.linalg.inv(matrix + 1e-9 * np.eye(2)) / (1 + 1 / (REACH_SIGMAS * narrow)) ** 2
    rows, columns = slice(top, bottom + 1), slice(left, right + 1)
    y, x = np.mgrid[rows, columns]
    d = np.stack([x - centre[0], y - centre[1]], axis=-1)
    return Window(rows, columns, np.einsum("ijk,kl,ijl->ij", d, inverse, d) <= REACH_SIGMAS**2)


def developed(light: FloatImage, full: float) -> FloatImage:
    """What the controller's development makes of noise-free ``light``, in the same unit; ``full`` is full scale."""
    mosaic = np.empty(light.shape[:2], np.uint16)
    for row in range(2):
        for column in range(2):
            site = light[row::2, column::2, RGGB[row, column]]
            mosaic[row::2, column::2] = np.rint(np.clip(site / full, 0, 1) * 65535)
    scale = np.full((2, 2), 65535.0)
    image = develop(mosaic, RGGB.astype(np.int64), np.zeros((2, 2)), scale).image
    return np.asarray(image * np.float32(full), np.float32)


def footprints(
    truth: Truth, n: int, spacing_px: int, offsets: Sequence[tuple[int, int]]
) -> list[tuple[tuple[int, int], FloatImage]]:
    """Shares of single projector pixels at camera pixels, without noise: grids of lit pixels over white, both direct.

    Returns for each offset (row, column) of the grid the image (rows, columns), grey, as developed.
    """
    width, height = truth.bench.projectors[n].lens.size_px
    white = truth.white(n, direct=True)
    full = 1.02 * float(white.max())
    grey = developed(white, full).sum(axis=2)
    lit = grey > 0.01 * grey.max()
    found = []
    for row, column in offsets:
        frame = np.zeros((height, width, 3), np.uint8)
        frame[row::spacing_px, column::spacing_px] = 255
        dots = developed(truth.light(n, frame, direct=True), full).sum(axis=2)
        share = np.divide(dots, grey, out=np.zeros_like(dots), where=lit)
        found.append(((row, column), np.asarray(share, np.float32)))
    return found


def moments(share: FloatImage, window: Window) -> Float64 | None:
    """(5,) x, y, xx, xy, yy of a footprint within a window; None where there is no light."""
    weight = np.where(window.inside, share[window.rows, window.columns], 0).astype(np.float64)
    total = weight.sum()
    if not total > 0:
        return None
    y, x = np.mgrid[window.rows, window.columns]
    at_x, at_y = float((weight * x).sum() / total), float((weight * y).sum() / total)
    dx, dy = x - at_x, y - at_y
    xx, xy, yy = (float((weight * product).sum() / total) for product in (dx * dx, dx * dy, dy * dy))
    return np.array([at_x, at_y, xx, xy, yy])
