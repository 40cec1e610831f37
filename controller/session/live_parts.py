"""What the live mode needs of a calibration, made small enough for a bundle (docs/bundle-format.md, "Live section").

P_s is the mean of the scale image C_s over a projector pixel's light in the camera (paper eq. 6). The light transport
gives that mean exactly; here each pixel keeps the centre and the covariance of its weights, which are those of a
Gaussian to within what a stage's grade leaves open (docs/decisions/0021).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
import numpy.typing as npt

from controller.arrays import ByteImage, FloatImage
from controller.bundle.writer import NewLive
from controller.calibrate.values import Calibration
from controller.capture.encoding import checked_response
from controller.errors import WorkError
from controller.session.solving import Calibrated
from controller.solve.appearance import Base
from controller.solve.dither import blue_noise
from controller.transport import LightTransport
from controller.transport.planes import image_planes, plane_frames, plane_image

LARGEST_TARGET_PX: Final = 2048
"""A side of the targets; a larger camera picture is reduced by a whole number."""
WAVE_PX: Final = 64.0
"""Of the waves by which spreads are measured: long beside any projector pixel, short enough for single precision."""
LEAST_SIGMA_PX: Final = 0.3
FULL: Final = 65535

Arrays = dict[str, npt.NDArray[Any]]


def live_arrays(run: Path, outputs: Mapping[str, tuple[str, tuple[int, int]]]) -> NewLive:
    """The live section for the calibration and base image in the folder ``run``; ``outputs``: by projector, its output.

    Raises WorkError("base-not-solved").
    """
    if not (run / "base.json").exists():
        raise WorkError(
            "base-not-solved",
            what=f"{run.name} holds no base image, which live targets are scaled from.",
            remedy="Run `velatura appearance` on the stage first.",
        )
    calibrated = Calibrated(run, tuple(outputs))
    calibration = calibrated.calibration
    model = live_model(calibrated.transport, calibrated.base, calibration.black)
    return named_arrays(model, calibration, [outputs[part.name][0] for part in calibration.projectors])


def named_arrays(model: Arrays, calibration: Calibration, outputs: Sequence[str]) -> NewLive:
    """The whole section, from ``live_model`` and what is known of each projector; ``outputs``: their names."""
    named: Arrays = {name: values for name, values in model.items() if "." not in name}
    for n, (part, output) in enumerate(zip(calibration.projectors, outputs, strict=True)):
        named |= {f"{output}.{key}": model[f"{n}.{key}"] for key in ("base", "range", "centre", "shape")}
        named[f"{output}.unmix"] = np.linalg.inv(part.radiometry.mixing).astype(np.float32)
        named[f"{output}.response"] = checked_response(part.radiometry.response)
        named[f"{output}.dither"] = np.array([17 * n % 64, 29 * n % 64], np.uint16)
    named["noise"] = blue_noise()
    rows, columns = named["present"].shape
    return NewLive((columns, rows), named)


def live_model(transport: LightTransport, base: Base, black: FloatImage) -> Arrays:
    """The section's maps of the target, and those of each projector named by its number ("0.base")."""
    factor = -(-max(transport.shape) // LARGEST_TARGET_PX)
    lit = base.inverse > 0
    unit = float(np.median(1 / base.inverse[lit])) if lit.any() else 1.0
    share = _reduced(lit.mean(axis=0, dtype=np.float32), factor)
    arrays: Arrays = {
        "gain": _reduced(plane_image(base.inverse), factor, unit).astype(np.float16),
        "offset": _reduced(plane_image(base.inverse * image_planes(np.maximum(black, 0))), factor).astype(np.float16),
        "present": np.asarray(np.rint(255 * share), np.uint8),
        "unit": np.array([unit], np.float32),
    }
    centre, sigma, correlation = footprints(transport, factor)
    sides = np.array(arrays["present"].shape[::-1], np.float32) - 1
    mixed = plane_frames(base.mixed, transport.sizes)
    for n, size in enumerate(transport.sizes):
        span = transport.span(n)
        low, high = float(mixed[n].min()), float(mixed[n].max())
        scaled = (mixed[n] - np.float32(low)) / np.float32(max(high - low, 1e-30))
        place: FloatImage = np.clip(centre[span] / np.maximum(sides, np.float32(1)), 0, 1)
        arrays |= {
            f"{n}.base": np.asarray(np.rint(FULL * scaled), np.uint16),
            f"{n}.range": np.array([low, high], np.float32),
            f"{n}.centre": np.asarray(np.rint(FULL * place), np.uint16).reshape(*size, 2),
            f"{n}.shape": _packed_shape(sigma[span], correlation[span]).reshape(*size, 3),
        }
    return arrays


def _reduced(image: FloatImage, factor: int, times: float = 1.0) -> FloatImage:
    rows, columns = image.shape[:2]
    size = -(-columns // factor), -(-rows // factor)
    # Whole blocks, so that a target's pixel is the same camera pixels everywhere; the edge is repeated.
    padded = np.pad(
        image,
        [(0, size[1] * factor - rows), (0, size[0] * factor - columns), *[(0, 0)] * (image.ndim - 2)],
        mode="edge",
    )
    small = padded if factor == 1 else cv2.resize(padded, size, interpolation=cv2.INTER_AREA)
    return np.asarray(small * np.float32(times), np.float32)


def footprints(transport: LightTransport, factor: int) -> tuple[FloatImage, FloatImage, FloatImage]:
    """Where each projector pixel's weights lie in the target, reduced by ``factor``.

    Returns the means (pixels, 2) as (x, y), the standard deviations (pixels, 2), 0 where a pixel lights nothing, and
    the correlations (pixels,). Spreads are measured by how much a wave is dampened, which keeps single precision where
    the mean of squares would lose it.
    """
    rows, columns = transport.shape
    y, x = np.mgrid[0:rows, 0:columns].astype(np.float32)
    mean = _Means(transport)
    centre = np.stack([mean(x), mean(y)], axis=-1)
    across, down, both = (_variance(mean, wave) for wave in (x, y, x + y))
    # What the mean over a target's pixel blurs already.
    box = (factor**2 - 1) / 12
    variance = np.stack([across, down], axis=-1) - box
    sigma = np.sqrt(np.maximum(variance, (LEAST_SIGMA_PX * factor) ** 2)) / factor
    covariance = (both - across - down) / 2 / factor**2
    correlation = np.clip(covariance / (sigma[:, 0] * sigma[:, 1]), -0.95, 0.95)
    sigma[~mean.lit] = 0
    place = (centre + np.float32(0.5)) / np.float32(factor) - np.float32(0.5)
    return place.astype(np.float32), sigma.astype(np.float32), np.asarray(correlation, np.float32)


class _Means:
    """Means of one-channel images over every projector pixel, of all channels together; 0 where ``lit`` is False."""

    def __init__(self, transport: LightTransport) -> None:
        self._transport = transport
        self._count = transport.gaussian_mean_planes(np.ones((3, *transport.shape), np.float32)).sum(axis=0)
        self.lit = self._count > 0

    def __call__(self, image: FloatImage) -> FloatImage:
        planes = np.ascontiguousarray(np.broadcast_to(image, (3, *image.shape)), np.float32)
        total = self._transport.gaussian_mean_planes(planes).sum(axis=0)
        return np.asarray(np.divide(total, self._count, out=np.zeros_like(total), where=self.lit), np.float32)


def _variance(mean: _Means, along: FloatImage) -> FloatImage:
    turn = np.float32(2 * np.pi / WAVE_PX)
    power = mean(np.cos(turn * along)) ** 2 + mean(np.sin(turn * along)) ** 2
    logarithm: FloatImage = np.log(np.maximum(power, np.float32(1e-6)))
    return np.asarray(np.maximum(-logarithm / turn**2, 0), np.float32)


def _packed_shape(sigma: FloatImage, correlation: FloatImage) -> ByteImage:
    lit = sigma[:, :1] > 0
    logarithm = 96 + 32 * np.log2(sigma, out=np.zeros_like(sigma), where=sigma > 0)
    packed = np.concatenate([np.clip(np.rint(logarithm), 1, 255), 128 + np.rint(127 * correlation[:, None])], axis=1)
    return np.asarray(np.where(lit, packed, 0), np.uint8)
