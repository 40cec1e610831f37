"""Light between surfaces along paths through Mitsuba's scene, recorded once: every frame's light is then a product.

Camera pixels that see the same spot are a cell. From each cell paths leave as diffuse light would, and bounce from
surface to surface. At each surface they meet, every projector's light there counts: a weight on that projector's pixel.
So the light of all paths is a sparse matrix for each projector, and it is what a path tracer would find, for any frame.

Mitsuba 3 is an extra. Paths are traced in a process of their own: it has one variant for all who use it, and may end
its process.
"""

from __future__ import annotations

import multiprocessing
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import Any, Final, Self

import numpy as np
import numpy.typing as npt
from scipy import sparse

from hal.errors import DeviceError
from plugins.emulated.core.truth import BenchTruth
from plugins.emulated.optics.light_cache import sparse_arrays, sparse_matrix
from plugins.emulated.optics.objects import Scene, StageObject, scene_of
from plugins.emulated.optics.rays import SHADOW_BIAS_M, Progress, arriving, directions

VARIANT: Final = "llvm_ad_rgb"
REMEDY: Final = (
    'Install the packages "mitsuba" (by pip) and "libllvm15" (by apt), or set engine = "radiosity" in bench.toml.'
)


@dataclass(frozen=True, slots=True)
class SurfaceHits:
    """Rays that met something: ``ray``: which; ``points``, ``normals`` towards the ray's origin (N, 3); ``faces`` (N,)

    and ``weights`` (N, 3) of the face's corners
    """

    ray: Integers
    points: Floats
    normals: Floats
    faces: npt.NDArray[np.int32]
    weights: npt.NDArray[np.float32]


class MitsubaScene:
    """Use by one thread, in a process where nothing else uses Mitsuba: its variant is one for all.

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

    def hit(self, origins: Floats, rays: Floats) -> SurfaceHits:
        """What rays meet first."""
        if not len(rays):
            empty = np.zeros((0, 3))
            return SurfaceHits(np.zeros(0, np.int64), empty, empty, np.zeros(0, np.int32), empty.astype(np.float32))
        return self._met(self._scene.ray_intersect(self._rays(origins, rays)), rays)

    def leave(self, points: Floats, normals: Floats, rays: Floats) -> SurfaceHits:
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

    def _met(self, interaction: Any, rays: Floats) -> SurfaceHits:
        import drjit

        parts = (
            interaction.is_valid(),
            interaction.sh_frame.n,
            interaction.n,
            interaction.uv,
            interaction.p,
            interaction.prim_index,
        )
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
        return SurfaceHits(ray, points.T[ray].astype(np.float64), normals, faces[ray].astype(np.int32), weights)


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


Floats = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]
FloatImage = npt.NDArray[np.float32]

CELLS_ACROSS: Final = 194
"""Of the camera's picture; a cell is split where it sees more than one surface."""
PIXELS_ACROSS: Final = 100
"""About so many groups of a projector's pixels, between which recorded light does not tell."""
PATHS_AT_ONCE: Final = 400_000
BOUNCES: Final = 10
SPLIT_M: Final = 0.02
"""A cell has no more depth than this."""
NEAREST: Final = 9
"""Cells between which a camera pixel's light is interpolated."""
TURN_M: Final = 0.02
"""A turn of the normal by one radian counts as so far away."""


@dataclass(frozen=True, slots=True)
class TracedTransfer:
    """Irradiance that comes back, for what each projector sends out.

    ``parts``: for each projector and channel (cells, groups of its pixels); ``group``: pixels along a group's side;
    ``blend`` (pixels, cells): of ``Samples.pixels`` the cells that they take their light from
    """

    parts: tuple[tuple[sparse.csr_matrix, ...], ...]
    group: tuple[int, ...]
    blend: sparse.csr_matrix

    def light(self, sent: Sequence[FloatImage | None]) -> FloatImage:
        """Irradiance (pixels, 3) for what the pixels (rows, columns, 3) of each projector send out; None: nothing."""
        cells = np.zeros((self.blend.shape[1], 3), dtype=np.float32)
        for parts, side, image in zip(self.parts, self.group, sent, strict=True):
            if image is not None:
                means = grouped(image, side)
                for channel, part in enumerate(parts):
                    cells[:, channel] += part @ means[:, channel]
        return np.asarray(self.blend @ cells, dtype=np.float32)

    def arrays(self) -> dict[str, npt.NDArray[Any]]:
        """See ``plugins.emulated.optics.indirect.transfers.LightTransfer``."""
        arrays = {"group": np.array(self.group)}
        for n, part in enumerate(self.parts):
            for channel, matrix in enumerate(part):
                arrays |= sparse_arrays(f"part{n}{channel}", matrix)
        return arrays | sparse_arrays("blend", self.blend)

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, npt.NDArray[Any]]) -> Self:
        """As above."""
        group = tuple(int(side) for side in arrays["group"])
        parts = tuple(
            tuple(sparse_matrix(arrays, f"part{n}{channel}") for channel in range(3)) for n in range(len(group))
        )
        return cls(parts, group, sparse_matrix(arrays, "blend"))

    @classmethod
    def work_out(
        cls, truth: BenchTruth, thing: StageObject, pixels: npt.NDArray[np.int32], progress: Progress
    ) -> TracedTransfer:
        """As ``trace``, in a process of its own. Raises DeviceError ``engine-missing``, ``engine-failed``."""
        return traced_transfer(truth, thing, pixels, progress)


def grouped(image: FloatImage, side: int) -> FloatImage:
    """(groups, 3): the means of ``side`` x ``side`` pixels; at the right and lower edge of those that are left."""
    rows, columns = np.arange(0, image.shape[0], side), np.arange(0, image.shape[1], side)
    sums = np.add.reduceat(np.add.reduceat(image, rows, axis=0), columns, axis=1)
    high = np.minimum(rows + side, image.shape[0]) - rows
    wide = np.minimum(columns + side, image.shape[1]) - columns
    return np.asarray((sums / (high[:, None] * wide)[..., None]).reshape(-1, image.shape[2]), dtype=np.float32)


def trace(truth: BenchTruth, thing: StageObject, pixels: npt.NDArray[np.int32], progress: Progress) -> TracedTransfer:
    """Trace ``truth.paths`` paths from each cell; ``pixels``: ``Samples.pixels``.

    Use ``traced_transfer``, which does this in a process of its own. Raises DeviceError ``engine-missing``.
    """
    scene = scene_of(thing, truth.surfaces)
    rng = np.random.default_rng([truth.seed, 6])
    group = tuple(max(1, round(p.lens.size_px[0] / PIXELS_ACROSS)) for p in truth.projectors)
    at_once = max(1, PATHS_AT_ONCE // truth.paths)
    blocks: list[list[list[sparse.csr_matrix]]] = []
    traced = MitsubaScene(scene)
    cells = _cells(truth, traced, pixels)
    for first in range(0, cells.count, at_once):
        last = min(first + at_once, cells.count)
        blocks.append(_block(truth, scene, traced, cells, np.arange(first, last), group, rng))
        progress(last / cells.count)
    parts = tuple(
        tuple(sparse.vstack([block[n][channel] for block in blocks]).tocsr() for channel in range(3))
        for n in range(len(truth.projectors))
    )
    return TracedTransfer(parts, group, cells.blend())


@dataclass(frozen=True, slots=True)
class _Cells:
    """``points``, ``normals`` (pixels, 3): what each pixel sees; ``order``, ``starts``: the pixels of each cell."""

    points: Floats
    normals: Floats
    order: Integers
    starts: Integers

    @property
    def count(self) -> int:
        return len(self.starts) - 1

    def draw(self, cells: Integers, paths: int, rng: np.random.Generator) -> tuple[Floats, Floats]:
        """Points and normals, ``paths`` for each of these cells, of any of its pixels."""
        begin, end = self.starts[cells], self.starts[cells + 1]
        # One after another, so that every pixel gives as many.
        turn = (np.arange(paths)[None] + rng.random((len(cells), 1))) / paths
        pixel = self.order[np.minimum(begin[:, None] + (turn * (end - begin)[:, None]), end[:, None] - 1).astype(int)]
        return self.points[pixel.ravel()], self.normals[pixel.ravel()]

    def blend(self) -> sparse.csr_matrix:
        """(pixels, cells): smooth weights of the nearest cells that face as a pixel does, 1 in sum."""
        from scipy.spatial import cKDTree

        count = np.diff(self.starts)[:, None]
        centres, facing = (
            np.add.reduceat(values[self.order], self.starts[:-1]) / count for values in (self.points, self.normals)
        )
        tree = cKDTree(np.concatenate([centres, TURN_M * facing], axis=1))
        places = np.concatenate([self.points, TURN_M * self.normals], axis=1)
        nearest = tree.query(places, k=np.arange(1, min(NEAREST, self.count) + 1), workers=-1)
        away, cell = np.asarray(nearest[0], np.float64), np.asarray(nearest[1], np.int64)
        weight = (1.0 - (away / (1.001 * away[:, -1:] + 1e-12)) ** 2) ** 2
        weight /= weight.sum(axis=1, keepdims=True)
        rows = np.repeat(np.arange(len(places)), cell.shape[1])
        whole = sparse.csr_matrix((weight.ravel(), (rows, cell.ravel())), shape=(len(places), self.count))
        return whole.astype(np.float32)


def _cells(truth: BenchTruth, traced: MitsubaScene, pixels: npt.NDArray[np.int32]) -> _Cells:
    width = truth.camera.lens.size_px[0]
    row, column = np.divmod(pixels.astype(np.int64), width)
    points, normals = np.zeros((len(row), 3)), np.zeros((len(row), 3))
    missed = np.arange(len(row))
    for dx, dy in ((0.0, 0.0), (-0.4, -0.4), (0.4, 0.4), (-0.4, 0.4), (0.4, -0.4)):
        rays = directions(truth.camera.pose, truth.camera.lens, column[missed] + dx, row[missed] + dy)
        hits = traced.hit(np.broadcast_to(np.asarray(truth.camera.pose.position_m), rays.shape), rays)
        points[missed[hits.ray]], normals[missed[hits.ray]] = hits.points, hits.normals
        missed = np.setdiff1d(missed, missed[hits.ray])
    side = max(1, round(width / CELLS_ACROSS))
    block = (row // side) * width + column // side
    depth = np.floor(np.linalg.norm(points - truth.camera.pose.position_m, axis=1) / SPLIT_M).astype(np.int64)
    turned = np.round(normals).astype(np.int64) @ (1, 3, 9) + 13
    cell = np.unique((block * 4096 + depth % 4096) * 27 + turned, return_inverse=True)[1].reshape(-1)
    order = np.argsort(cell, kind="stable")
    return _Cells(points, normals, order, np.searchsorted(cell[order], np.arange(int(cell.max()) + 2)))


def _block(
    truth: BenchTruth,
    scene: Scene,
    traced: MitsubaScene,
    cells: _Cells,
    mine: Integers,
    group: tuple[int, ...],
    rng: np.random.Generator,
) -> list[list[sparse.csr_matrix]]:
    """For each projector and channel the rows of these cells."""
    points, normals = cells.draw(mine, truth.paths, rng)
    row = np.repeat(np.arange(len(mine)), truth.paths)
    through = np.full((len(row), 3), 1.0 / truth.paths)
    entries: list[list[tuple[Any, ...]]] = [[] for _ in truth.projectors]
    for _ in range(BOUNCES):
        met = traced.leave(points, normals, _diffuse(normals, rng))
        row, points, normals = row[met.ray], met.points, met.normals
        through = through[met.ray] * scene.albedo(points, met.faces, met.weights)
        for n, projector in enumerate(truth.projectors):
            at, gain = arriving(projector, traced.hidden, points, normals)
            width, height = projector.lens.size_px
            x, y = np.floor(at + 0.5).astype(np.int64).T
            lit = np.flatnonzero((gain > 0.0) & (x >= 0) & (x < width) & (y >= 0) & (y < height))
            place = (y[lit] // group[n]) * (-(-width // group[n])) + x[lit] // group[n]
            entries[n].append((row[lit], place, through[lit] * gain[lit, None]))
    return [
        _matrices(part, len(mine), -(-p.lens.size_px[0] // side) * -(-p.lens.size_px[1] // side))
        for part, p, side in zip(entries, truth.projectors, group, strict=True)
    ]


def _matrices(part: list[tuple[Any, ...]], rows: int, columns: int) -> list[sparse.csr_matrix]:
    """(rows, columns) for each channel; entries at one place are added up."""
    row, place, weight = (np.concatenate([bounce[n] for bounce in part]) for n in range(3))
    key, back = np.unique(row * columns + place, return_inverse=True)
    where = (key // columns, key % columns)
    sums = [np.bincount(back.reshape(-1), weights=weight[:, c], minlength=len(key)) for c in range(3)]
    return [sparse.csr_matrix((one.astype(np.float32), where), shape=(rows, columns)) for one in sums]


def _diffuse(normals: Floats, rng: np.random.Generator) -> Floats:
    """Directions (N, 3) about normals, as many as the cosine to them."""
    root, turn = rng.random(len(normals)), 2.0 * np.pi * rng.random(len(normals))
    helper = np.where(np.abs(normals[:, :1]) < 0.9, (1.0, 0.0, 0.0), (0.0, 1.0, 0.0))
    first = np.cross(normals, helper)
    first /= np.maximum(np.linalg.norm(first, axis=1, keepdims=True), 1e-12)
    second = np.cross(normals, first)
    sine = np.sqrt(root)[:, None]
    around = sine * (np.cos(turn)[:, None] * first + np.sin(turn)[:, None] * second)
    return np.asarray(around + np.sqrt(1.0 - root)[:, None] * normals)


POLL_S: Final = 0.5


def traced_transfer(
    truth: BenchTruth, thing: StageObject, pixels: npt.NDArray[np.int32], progress: Progress
) -> TracedTransfer:
    """As ``trace``. Raises DeviceError ``engine-missing``, ``engine-failed``."""
    ours, theirs = multiprocessing.Pipe()
    process = multiprocessing.get_context("spawn").Process(
        target=_run, args=(theirs, truth, thing, pixels), daemon=True
    )
    process.start()
    theirs.close()
    done = 0.0
    try:
        while True:
            while not ours.poll(POLL_S):
                progress(done)
            message = ours.recv()
            if isinstance(message, TracedTransfer):
                return message
            if isinstance(message, dict):
                raise DeviceError(**message)
            progress(done := message)
    except EOFError as error:
        raise DeviceError("engine-failed", what="Mitsuba ended without a result.", remedy=REMEDY) from error
    finally:
        process.terminate()
        process.join()
        ours.close()


def _run(parent: Connection, truth: BenchTruth, thing: StageObject, pixels: npt.NDArray[np.int32]) -> None:
    try:
        parent.send(trace(truth, thing, pixels, parent.send))
    except DeviceError as error:
        parent.send({"code": error.code, "what": error.what, "remedy": error.remedy})
