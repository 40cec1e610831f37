"""Rays through the static stage, cast once: what every camera subsample sees, and where each projector lights it.

The light on a surface point from a projector whose image plane is evenly lit (each pixel the same irradiance on a
plane facing the lens) is, at depth z along the axis, ``cos(surface) / (z^2 cos(axis))``: inverse square and Lambert,
with the 1/cos^3 by which a flat screen's corners are reached by less dense but wider pixels.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from embreex import rtcore_scene
from embreex.mesh_construction import TriangleMesh

from hal.runtime.compute import usable_cpus
from plugins.emulated.core.tables import dump
from plugins.emulated.core.truth import BenchTruth, Lens, Pose, ProjectorTruth
from plugins.emulated.optics.effects import rare
from plugins.emulated.optics.light_cache import read_arrays, write_arrays
from plugins.emulated.optics.objects import Scene, StageObject, scene_of
from plugins.emulated.optics.shapes import dot, length

KIND: Final = "rays"
VERSION: Final = 3
RAYS_AT_ONCE: Final = 1 << 18
SHADOW_BIAS_M: Final = 2e-4
SIGMA_STEP_PX: Final = 1.0 / 64.0
"""Blur is stored in these steps, in a byte: up to 4 px."""
BEYOND_PX: Final = 4.0
"""Blur spreads light beyond the projected image: points this far outside are still lit."""

Floats = npt.NDArray[np.float64]
Progress = Callable[[float], None]
Hidden = Callable[[Floats, Floats, Floats], npt.NDArray[np.bool_]]


@dataclass(frozen=True, slots=True)
class Samples:
    """Camera subsamples that hit the object, in camera pixel order; N of them in P pixels.

    ``pixels`` (P,) int32: flat camera pixel; ``starts`` (P + 1,) int32: its first sample;
    ``albedo`` (N, 3) float32, already divided by the S * S subsamples of a pixel;
    ``at_px`` (projectors, N, 2) float32: x, y in projector pixels;
    ``gain`` (projectors, N) float32: light on the point per linear light 1, 0 in shadow;
    ``blur`` (projectors, N) uint8: in SIGMA_STEP_PX
    ``gloss`` (projectors, N) float32: what highlights add to the albedo, divided by S * S too; (projectors, 0) without
    ``points`` (P, 3) float32: the middle of what a pixel sees, world metres; (0, 3) where no effect needs it
    ``on_object`` (P,) bool: it sees the object, not the room; (0,) as ``points``
    """

    pixels: npt.NDArray[np.int32]
    starts: npt.NDArray[np.int32]
    albedo: npt.NDArray[np.float32]
    at_px: npt.NDArray[np.float32]
    gain: npt.NDArray[np.float32]
    blur: npt.NDArray[np.uint8]
    gloss: npt.NDArray[np.float32]
    points: npt.NDArray[np.float32]
    on_object: npt.NDArray[np.bool_]


def samples_of(truth: BenchTruth, stage_object: StageObject, cache: Path | None, progress: Progress) -> Samples:
    """The stage's samples, from ``cache`` (a folder) when they were cast for such a truth and object before.

    ``progress`` is called with the share that is done, 0..1.
    """
    key = key_of(truth, stage_object)
    arrays = None if cache is None else read_arrays(cache, KIND, key)
    if arrays is not None and set(arrays) == {field.name for field in fields(Samples)}:
        samples = Samples(**arrays)
    else:
        samples = cast(truth, stage_object, progress)
        if cache is not None:
            write_arrays(cache, KIND, key, {field.name: getattr(samples, field.name) for field in fields(Samples)})
    progress(1.0)
    return samples


def cast(truth: BenchTruth, stage_object: StageObject, progress: Progress) -> Samples:
    """Cast every ray of the stage."""
    things = scene_of(stage_object, truth.surfaces)
    scene = rtcore_scene.EmbreeScene(robust=True)
    TriangleMesh(scene, things.vertices, things.faces)
    if truth.object.metal > 0.0:
        scene = rare("The metal of bench.toml").Mirrors(scene, things, truth.object.metal)
    width, height = truth.camera.lens.size_px
    rows = max(1, RAYS_AT_ONCE // (width * truth.subsamples**2))
    spans = [(first, min(first + rows, height)) for first in range(0, height, rows)]
    blocks = []
    with ThreadPoolExecutor(usable_cpus()) as threads:
        casting = [threads.submit(_cast_rows, truth, things, scene, *span) for span in spans]
        try:
            for (_, last), block in zip(spans, casting, strict=True):
                blocks.append(block.result())
                progress(last / height)
        except BaseException:
            threads.shutdown(cancel_futures=True)
            raise
    counts = np.concatenate([block["counts"] for block in blocks])
    pixels = np.flatnonzero(counts).astype(np.int32)
    starts = np.concatenate(([0], np.cumsum(counts[pixels]))).astype(np.int32)
    return Samples(
        pixels=pixels,
        starts=starts,
        albedo=np.concatenate([block["albedo"] for block in blocks]),
        at_px=np.concatenate([block["at_px"] for block in blocks], axis=1),
        gain=np.concatenate([block["gain"] for block in blocks], axis=1),
        blur=np.concatenate([block["blur"] for block in blocks], axis=1),
        gloss=np.concatenate([block["gloss"] for block in blocks], axis=1),
        points=np.concatenate([block["points"] for block in blocks]),
        on_object=np.concatenate([block["on_object"] for block in blocks]),
    )


def project(pose: Pose, lens: Lens, points: Floats) -> tuple[Floats, Floats]:
    """Pixels (N, 2) and points in the device's frame (N, 3) of world points (N, 3) in metres."""
    local = (points - pose.position_m) @ pose.rotation.T
    flat = local[:, :2] / local[:, 2:]
    square = dot(flat, flat)[:, None]
    bent = flat * (1.0 + square * (lens.distortion[0] + square * lens.distortion[1]))
    return bent * lens.focal_px + lens.centre_px, local


def directions(pose: Pose, lens: Lens, x: Floats, y: Floats) -> Floats:
    """World directions (N, 3), unit, of the rays through pixels (x, y)."""
    bent = (np.stack((x, y), axis=-1) - lens.centre_px) / lens.focal_px
    flat = bent.copy()
    for _ in range(8):  # converges within 1e-9 for the mild distortion of a photographic lens
        square = dot(flat, flat)[:, None]
        flat = bent / (1.0 + square * (lens.distortion[0] + square * lens.distortion[1]))
    local = np.concatenate((flat, np.ones((len(flat), 1))), axis=1)
    local /= length(local)[:, None]
    return np.asarray(local @ pose.rotation)


def _cast_rows(truth: BenchTruth, things: Scene, scene: Any, first: int, last: int) -> dict[str, npt.NDArray[Any]]:
    camera, s = truth.camera, truth.subsamples
    width = camera.lens.size_px[0]
    within = (np.arange(s) + 0.5) / s - 0.5
    y, x, dy, dx = np.meshgrid(np.arange(first, last), np.arange(width), within, within, indexing="ij")
    at_x, at_y = np.asarray(x + dx, np.float64).ravel(), np.asarray(y + dy, np.float64).ravel()
    ray = directions(camera.pose, camera.lens, at_x, at_y)
    origin = np.broadcast_to(np.asarray(camera.pose.position_m, np.float32), ray.shape).copy()
    hits = scene.run(origin, ray.astype(np.float32), output=1)
    hit = hits["primID"] >= 0
    counts = hit.reshape(-1, s * s).sum(axis=1)
    ray, faces = hits.get("ray", ray)[hit], hits["primID"][hit]
    weights = np.stack((1.0 - hits["u"][hit] - hits["v"][hit], hits["u"][hit], hits["v"][hit]), axis=-1)
    points = np.einsum("nk,nkc->nc", weights.astype(np.float64), things.vertices[things.faces[faces]])
    normals = np.einsum("nk,nkc->nc", weights, things.normals[faces]).astype(np.float64)
    normals /= np.maximum(length(normals), 1e-12)[:, None]
    normals *= _facing(hits["Ng"][hit].astype(np.float64), normals, ray)[:, None]
    lit = [_lit(projector, scene, points, normals) for projector in truth.projectors]
    on_object = faces < things.object_faces
    gloss = [_highlight(truth, one, points, normals, ray, on_object) / (s * s) for one in truth.projectors]
    places = _means(np.column_stack((points, on_object)), counts) if _needs_points(truth) else np.zeros((0, 4))
    return {
        "counts": counts,
        "albedo": (things.albedo(points, faces, weights) / (s * s)).astype(np.float32),
        "at_px": np.stack([at for at, _, _ in lit]),
        "gain": np.stack([gain for _, gain, _ in lit]),
        "blur": np.stack([blur for _, _, blur in lit]),
        "gloss": np.stack(gloss).astype(np.float32),
        "points": places[:, :3].astype(np.float32),
        "on_object": places[:, 3] > 0.5,
    }


def _needs_points(truth: BenchTruth) -> bool:
    return truth.camera.focus_m > 0.0 or truth.object.subsurface.share > 0.0


def _means(values: Floats, counts: npt.NDArray[np.int64]) -> Floats:
    """Means (P, k) of the samples (N, k) of each pixel that has some."""
    counts = counts[counts > 0]
    if not len(counts):
        return np.zeros((0, values.shape[1]))
    first = np.concatenate(([0], np.cumsum(counts[:-1])))
    return np.asarray(np.add.reduceat(values, first, axis=0) / counts[:, None])


def _facing(geometric: Floats, normals: Floats, ray: Floats) -> Floats:
    """+1 or -1 for each shading normal: a mesh may be inside out, and what the camera sees is the outside."""
    same_side = dot(geometric, normals) >= 0.0
    towards_camera = dot(geometric, ray) <= 0.0
    return np.where(same_side == towards_camera, 1.0, -1.0)


def _lit(
    projector: ProjectorTruth, scene: Any, points: Floats, normals: Floats
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32], npt.NDArray[np.uint8]]:
    """Where a projector lights points, how strongly, and how blurred."""

    def hidden(lens: Floats, points: Floats, distance: Floats) -> npt.NDArray[np.bool_]:
        return _in_shadow(lens, scene, points, distance)

    at, gain = arriving(projector, hidden, points, normals)
    focus = projector.focus
    z = (points - projector.pose.position_m) @ projector.pose.rotation[2]
    sigma = np.hypot(focus.sharpest_px, focus.slope_px_per_m * (z - focus.distance_m))
    blur = np.clip(np.round(sigma / SIGMA_STEP_PX), 1, 255).astype(np.uint8)
    return at.astype(np.float32), gain.astype(np.float32), blur


def arriving(projector: ProjectorTruth, hidden: Hidden, points: Floats, normals: Floats) -> tuple[Floats, Floats]:
    """Pixels (N, 2) of a projector that light points, and the light (N,) per linear light 1; 0 in shadow.

    ``hidden`` says for its lens (3,), points and their distances (N,) where something stands between.
    """
    light, size = projector.light, np.asarray(projector.lens.size_px)
    at, local = project(projector.pose, projector.lens, points)
    distance = length(local)
    z = local[:, 2]
    lens = np.asarray(projector.pose.position_m)
    cosine = dot(normals, (lens - points) / np.maximum(distance, 1e-9)[:, None])
    reach = (z > 0.01) & (cosine > 0.0) & np.all((at > -BEYOND_PX) & (at < size - 1 + BEYOND_PX), axis=1)
    reach[reach] = ~hidden(lens, points[reach], distance[reach])
    off_centre = (at - 0.5 * (size - 1)) / (0.5 * size)
    corner = dot(off_centre, off_centre) / 2.0
    gain = light.brightness * light.reference_m**2 * cosine * distance / np.maximum(z, 0.01) ** 3
    gain *= np.maximum(1.0 - light.vignetting * corner, 0.0)
    return at, np.where(reach, gain, 0.0)


def _highlight(
    truth: BenchTruth,
    projector: ProjectorTruth,
    points: Floats,
    normals: Floats,
    ray: Floats,
    on_object: npt.NDArray[np.bool_],
) -> Floats:
    """What a highlight adds to the albedo at points, in the direction of the camera; nothing (0,) without gloss."""
    strength, exponent, varnish = truth.object.gloss, truth.object.gloss_exponent, truth.object.varnish
    if strength <= 0.0 and varnish.strength <= 0.0:
        return np.zeros(0)
    towards = np.asarray(projector.pose.position_m) - points
    towards /= np.maximum(length(towards), 1e-9)[:, None]
    half = towards - ray
    half /= np.maximum(length(half), 1e-9)[:, None]
    cosine = np.clip(dot(half, normals), 0.0, 1.0)
    highlight = strength * (exponent + 8.0) / 8.0 * cosine**exponent
    if varnish.strength > 0.0:
        reflected = rare("The varnish of bench.toml").reflected
        highlight += varnish.strength * reflected(towards, -ray, normals, varnish.roughness, varnish.index)
    return np.asarray(on_object * highlight)


def _in_shadow(lens: Floats, scene: Any, points: Floats, distance: Floats) -> npt.NDArray[np.bool_]:
    """Rays from the lens: in shadow when something is hit clearly before the point itself."""
    ray = ((points - lens) / distance[:, None]).astype(np.float32)
    origin = np.broadcast_to(lens.astype(np.float32), ray.shape).copy()
    if not len(points):
        return np.zeros(0, dtype=np.bool_)
    before = (distance - SHADOW_BIAS_M).astype(np.float32)
    return np.asarray(scene.run(origin, ray, dists=before, query="OCCLUDED") >= 0)


def key_of(truth: BenchTruth, stage_object: StageObject) -> str:
    """A text that differs where the rays of stages do."""
    scene = scene_of(stage_object, truth.surfaces)
    digest = hashlib.sha256(f"{VERSION}\n".encode())
    projectors = [part for p in truth.projectors for part in (p.pose, p.lens, p.focus, p.light)]
    for part in (truth.camera.pose, truth.camera.lens, *projectors):
        digest.update(dump(part).encode())
    digest.update(f"{truth.subsamples} {truth.object.gloss} {truth.object.gloss_exponent}".encode())
    digest.update(f"{dump(truth.object.varnish)} {truth.object.metal} {_needs_points(truth)}".encode())
    for array in scene.fingerprint():
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()
