"""A calibrated stage in arrays: a white shell before three projectors, and a camera that makes its photographs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from controller.core.arrays import FloatImage
from controller.optics.calibrate.values import (
    Calibration,
    Geometry,
    Metapixels,
    Pinhole,
    ProjectorCalibration,
    Radiometry,
)
from controller.optics.transport import LightTransport, build_transport
from lab.study.subject.subject import Dots, Subject
from tests.controller.optics.transport.sparse_shares import gaussian_weights, normalised

CAMERA = (96, 128)
PITCH_PX = 3.0
NOISE = 5e-4


@dataclass
class ArrayLight:
    """Photographs by the calibration's own transport, in device steps, with noise; ``names`` of what was taken."""

    calibration: Calibration
    transport: LightTransport
    rng: np.random.Generator
    names: list[str] = field(default_factory=list)

    def photograph(self, name: str, frames: Sequence[FloatImage], *, white: float) -> FloatImage:
        assert name not in self.names
        self.names.append(name)
        steps = [np.asarray(np.round(255 * frame) / 255, np.float32) for frame in frames]
        light = self.transport.forward(steps) + self.calibration.black
        noisy = light + self.rng.normal(0, NOISE, light.shape)
        return np.asarray(noisy, np.float32)

    def dots(self, n: int, *, plain: bool = False) -> Dots:
        metapixels = self.calibration.projectors[n].metapixels
        shares = normalised(gaussian_weights(metapixels, CAMERA))
        shares.data = np.clip(shares.data + self.rng.normal(0, 0.05 if plain else 0.01, shares.data.size), 0, 1)
        return Dots(shares, metapixels)


def array_subject(projectors: int = 3, seed: int = 0) -> Subject:
    """Projectors whose pixels are 3 camera pixels wide, shifted and turned against each other by parts of a pixel."""
    rng = np.random.default_rng(seed)
    rows, columns = round(CAMERA[0] / PITCH_PX), round(CAMERA[1] / PITCH_PX)
    row, column = np.mgrid[0:rows, 0:columns]
    parts = []
    for n in range(projectors):
        turn, shift = 0.04 * (n - 1), np.array([0.37, 0.61]) * PITCH_PX * n
        centre = np.stack([(column + 0.5) * PITCH_PX + turn * row, (row + 0.5) * PITCH_PX - turn * column], -1) - shift
        covariance = np.broadcast_to(np.array([1.2, 0.0, 1.2]) ** 2, (rows, columns, 3))
        valid = np.ones((rows, columns), np.bool_)
        metapixels = Metapixels(centre.astype(np.float32), covariance.astype(np.float32), valid)
        response = np.tile(np.linspace(0, 1, 256), (3, 1))
        white = np.full((*CAMERA, 3), 0.5 + 0.05 * n, np.float32)
        parts.append(ProjectorCalibration(f"p{n}", metapixels, Radiometry(response, np.eye(3)), white))
    black = np.full((*CAMERA, 3), 0.002, np.float32)
    mask = np.zeros(CAMERA, np.bool_)
    mask[8:-8, 8:-8] = True
    calibration = Calibration(tuple(parts), black, mask, np.eye(3))
    transport = build_transport(calibration)
    return Subject(calibration, shell(), transport, ArrayLight(calibration, transport, rng))


def shell() -> Geometry:
    """Part of an upright cylinder of 0.2 m radius before the camera."""
    y, x = np.mgrid[0 : CAMERA[0], 0 : CAMERA[1]].astype(np.float64)
    across = (x / (CAMERA[1] - 1) - 0.5) * 0.3
    height = (y / (CAMERA[0] - 1) - 0.5) * 0.25
    depth = 1.2 - np.sqrt(0.2**2 - across**2)
    points = np.stack([across, height, depth], -1)
    normals = np.stack([across / 0.2, np.zeros_like(across), (depth - 1.2) / 0.2], -1)
    pinhole = Pinhole(np.eye(3), np.zeros(2), np.eye(3), np.zeros(3), (CAMERA[1], CAMERA[0]))
    return Geometry(pinhole, (), points.astype(np.float32), normals.astype(np.float32), 0.1, True)
