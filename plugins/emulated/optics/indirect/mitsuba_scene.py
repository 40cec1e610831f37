"""The stage as a scene of Mitsuba 3, an extra: triangles, smooth normals, and what rays meet there."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from hal.errors import DeviceError
from plugins.emulated.optics.furnished import Scene
from plugins.emulated.optics.rays import SHADOW_BIAS_M

Floats = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]
VARIANT: Final = "llvm_ad_rgb"
REMEDY: Final = (
    'Install the packages "mitsuba" (by pip) and "libllvm15" (by apt), or set engine = "radiosity" in bench.toml.'
)


@dataclass(frozen=True, slots=True)
class Met:
    """Rays that met something: ``ray``: which; ``points``, ``normals`` towards the ray's origin (N, 3); ``faces`` (N,)

    and ``weights`` (N, 3) of the face's corners
    """

    ray: Integers
    points: Floats
    normals: Floats
    faces: npt.NDArray[np.int32]
    weights: npt.NDArray[np.float32]


class MitsubaScene:
    """Use by one thread, in a process where nobody else uses Mitsuba: its variant is one for all.

    Raises DeviceError ``engine-missing`` where Mitsuba can't be used.
    """

    def __init__(self, scene: Scene) -> None:
        self._mi = _mitsuba()
        self._scene = self._mi.load_dict({"type": "scene", "all": self._mesh(scene)})

    def _mesh(self, scene: Scene) -> Any:
        mi, corners = self._mi, scene.vertices[scene.faces].reshape(-1, 3)
        mesh = mi.Mesh("all", len(corners), len(scene.faces), has_vertex_normals=True)
        values = mi.traverse(mesh)
        values["vertex_positions"] = mi.Float(corners.ravel().astype(np.float32))
        values["vertex_normals"] = mi.Float(scene.normals.ravel().astype(np.float32))
        values["faces"] = mi.UInt32(np.arange(len(corners), dtype=np.uint32))
        values.update()
        return mesh

    def hit(self, origins: Floats, rays: Floats) -> Met:
        """What rays meet first."""
        if not len(rays):
            empty = np.zeros((0, 3))
            return Met(np.zeros(0, np.int64), empty, empty, np.zeros(0, np.int32), empty.astype(np.float32))
        return self._met(self._scene.ray_intersect(self._rays(origins, rays)), rays)

    def leave(self, points: Floats, normals: Floats, rays: Floats) -> Met:
        """What rays meet that leave points of surfaces, on the side of ``normals``."""
        return self.hit(points + _clear(points) * normals, rays)

    def hidden(self, origin: Floats, points: Floats, distance: Floats) -> npt.NDArray[np.bool_]:
        """Whether something stands between ``origin`` (3,) and points at ``distance``."""
        if not len(points):
            return np.zeros(0, dtype=np.bool_)
        ray = self._rays(np.broadcast_to(origin, points.shape), (points - origin) / distance[:, None])
        ray.maxt = self._mi.Float((distance - SHADOW_BIAS_M).astype(np.float32))
        return np.array(self._scene.ray_test(ray), dtype=np.bool_)

    def _rays(self, origins: Floats, rays: Floats) -> Any:
        mi = self._mi
        columns = [np.ascontiguousarray(part.T, dtype=np.float32) for part in (origins, rays)]
        o, d = ([mi.Float(axis) for axis in part] for part in columns)
        return mi.Ray3f(mi.Point3f(*o), mi.Vector3f(*d))

    def _met(self, found: Any, rays: Floats) -> Met:
        import drjit

        parts = (found.is_valid(), found.sh_frame.n, found.n, found.uv, found.p, found.prim_index)
        # All of them by one kernel: each array by itself would trace the rays again.
        drjit.eval(*parts)
        valid, smooth, flat, corners, points, faces = (np.array(part) for part in parts)
        ray = np.flatnonzero(valid)
        normals, outside = smooth.T[ray].astype(np.float64), flat.T[ray].astype(np.float64)
        # A mesh may be inside out: what light meets is its outside.
        outside *= np.where(np.sum(outside * rays[ray], axis=1) > 0.0, -1.0, 1.0)[:, None]
        normals *= np.where(np.sum(normals * outside, axis=1) < 0.0, -1.0, 1.0)[:, None]
        u, v = corners[:, ray]
        weights = np.stack((1.0 - u - v, u, v), axis=1).astype(np.float32)
        return Met(ray, points.T[ray].astype(np.float64), normals, faces[ray].astype(np.int32), weights)


def _clear(points: Floats) -> float:
    """So far above the surface rays start: enough for numbers of 32 bits."""
    return 2e-5 * max(1.0, float(np.abs(points).max(initial=0.0)))


def _mitsuba() -> Any:
    try:
        import mitsuba

        mitsuba.set_variant(VARIANT)
    except (ImportError, AttributeError) as error:
        raise DeviceError("engine-missing", what=f"Mitsuba 3 can't be used: {error}.", remedy=REMEDY) from error
    return mitsuba
