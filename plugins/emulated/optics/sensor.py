"""The emulated camera's sensor: light to photo-electrons, noise, a 12-bit Bayer mosaic, and the JPEG made from it."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from plugins.emulated.core.truth import Sensor
from plugins.emulated.optics.effects import SensorFlaws

REFERENCE_APERTURE_F = 8.0
SENSOR_WIDTH_MM = 22.2
"""APS-C."""


def mosaic(
    light: npt.NDArray[np.float32],
    sensor: Sensor,
    rng: np.random.Generator,
    *,
    exposure_s: float,
    iso: int,
    aperture_f: float,
    flaws: SensorFlaws | None = None,
) -> npt.NDArray[np.uint16]:
    """Raw values (rows, columns) of linear light (rows, columns, 3), RGGB; even numbers of rows and columns.

    Shot noise is the Gaussian of the photo-electrons' Poisson distribution; with the read noise of any camera the
    difference cannot be seen. Full wells and the converter both saturate.
    """
    electrons = np.empty(light.shape[:2], dtype=np.float32)
    for row, column, channel in ((0, 0, 0), (0, 1, 1), (1, 0, 1), (1, 1, 2)):
        electrons[row::2, column::2] = light[row::2, column::2, channel]
    electrons *= np.float32(sensor.electrons_per_light_s * exposure_s * (REFERENCE_APERTURE_F / aperture_f) ** 2)
    if flaws is not None:
        electrons *= flaws.response
        electrons += np.float32(exposure_s) * flaws.dark_e_per_s
    np.minimum(electrons, np.float32(sensor.full_well_e), out=electrons)
    noise = rng.standard_normal(electrons.shape, dtype=np.float32)
    electrons += np.float32(sensor.noise) * noise * np.sqrt(electrons + np.float32(sensor.read_noise_e**2))
    electrons *= np.float32(iso / 100.0 / sensor.electrons_per_step)
    electrons += np.float32(sensor.black_level)
    return np.clip(np.rint(electrons), 0, sensor.white_level).astype(np.uint16)


def jpeg(raw: npt.NDArray[np.uint16], sensor: Sensor, *, quality: int = 95) -> bytes:
    """A baseline JPEG of a raw mosaic, through the camera's tone curve."""
    bgr = cv2.cvtColor(raw, cv2.COLOR_BayerRGGB2BGR)
    done, data = cv2.imencode(".jpg", tone_curve(sensor)[bgr], [cv2.IMWRITE_JPEG_QUALITY, quality])
    if not done:
        raise ValueError(f"an image of shape {raw.shape} can't be a JPEG")
    return data.tobytes()


def tone_curve(sensor: Sensor) -> npt.NDArray[np.uint8]:
    """The 8-bit JPEG value of each raw value: roughly sRGB, with the gentle S that cameras add for contrast."""
    steps = np.arange(sensor.white_level + 1)
    linear = np.clip((steps - sensor.black_level) / (sensor.white_level - sensor.black_level), 0.0, 1.0)
    value = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1.0 / 2.4) - 0.055)
    value += sensor.contrast * value * (1.0 - value) * (2.0 * value - 1.0)
    return np.clip(np.rint(255.0 * value), 0, 255).astype(np.uint8)
