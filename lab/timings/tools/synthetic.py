"""A calibration made from formulas, at any size: a curved, coloured object under rotated, foreshortened projectors.

``python -m lab.timings.tools.synthetic FOLDER SIZE`` writes it as a run does, one projector at a time, and prints the
names.
"""

from __future__ import annotations

import dataclasses
import sys
from pathlib import Path
from typing import Final

import numpy as np

from controller.core.arrays import FloatImage, Mask
from controller.optics.calibrate.values import Calibration, Metapixels, PhaseMap, ProjectorCalibration, Radiometry
from controller.optics.transport.indirect.indirect_light import IndirectLight
from controller.optics.transport.indirect.stripes import blocks_of
from controller.stage.artefacts.projectors import Light, Pixels

PROJECTOR: Final = {
    "small": (210, 280), "medium": (526, 700), "paper": (1050, 1400), "hd": (1200, 1920), "uhd": (2160, 3840),
    "eight-uhd": (2160, 3840),
}  # fmt: skip
CAMERA: Final = {
    "small": (520, 776), "medium": (1296, 1944), "paper": (2592, 3888), "hd": (2880, 4320), "uhd": (5464, 8192),
    "eight-uhd": (5464, 8192),
}  # fmt: skip
"""(rows, columns)"""
COUNT: Final = {"hd": 4, "uhd": 4, "eight-uhd": 8}
"""Projectors, where they are not three."""
NAMES: Final = ("left", "middle", "right", "above", "below", "far-left", "far-right", "high")
FORESHORTENING: Final = (0.0, 0.25, -0.25, 0.15, -0.15, 0.3, -0.3, 0.1)
ANGLE: Final = (0.0, 0.12, -0.1, 0.06, -0.06, 0.16, -0.14, 0.03)
SIDE: Final = (0.0, 0.5, -0.5, 0.25, -0.25, 0.6, -0.6, 0.1)
SPILL: Final = (0.0, 0.05, 0.08, 0.03, 0.06, 0.02, 0.04, 0.07)
"""One value for each projector."""
MARGIN_PX: Final = 6
"""Of a crop, in projector pixels."""


def synthetic_calibration(
    size: str | None = None, *, projector: tuple[int, int] = (210, 280), camera: tuple[int, int] = (520, 776)
) -> Calibration:
    """Projectors of one of the named sizes, or three of the given (rows, columns)."""
    if size is not None:
        projector, camera = PROJECTOR[size], CAMERA[size]
    u, v, mask, albedo, black = _scene(camera)
    projectors = tuple(
        _projector(n, projector, camera, u, v, albedo * mask[..., None], mask) for n in range(COUNT.get(size or "", 3))
    )
    return Calibration(projectors, black, mask, TO_XYZ, mosaic=MOSAIC)


def write_synthetic_run(
    folder: Path,
    size: str | None = None,
    *,
    projector: tuple[int, int] = (210, 280),
    camera: tuple[int, int] = (520, 776),
) -> list[str]:
    """Write what a run of ``synthetic_calibration`` would have left, one projector at a time; returns the names."""
    if size is not None:
        projector, camera = PROJECTOR[size], CAMERA[size]
    u, v, mask, albedo, black = _scene(camera)
    albedo *= mask[..., None]
    names = list(NAMES[: COUNT.get(size or "", 3)])
    for n, name in enumerate(names):
        made = _projector(n, projector, camera, u, v, albedo, mask)
        Light(made.radiometry.response, made.radiometry.mixing, made.white, black, TO_XYZ).write(folder, name)
        found = made.phase_map
        assert found is not None
        seen = np.isfinite(found.projector_px[..., 0])
        pixels = made.metapixels
        Pixels(found.projector_px, seen.astype(np.float32), seen, pixels.centre_px, pixels.covariance_px2, pixels.valid,
               found.projector_px, found.spread_px2, MOSAIC).write(folder, name)  # fmt: skip
    return names


def synthetic_indirect(calibration: Calibration, lit: Mask) -> IndirectLight:
    """A sixth of the light of such a stage by way of other surfaces, in as many blocks as a calibration has.

    ``lit`` (rows, columns): camera pixels whose direct light the transport knows
    """
    grid, side = blocks_of(calibration.black.shape)
    y, x = np.divmod(np.arange(grid[0] * grid[1]), grid[1])
    near = np.exp(-0.5 * (np.subtract.outer(x, x) ** 2 + np.subtract.outer(y, y) ** 2) / 9)
    factors = near / near.sum(axis=1, keepdims=True) + 1 / len(x)
    white = np.sum([part.white for part in calibration.projectors], axis=0)
    paint = white / max(float(white.max()), 1e-30)
    return IndirectLight((factors / 4).astype(np.float32), paint.astype(np.float32), lit, grid, side)


TO_XYZ: Final = np.array([[0.41, 0.36, 0.18], [0.21, 0.72, 0.07], [0.02, 0.12, 0.95]])
MOSAIC: Final = np.array([[0, 1], [1, 2]])


def _scene(camera: tuple[int, int]) -> tuple[FloatImage, FloatImage, Mask, FloatImage, FloatImage]:
    """Places (u, v) in [-1, 1], the object's mask and albedo, and the black image."""
    y, x = np.mgrid[0 : camera[0], 0 : camera[1]].astype(np.float32)
    u, v = x / camera[1] * 2 - 1, y / camera[0] * 2 - 1
    mask: Mask = (u / 0.8) ** 2 + (v / 0.85) ** 2 < 1
    albedo = _albedo(u, v)
    return u, v, mask, albedo, (0.002 * albedo + 0.0005).astype(np.float32)


def crop_calibration(calibration: Calibration, top: int, left: int, side: int) -> Calibration:
    """``side`` x ``side`` camera pixels of a stage, and those projector pixels that light them.

    ``top`` and ``left`` even, so that the camera's mosaic stays as it is.
    """
    window = slice(top, top + side), slice(left, left + side)
    parts = []
    for part in calibration.projectors:
        assert part.phase_map is not None
        at = part.phase_map.projector_px[window]
        rows, columns = (_around(at[..., axis], part.metapixels.valid.shape[1 - axis]) for axis in (1, 0))
        whole = part.metapixels
        centre = whole.centre_px[rows, columns] - np.array([left, top], np.float32)
        metapixels = Metapixels(centre, whole.covariance_px2[rows, columns], whole.valid[rows, columns])
        phase_map = PhaseMap(
            at - np.array([columns.start, rows.start], np.float32), part.phase_map.spread_px2[rows, columns]
        )
        parts.append(dataclasses.replace(part, metapixels=metapixels, white=part.white[window], phase_map=phase_map))
    return dataclasses.replace(
        calibration,
        projectors=tuple(parts),
        black=calibration.black[window],
        object_mask=calibration.object_mask[window],
    )


def _around(values: FloatImage, most: int) -> slice:
    """The projector pixels from the least to the largest of some places, and ``MARGIN_PX`` more on either side."""
    if not np.isfinite(values).any():
        return slice(0, 1)
    low, high = int(np.nanmin(values)) - MARGIN_PX, int(np.nanmax(values)) + MARGIN_PX + 2
    return slice(max(low, 0), max(min(high, most), 1))


def synthetic_target(camera: tuple[int, int]) -> FloatImage:
    """Reflectance in [0, 1] with smooth shading, sharp edges and fine detail, as seen from the camera."""
    y, x = np.mgrid[0 : camera[0], 0 : camera[1]].astype(np.float32)
    u, v = x / camera[1] * 2 - 1, y / camera[0] * 2 - 1
    shade = 0.55 + 0.3 * np.sin(5 * u) * np.cos(4 * v) + 0.1 * np.sin(60 * u * v)
    checks = 0.25 * ((np.floor(u * 9) + np.floor(v * 6)) % 2)
    colour = np.stack([shade + checks * 0.4, shade * 0.9, 0.8 * shade + 0.15 * checks], -1)
    return np.clip(colour * 0.7, 0.02, 1).astype(np.float32)


def _albedo(u: FloatImage, v: FloatImage) -> FloatImage:
    stripes = 0.3 * ((np.floor(u * 7.3) + np.floor(v * 5.1)) % 2)
    waves = 0.15 * np.sin(31 * u) * np.sin(27 * v)
    return np.stack([0.4 + stripes, 0.5 + waves, 0.45 + 0.5 * stripes - waves], -1).astype(np.float32)


def _projector(
    n: int, size: tuple[int, int], camera: tuple[int, int], u: FloatImage, v: FloatImage, albedo: FloatImage, mask: Mask
) -> ProjectorCalibration:
    rows, columns = size
    row, column = np.mgrid[0:rows, 0:columns].astype(np.float64)
    p, q = (column + 0.5) / columns * 2 - 1, (row + 0.5) / rows * 2 - 1
    foreshortening, angle = FORESHORTENING[n], ANGLE[n]
    a, b = p + 0.6 * foreshortening * (p * p - 1), q + 0.03 * np.sin(3 * p + n)
    aspect = camera[1] / camera[0]
    c, s = np.cos(angle), np.sin(angle)
    x = camera[1] / 2 * (1 + 0.88 * (c * a - s * b / aspect)) + 0.13 * n
    y = camera[0] / 2 * (1 + 0.88 * (s * a * aspect + c * b)) - 0.21 * n
    centre = np.stack([x, y], -1)
    # A metapixel is the pixel's own parallelogram, softened: covariance J J' times a width.
    right, below = np.gradient(centre, axis=1), np.gradient(centre, axis=0)
    jacobian = np.stack([right, below], -1)
    covariance = 0.42**2 * jacobian @ np.swapaxes(jacobian, -1, -2) + 0.1 * np.eye(2)
    packed = np.stack([covariance[..., 0, 0], covariance[..., 0, 1], covariance[..., 1, 1]], -1)
    inside = (x >= 0) & (y >= 0) & (x < camera[1]) & (y < camera[0])
    at_x, at_y = np.clip(x.astype(int), 0, camera[1] - 1), np.clip(y.astype(int), 0, camera[0] - 1)
    valid: Mask = inside & (albedo[at_y, at_x, 0] > 0)
    falloff = (0.5 + 0.1 * (n % 4)) * np.clip(1 - 0.5 * (u - SIDE[n]) ** 2 - 0.3 * v**2, 0, None)
    spill = SPILL[n]
    mixing = (1 - spill) * np.eye(3) + spill / 3
    response = np.tile(np.linspace(0, 1, 256) ** 2.2, (3, 1))
    metapixels = Metapixels(centre.astype(np.float32), packed.astype(np.float32), valid)
    white = (albedo * falloff[..., None]).astype(np.float32)
    phase_map = _phase_map(n, size, camera, mask)
    return ProjectorCalibration(NAMES[n], metapixels, Radiometry(response, mixing), white, phase_map)


def _phase_map(n: int, size: tuple[int, int], camera: tuple[int, int], mask: Mask) -> PhaseMap:
    """The inverse of the centres of ``_projector``, in closed form."""
    foreshortening, angle = FORESHORTENING[n], ANGLE[n]
    y, x = np.mgrid[0 : camera[0], 0 : camera[1]].astype(np.float32)
    aspect = camera[1] / camera[0]
    c, s = np.cos(angle), np.sin(angle)
    along, across = ((x - 0.13 * n) * 2 / camera[1] - 1) / 0.88, ((y + 0.21 * n) * 2 / camera[0] - 1) / 0.88
    a, b = c * along + s * across / aspect, -s * along * aspect + c * across
    bend = 0.6 * foreshortening
    p = a if bend == 0 else (np.sqrt(np.maximum(1 + 4 * bend * (a + bend), 0)) - 1) / (2 * bend)
    q = b - 0.03 * np.sin(3 * p + n)
    position = np.stack([(p + 1) / 2 * size[1] - 0.5, (q + 1) / 2 * size[0] - 0.5], -1).astype(np.float32)
    position[~mask] = np.nan
    spread = np.broadcast_to(np.array([0.19, 0.01 * n, 0.2], np.float32), (*size, 3))
    return PhaseMap(position, np.ascontiguousarray(spread))


if __name__ == "__main__":
    print(" ".join(write_synthetic_run(Path(sys.argv[1]), sys.argv[2])))
