"""A projector, a surface and a camera made of nothing but resampling: the oracle for ``calibrate``.

The projector's picture is enlarged with square pixels, blurred, looked up through a known smooth warp at 4x4 points
of each camera pixel, blurred by the camera and averaged. No Gaussians per pixel, no shares, no transport matrix.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

import cv2
import numpy as np

from controller.core.arrays import ByteImage, Float64, FloatImage
from controller.optics.capture.pattern_frames import device_frame
from controller.optics.capture.patterns import PatternPlan, plan_patterns

ENLARGED = 10
SUPERSAMPLED = 4


@dataclass(frozen=True)
class Scene:
    """Everything about the simulated stage; the defaults are in focus with noise."""

    camera_px: tuple[int, int] = (208, 160)
    projector_px: tuple[int, int] = (88, 68)
    scale: float = 2.4
    bend: float = 3.0
    step_px: float = 0.0
    """Projector px by which the right 40 % of the camera's image look farther right: a depth edge."""
    bars_px: int = 0
    """With bars, it is every other strip of so many camera px instead: a fence before a wall."""
    projector_blur_px: float = 0.3
    camera_blur_px: float = 0.6
    lit_share_of_pixel: int = 8
    """of 10, a side; even, so that the pixel stays in the middle"""
    exposure: float = 0.7
    white_segment: float = 0.0
    """Share of white that is not the sum of the three colours."""
    electrons: float = 30000.0
    read_electrons: float = 6.0
    gamma: float = 2.2
    seed: int = 1
    noisy: bool = True
    flicker: float = 0.0
    """Standard deviation of the lamp's strength from one photograph to the next."""
    indirect: float = 0.0
    """Share of white that comes by way of other surfaces: of the mean of the whole picture."""
    no_blue: float = 0.0
    """Share of the camera's width, from the left, where the paint throws back hardly any blue."""
    mixing: tuple[tuple[float, float, float], ...] = ((0.88, 0.10, 0.02), (0.08, 0.85, 0.07), (0.01, 0.12, 0.87))
    spectra: tuple[tuple[tuple[float, ...], ...], ...] = ()
    """Light in a camera channel, by albedo and projector channel: ``mixing`` then depends on the paint, and this holds
    instead of it."""
    apart_px: tuple[tuple[float, float], ...] = ((0.0, 0.0), (0.0, 0.0), (0.0, 0.0))
    """How far red, green and blue of the projector lie to the right and down, projector px."""

    def projector_of(self, camera: Float64) -> Float64:
        """(..., 2) camera px -> (..., 2) projector px: perspective, rotation and a gentle bulge."""
        centre = (np.array(self.camera_px) - 1) / 2
        d = (camera - centre) / self.scale
        angle = 0.12
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        q = d @ turn.T
        r2 = np.sum((q / 60) ** 2, axis=-1, keepdims=True)
        w = 1 + 0.002 * q[..., :1]
        bulge = self.bend * np.stack([np.sin(q[..., 1] / 25), np.cos(q[..., 0] / 30)], axis=-1)
        x = camera[..., :1]
        nearer = (x // self.bars_px) % 2 == 1 if self.bars_px else x > 0.6 * self.camera_px[0]
        step = np.where(nearer, self.step_px, 0.0) * np.array([1.0, 0.0])
        return np.asarray(q * (1 + 0.05 * r2) / w + bulge + step + (np.array(self.projector_px) - 1) / 2)

    def jacobian(self, camera: Float64) -> Float64:
        """(..., 2, 2) d projector / d camera."""
        step = 1e-3
        columns = []
        for axis in range(2):
            d = np.zeros(2)
            d[axis] = step
            columns.append((self.projector_of(camera + d) - self.projector_of(camera - d)) / (2 * step))
        return np.stack(columns, axis=-1)

    def camera_of(self, projector: Float64) -> Float64:
        """Inverse of ``projector_of`` by Newton's method."""
        camera = np.broadcast_to((np.array(self.camera_px) - 1) / 2, projector.shape).copy()
        for _ in range(30):
            error = self.projector_of(camera) - projector
            camera = camera - np.linalg.solve(self.jacobian(camera), error[..., None])[..., 0]
        return camera

    def true_centres(self) -> Float64:
        width, height = self.projector_px
        x, y = np.meshgrid(np.arange(width, dtype=float), np.arange(height, dtype=float))
        return self.camera_of(np.stack([x, y], axis=-1))

    def true_covariance(self) -> Float64:
        """(rows, columns, 2, 2) second moments of a projector pixel's light in the camera image."""
        inverse = np.linalg.inv(self.jacobian(self.true_centres()))
        box = (self.lit_share_of_pixel / ENLARGED) ** 2 / 12
        projector = (box + self.projector_blur_px**2) * np.eye(2)
        camera = (self.camera_blur_px**2 + 1 / 12) * np.eye(2)
        return np.asarray(inverse @ projector @ np.swapaxes(inverse, -1, -2) + camera)

    def response(self) -> Float64:
        """(3, 256): an S-shaped curve on a gamma, as video projectors have."""
        x = np.arange(256) / 255
        curves = [
            x ** (self.gamma + d) * (1 - s) + s * (3 * x**2 - 2 * x**3) for d, s in ((0, 0.2), (0.1, 0.3), (-0.1, 0.1))
        ]
        return np.stack([curve / curve[-1] for curve in curves])


@functools.lru_cache(maxsize=8)
def _lookup(
    camera_px: tuple[int, int], projector_px: tuple[int, int], scale: float, bend: float, step_px: float, bars_px: int
) -> FloatImage:
    """Where each subsample of the camera looks in the enlarged picture, by the geometry of a scene."""
    scene, s = Scene(camera_px, projector_px, scale, bend, step_px, bars_px), SUPERSAMPLED
    y, x = np.mgrid[0 : camera_px[1] * s, 0 : camera_px[0] * s]
    sub = np.stack([(x + 0.5) / s - 0.5, (y + 0.5) / s - 0.5], axis=-1)
    found: FloatImage = ((scene.projector_of(sub) + 0.5) * ENLARGED - 0.5).astype(np.float32)
    found.setflags(write=False)
    return found


@functools.cache
def _enlarged(pixels: int, lit: int, blur_px: float) -> FloatImage:
    """(enlarged, pixels): a row of ``pixels`` with square pixels, ``lit`` parts of each lit, blurred."""
    low = (ENLARGED - lit) // 2
    each = np.zeros((pixels, ENLARGED, pixels), np.float32)
    each[range(pixels), low : low + lit, range(pixels)] = 1
    large = each.reshape(pixels * ENLARGED, pixels)
    if blur_px > 0:
        sigma = blur_px * ENLARGED
        large = np.asarray(cv2.GaussianBlur(large, (1, round(8 * sigma + 1) | 1), 0, sigmaY=sigma), np.float32)
    large.setflags(write=False)
    return large


class Stage:
    """Takes photographs of device frames; values in full scale, clipped at 1."""

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        self.random = np.random.default_rng(scene.seed)
        columns, rows = scene.camera_px
        s = SUPERSAMPLED
        self._lookup = _lookup(
            scene.camera_px, scene.projector_px, scene.scale, scene.bend, scene.step_px, scene.bars_px
        )
        smooth = cv2.resize(self.random.uniform(0.4, 1.0, (rows // 16, columns // 16, 3)), (columns * s, rows * s))
        patches = (
            self.random.uniform(0.5, 1.0, (rows // 10 + 1, columns // 10 + 1, 3)).repeat(10 * s, 0).repeat(10 * s, 1)
        )
        self._albedo = (smooth * patches[: rows * s, : columns * s]).astype(np.float32)
        self._albedo[:, : round(scene.no_blue * columns * s), 2] *= np.float32(0.004)

    def light(self, linear: FloatImage) -> FloatImage:
        """Noiseless camera image of a linear frame (rows, columns, 3), without the black level."""
        scene = self.scene
        mixing = np.array(scene.mixing, np.float32)
        if scene.spectra:
            of_paint = np.array(scene.spectra, np.float32).swapaxes(0, 1)
            parts = [self._seen(linear @ of_paint[j].T, (0.0, 0.0)) * self._albedo[..., j : j + 1] for j in range(3)]
            return self._in_camera(np.asarray(sum(parts), np.float32))
        if any(any(shift) for shift in scene.apart_px):
            parts = [self._seen(linear[..., d : d + 1] * mixing[:, d], scene.apart_px[d]) for d in range(3)]
            seen = np.asarray(sum(parts), np.float32)
        else:
            seen = self._seen(linear @ mixing.T, (0.0, 0.0))
        return self._in_camera(seen * self._albedo)

    def _in_camera(self, light: FloatImage) -> FloatImage:
        scene = self.scene
        blurred = cv2.GaussianBlur(light, (0, 0), scene.camera_blur_px * SUPERSAMPLED)
        small = cv2.resize(blurred, scene.camera_px, interpolation=cv2.INTER_AREA)
        return np.asarray(scene.exposure * small, np.float32)

    def _seen(self, light: FloatImage, apart_px: tuple[float, float]) -> FloatImage:
        """What falls where the camera's points look, of pixels of light that lie so far to the right and down."""
        scene, (rows, columns) = self.scene, light.shape[:2]
        of_rows, of_columns = (_enlarged(n, scene.lit_share_of_pixel, scene.projector_blur_px) for n in (rows, columns))
        # Both keep rows and columns apart, so they are two products, whatever the blur: first the one with less to do.
        wide = (of_columns @ light).reshape(rows, -1)
        large: cv2.typing.MatLike = (of_rows @ wide).reshape(len(of_rows), len(of_columns), 3)
        u = ENLARGED
        at = self._lookup - np.float32(u) * np.array(apart_px, np.float32) if any(apart_px) else self._lookup
        seen = cv2.remap(large, at, np.empty(0), cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
        return np.asarray(seen, np.float32)

    def photograph(self, device: ByteImage) -> FloatImage:
        scene = self.scene
        linear = np.stack([scene.response()[c][device[:, :, c]] for c in range(3)], axis=-1).astype(np.float32)
        # a white segment of the colour wheel shows what the three colours have in common once more
        linear += np.float32(scene.white_segment) * (linear.min(axis=-1, keepdims=True) - linear)
        shown = 0.002 + 0.998 * linear
        if scene.indirect:
            around = np.broadcast_to(shown.mean(axis=(0, 1)), shown.shape).astype(np.float32)
            shown += np.float32(scene.indirect) * (around - shown)
        image = self.light(shown)
        if scene.flicker:
            image *= np.float32(1 + scene.flicker * self.random.standard_normal())
        image = image + 0.003
        if scene.noisy:
            electrons = np.maximum(image, 0) * scene.electrons
            noise = np.sqrt(electrons + scene.read_electrons**2) * self.random.standard_normal(image.shape)
            image = ((electrons + noise) / scene.electrons).astype(np.float32)
        return np.asarray(np.minimum(image, 1.0), np.float32)

    def plan(self) -> PatternPlan:
        return plan_patterns(self.scene.projector_px)

    def captures(self, plan: PatternPlan | None = None) -> dict[str, FloatImage]:
        """A photograph of every pattern of the plan, encoded with the true response."""
        plan = plan or self.plan()
        response = self.scene.response()
        return {p.name: self.photograph(device_frame(p, plan.size_px, response)) for p in plan}


@functools.cache
def photographed(scene: Scene) -> Mapping[str, FloatImage]:
    """``Stage(scene).captures()``, made once for all tests; do not write into it."""
    captures = Stage(scene).captures()
    for image in captures.values():
        image.setflags(write=False)
    return MappingProxyType(captures)


def positions(scene: Scene) -> Float64:
    """(rows, columns, 2): the projector position each camera pixel truly looks at."""
    x, y = np.meshgrid(np.arange(scene.camera_px[0], dtype=float), np.arange(scene.camera_px[1], dtype=float))
    return scene.projector_of(np.stack([x, y], axis=-1))
