"""What real devices do beyond those of a demo: flaws of sensors, depth of field, dithered panels, varnish, polished
metal; the room ``hard``.

``plugins.emulated.optics`` asks for this module where a stage has such effects (``plugins.emulated.core.extensions``);
``SeparateOutputs``, ``Spread``, ``colours`` and ``xyz_to_camera`` are part of it.
"""

from __future__ import annotations

import dataclasses
from typing import Any, Final

import cv2
import numpy as np
import numpy.typing as npt

from lab.emulated.outputs import SeparateOutputs
from lab.emulated.spectra import colours, xyz_to_camera
from lab.emulated.subsurface import Spread
from plugins.emulated.core.truth import BenchTruth, CameraTruth, Dithering, Panels, ProjectorTruth, Subsurface
from plugins.emulated.optics.effects import SensorFlaws
from plugins.emulated.optics.objects import Scene, StageObject
from plugins.emulated.optics.shapes import dot

FILTERS_NM: Final = ((600.0, 38.0), (535.0, 38.0), (460.0, 28.0))
"""Of a camera: peak and standard deviation for red, green and blue."""
LAMP_NM: Final = ((625.0, 22.0), (540.0, 26.0), (455.0, 18.0))
"""Of a projector, likewise."""
BENT: Final = 0.02
"""Largest first radial term of a projector's lens: about a pixel at the edge of a picture at size small."""
MARBLE: Final = Subsurface(share=0.3, spread_m=0.0015)
TURNS: Final = Dithering(levels=64, turns=4, frame_s=1 / 240)
"""A panel of 64 levels, whose others are made by turns of frames."""
HOT_E_PER_S: Final = 2e4
"""Mean dark current of hot pixels; each has its own, by an exponential law."""
FloatImage = npt.NDArray[np.float32]
LARGEST_PX: Final = 24.0
STEP: Final = 1.25
"""Between the blurs of two layers; a pixel's light is divided between the two that are next to its own."""
SMALLEST_PX: Final = 0.3
CLEAR_M: Final = 1e-4
"""So far above metal mirrored rays start."""


def sensor_flaws(camera: CameraTruth, seed: int) -> SensorFlaws | None:
    """Of this very sensor; None where it has none."""
    sensor = camera.sensor
    if not (sensor.response_spread or sensor.hot_pixels):
        return None
    rng, shape = np.random.default_rng([seed, 6]), camera.lens.size_px[::-1]
    response = 1.0 + sensor.response_spread * rng.standard_normal(shape)
    hot = rng.random(shape) < sensor.hot_pixels
    return SensorFlaws(
        response=np.maximum(response, 0.0).astype(np.float32),
        dark_e_per_s=(hot * rng.exponential(HOT_E_PER_S, shape)).astype(np.float32),
    )


def exposed_s(camera: CameraTruth, seed: int, exposure_s: float) -> float:
    """How long the shutter is open when the camera says ``exposure_s``: each speed has an error of its own."""
    spread = camera.sensor.shutter_spread
    if not spread:
        return exposure_s
    speed = np.random.default_rng([seed, 7, round(1e6 * exposure_s)])
    return exposure_s * float(np.exp(spread * speed.standard_normal()))


def confusion_px(
    depth_m: npt.NDArray[np.float64], *, focal_px: float, pixel_m: float, aperture_f: float, focus_m: float
) -> npt.NDArray[np.float64]:
    """Standard deviation, along each axis, of the circle of confusion of points ``depth_m`` along the optical axis.

    Its diameter is f^2 / N |z - s| / (z (s - f)) for a lens of focal length f = ``focal_px`` x ``pixel_m`` focused
    at s; a disc's standard deviation is a quarter of its diameter.
    """
    focal = focal_px * pixel_m
    diameter = focal**2 / aperture_f * np.abs(depth_m - focus_m) / (depth_m * (focus_m - focal))
    return np.asarray(0.25 * diameter / pixel_m)


def defocused(image: FloatImage, sigma_px: FloatImage) -> FloatImage:
    """Each pixel's light (rows, columns, 3) spread by its own ``sigma_px`` (rows, columns)."""
    most = float(min(sigma_px.max(initial=0.0), LARGEST_PX))
    if most <= SMALLEST_PX:
        return image
    count = int(np.ceil(np.log(most / SMALLEST_PX) / np.log(STEP))) + 1
    blurs = np.concatenate([[0.0], SMALLEST_PX * STEP ** np.arange(count)])
    # Between two blurs the share is linear in the variance, so that each pixel's light has the variance asked for.
    variances = [_variance(float(blur)) for blur in blurs]
    at = np.interp(np.minimum(sigma_px, most) ** 2, variances, np.arange(len(blurs)))
    out = np.zeros_like(image)
    for n, sigma in enumerate(blurs):
        share = np.maximum(1.0 - np.abs(at - n), 0.0).astype(np.float32)
        if share.any():
            part = image * share[..., None]
            out += part if sigma == 0.0 else cv2.GaussianBlur(part, (0, 0), float(sigma))
    return out


def _variance(sigma: float) -> float:
    """Of OpenCV's kernel, which is narrower than its Gaussian where that is as narrow as a pixel."""
    if sigma == 0.0:
        return 0.0
    weights = cv2.getGaussianKernel(2 * round(4 * sigma) + 1, sigma)[:, 0]
    return float(weights @ (np.arange(len(weights)) - len(weights) // 2) ** 2)


ORDER: Final = np.array([[0, 8, 2, 10], [12, 4, 14, 6], [3, 11, 1, 9], [15, 7, 13, 5]])
"""Bayer's matrix: adjacent pixels take their turns at different times."""


def mean_light(light: FloatImage, *, levels: int, turns: int, start: float, frames: float) -> FloatImage:
    """The mean light (rows, columns, 3) of a dithered panel during an exposure.

    ``light``: wanted, 0 to 1; ``levels``: that the panel makes in one frame; ``turns``: frames in which it comes round;
    ``start``: when the shutter opens, in frames; ``frames``: how long it is open, in frames
    """
    steps = np.float32(levels - 1)
    low = np.floor(light * steps)
    # so many of the turns show the level above
    above = np.rint((light * steps - low) * np.float32(turns))
    rows, columns = light.shape[:2]
    phase = np.tile(ORDER, (rows // 4 + 1, columns // 4 + 1))[:rows, :columns, None] * turns // ORDER.size
    mean = np.zeros_like(light)
    for turn, weight in enumerate(seen_of_turns(turns, start, frames)):
        mean += np.float32(weight) * (((turn + phase) % turns) < above)
    return np.asarray((low + mean) / steps, np.float32)


def seen_of_turns(turns: int, start: float, frames: float) -> npt.NDArray[np.float64]:
    """Share (turns,) of an exposure that lies in each turn; they sum to 1."""
    edges = np.arange(turns + 1)

    def until(moment: float) -> npt.NDArray[np.float64]:
        rounds, rest = divmod(moment, turns)
        return np.asarray(rounds + np.clip(rest - edges[:-1], 0.0, 1.0))

    seen = until(start + frames) - until(start)
    return np.asarray(seen / seen.sum())


Floats = npt.NDArray[np.float64]


def reflected(towards_light: Floats, towards_eye: Floats, normals: Floats, roughness: float, index: float) -> Floats:
    """pi times the varnish's reflectance (N,) for unit directions (N, 3): what a highlight adds to a paint's albedo.

    D F G / (4 cos cos) with the distribution and shadowing of GGX and Fresnel's factor for unpolarised light.
    ``roughness``: alpha of GGX; ``index``: of refraction. 0 where light or eye is below the surface.
    """
    half = towards_light + towards_eye
    half = half / np.maximum(np.sqrt(dot(half, half)), 1e-12)[:, None]
    to_light, to_eye = dot(normals, towards_light), dot(normals, towards_eye)
    above = (to_light > 1e-6) & (to_eye > 1e-6)
    to_light, to_eye = np.where(above, to_light, 1.0), np.where(above, to_eye, 1.0)
    square = roughness * roughness
    facets = square / (np.pi * (dot(normals, half) ** 2 * (square - 1.0) + 1.0) ** 2)
    seen = _unshadowed(to_light, square) * _unshadowed(to_eye, square)
    mirrored = fresnel(np.clip(dot(towards_light, half), 0.0, 1.0), index)
    return np.where(above, np.pi * facets * seen * mirrored / (4.0 * to_light * to_eye), 0.0)


def fresnel(cosine: Floats, index: float) -> Floats:
    """Share (N,) of unpolarised light that is mirrored by a surface of a refractive ``index`` in air."""
    inside = np.sqrt(1.0 - (1.0 - cosine**2) / index**2)
    across = (cosine - index * inside) / (cosine + index * inside)
    along = (index * cosine - inside) / (index * cosine + inside)
    return np.asarray(0.5 * (across**2 + along**2))


def _unshadowed(cosine: Floats, square: float) -> Floats:
    """Smith's share of facets that a direction sees."""
    return np.asarray(2.0 * cosine / (cosine + np.sqrt(square + (1.0 - square) * cosine**2)))


class Mirrors:
    """A scene for rays of the camera that continue from polished metal, and so see in it what is around.

    ``share``: of the object's height, from its top, that is metal. What it throws on other surfaces is left out.
    """

    def __init__(self, scene: Any, things: Scene, share: float) -> None:
        self._scene, self._things = scene, things
        faces = things.faces[: things.object_faces]
        heights = things.vertices[np.unique(faces), 1]
        self._until_m = float(heights.min() + share * np.ptp(heights))

    def run(self, origins: FloatImage, rays: FloatImage, **how: Any) -> Any:
        """As the scene; where it is asked for more than faces, with ``ray``: the direction that met them."""
        hits = self._scene.run(origins, rays, **how)
        if "output" not in how:
            return hits
        faces, things = np.maximum(hits["primID"], 0), self._things
        weights = np.stack((1.0 - hits["u"] - hits["v"], hits["u"], hits["v"]), axis=-1)
        points = np.einsum("nk,nkc->nc", weights, things.vertices[things.faces[faces]])
        normals = np.einsum("nk,nkc->nc", weights, things.normals[faces])
        normals /= np.maximum(np.linalg.norm(normals, axis=1), 1e-12)[:, None]
        metal = (hits["primID"] >= 0) & (faces < things.object_faces) & (points[:, 1] < self._until_m)
        cosine = dot(rays[metal], normals[metal])[:, None]
        seen = rays.copy()
        seen[metal] -= 2.0 * cosine * normals[metal]
        above = points[metal] - CLEAR_M * np.sign(cosine) * normals[metal]
        again = self._scene.run(above.astype(np.float32), seen[metal], **how)
        for key, values in again.items():
            hits[key][metal] = values
        return {**hits, "ray": seen.astype(np.float64)}


def hard(truth: BenchTruth, thing: StageObject) -> BenchTruth:
    """A stage in the room ``room``, with all the rest as strong as with real devices."""
    rng = np.random.default_rng([truth.seed, 8])
    sensor = dataclasses.replace(truth.camera.sensor, response_spread=0.01, hot_pixels=2e-4, shutter_spread=0.02)
    away_m = float(np.linalg.norm(thing.vertices.mean(axis=0) - np.array(truth.camera.pose.position_m)))
    return dataclasses.replace(
        truth,
        object=dataclasses.replace(truth.object, gloss=0.04, gloss_exponent=25.0, subsurface=MARBLE),
        camera=dataclasses.replace(truth.camera, sensor=sensor, focus_m=away_m, bands_nm=FILTERS_NM),
        projectors=tuple(_hard_projector(one, rng) for one in truth.projectors),
    )


def _hard_projector(projector: ProjectorTruth, rng: np.random.Generator) -> ProjectorTruth:
    turn = rng.uniform(0.0, 2.0 * np.pi, 2)
    red, blue = ((0.3 * float(np.cos(angle)), 0.3 * float(np.sin(angle))) for angle in turn)
    panels = Panels(shift_px=(red, (0.0, 0.0), blue), magnified=(-4e-4, 0.0, 4e-4))
    light = dataclasses.replace(projector.light, glare=0.02, white_segment=0.25, bands_nm=LAMP_NM)
    lens = dataclasses.replace(projector.lens, distortion=(float(rng.uniform(-BENT, BENT)), 0.0))
    return dataclasses.replace(projector, lens=lens, light=light, panels=panels, dithering=TURNS)


__all__ = (
    "Mirrors", "SeparateOutputs", "Spread", "colours", "confusion_px", "defocused", "exposed_s", "fresnel", "hard",
    "mean_light", "reflected", "seen_of_turns", "sensor_flaws", "xyz_to_camera",
)  # fmt: skip
