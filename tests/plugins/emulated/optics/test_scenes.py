"""Built-in objects as the camera sees them: their shapes against formulas, their paint against files."""

from __future__ import annotations

import dataclasses
import importlib
import io
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from PIL import Image

from hal.deadline import in_seconds
from hal.errors import PluginError
from hal.registry import OpenContext
from plugins.emulated.bench import DRIVER
from plugins.emulated.core.truth import BenchTruth, read_truth
from plugins.emulated.optics.rays import Samples, cast
from plugins.emulated.optics.world import object_of

Floats = npt.NDArray[np.float64]


@dataclasses.dataclass(frozen=True)
class Seen:
    """A stage of few pixels, and what its camera sees: ``points`` (P, 3) and ``albedo`` (P, 3) of each pixel."""

    folder: Path
    truth: BenchTruth
    samples: Samples

    @property
    def points(self) -> Floats:
        """Of the object alone, without a wall."""
        return self.samples.points[self.samples.on_object].astype(np.float64)

    @property
    def albedo(self) -> Floats:
        """Of pixels that see nothing but the object."""
        return np.add.reduceat(self.samples.albedo, self.samples.starts[:-1])[self.samples.on_object].astype(np.float64)

    def lit(self, projector: int) -> npt.NDArray[np.bool_]:
        """(P,): pixels of the object that it lights, all of them."""
        return np.minimum.reduceat(self.samples.gain[projector], self.samples.starts[:-1])[self.samples.on_object] > 0


@pytest.fixture(scope="module")
def seen(tmp_path_factory: pytest.TempPathFactory, shrink: Callable[[BenchTruth], BenchTruth]) -> Callable[[str], Seen]:
    def of(name: str) -> Seen:
        folder = tmp_path_factory.mktemp(name)
        bench = DRIVER.open({"object": name}, OpenContext(stage=folder), in_seconds(5))
        bench.prepare(folder, size="small", object_file=None, seed=7)
        truth = shrink(read_truth(folder))
        # With a camera in focus, samples carry their points.
        truth = dataclasses.replace(truth, camera=dataclasses.replace(truth.camera, focus_m=1.0))
        return Seen(folder, truth, cast(truth, object_of(folder, truth.object), lambda share: None))

    return of


def test_a_sphere_and_a_cylinder_are_round(seen: Callable[[str], Seen]) -> None:
    ball, column = seen("sphere").points, seen("cylinder").points
    # the mean of a pixel's points lies a little inside, at the outline more so
    assert np.percentile(np.abs(np.linalg.norm(ball, axis=1) - 0.14), 90) < 1.5e-4
    assert np.percentile(np.abs(np.hypot(column[:, 0], column[:, 2]) - 0.10), 90) < 1.5e-4
    assert np.ptp(column[:, 1]) == pytest.approx(0.28, abs=0.01)


def test_a_corner_is_two_planes_at_110_degrees_that_open_towards_the_audience(seen: Callable[[str], Seen]) -> None:
    points = seen("corner").points
    sides = [points[sign * points[:, 0] > 0.01] for sign in (-1, 1)]
    normals = []
    for side in sides:
        middle = side.mean(axis=0)
        *_, normal = np.linalg.svd(side - middle, full_matrices=False)[2]
        assert np.abs((side - middle) @ normal).max() < 1e-5
        normals.append(normal if normal[2] < 0 else -normal)
    assert np.degrees(np.arccos(normals[0] @ normals[1])) == pytest.approx(180 - 110, abs=0.1)
    assert points[np.abs(points[:, 0]) < 0.02, 2].mean() > points[np.abs(points[:, 0]) > 0.16, 2].mean() + 0.1


def test_a_relief_is_five_millimetres_deep(seen: Callable[[str], Seen]) -> None:
    assert 0.004 < np.ptp(seen("relief").points[:, 2]) <= 0.005


def test_each_of_two_objects_is_lit_by_projectors_of_its_own(seen: Callable[[str], Seen]) -> None:
    both = seen("two-objects")
    right = both.points[:, 0] > 0
    assert [one.name for one in both.truth.projectors] == ["left", "right", "far-left", "far-right"]
    shares = [(both.lit(n)[~right].mean(), both.lit(n)[right].mean()) for n in range(4)]
    assert all(shares[n][n % 2] > 0.6 > 0.25 > shares[n][1 - n % 2] for n in range(4)), shares


def test_a_painting_shows_its_original_faded_in_a_frame_that_throws_a_shadow(seen: Callable[[str], Seen]) -> None:
    hung = seen("painting")
    assert len(hung.truth.projectors) == 2
    assert [surface.name for surface in hung.truth.surfaces] == ["wall"]
    points, front = hung.points, hung.points[:, 2].min()
    within = (np.abs(points[:, 0]) < 0.145) & (np.abs(points[:, 1]) < 0.115)
    canvas = points[within]
    assert np.ptp(canvas[:, 2]) < 1e-6
    assert canvas[0, 2] - front == pytest.approx(0.012, abs=5e-4)
    wall = hung.truth.surfaces[0].corner_m[2]
    assert wall - front == pytest.approx(0.016 + 5e-4, abs=5e-4)
    # the picture that its restorer has lies on the canvas, edge to edge
    original = np.asarray(Image.open(hung.folder / "original.png"), np.float64) / 255
    light = np.where(original <= 0.04045, original / 12.92, ((original + 0.055) / 1.055) ** 2.4)
    rows, columns = light.shape[:2]
    x = np.rint((canvas[:, 0] / 0.30 + 0.5) * columns - 0.5).astype(int)
    y = np.rint((canvas[:, 1] / 0.24 + 0.5) * rows - 0.5).astype(int)
    blocks = np.stack([light[j - 5 : j + 6, i - 5 : i + 6].mean(axis=(0, 1)) for i, j in zip(x, y, strict=True)])
    for channel in range(3):
        assert np.corrcoef(blocks[:, channel], hung.albedo[within][:, channel])[0, 1] > 0.95
    assert np.ptp(blocks, axis=0).min() > 2.5 * np.ptp(hung.albedo[within], axis=0).max()
    # the frame's lip, 10 mm before the canvas, hides its left edge from the left projector
    lamp = hung.truth.projectors[0].pose.position_m
    hidden_m = 0.010 * (-0.15 - lamp[0]) / (front + 0.002 - lamp[2])
    assert 0.003 < hidden_m < 0.007
    beside = (np.abs(points[:, 1]) < 0.08) & (np.abs(points[:, 2] - canvas[0, 2]) < 1e-4)
    from_edge, lit = points[beside, 0] + 0.15, hung.lit(0)[beside]
    assert lit[(from_edge > hidden_m + 0.004) & (from_edge < 0.29)].all()
    assert not lit[from_edge < hidden_m - 0.001].any()
    assert hung.lit(1)[beside][from_edge < hidden_m].mean() > 0.5


def test_a_statue_comes_with_a_scan_and_a_sheet_of_its_old_colours(seen: Callable[[str], Seen]) -> None:
    bust = seen("statue")
    thing = object_of(bust.folder, bust.truth.object)
    trimesh: Any = importlib.import_module("trimesh")  # its functions carry no types
    scan = trimesh.load(bust.folder / "statue.glb", force="mesh", process=False)
    mine = trimesh.Trimesh(thing.vertices * np.array((1.0, -1.0, -1.0)), thing.faces, process=False)
    assert scan.area == pytest.approx(mine.area, rel=1e-5)
    np.testing.assert_allclose(scan.extents, mine.extents, atol=1e-6)
    sheet = Image.open(io.BytesIO((bust.folder / "colours.png").read_bytes()))
    painted = np.asarray(scan.visual.material.baseColorTexture.convert("RGB"), np.float64)
    assert sheet.size == (painted.shape[1], painted.shape[0])
    # where the sheet has a red shirt, the statue has one, too: it looks out of the same place of the scan
    colours = np.asarray(sheet, np.float64)
    assert np.corrcoef(colours.mean(axis=2).ravel(), painted.mean(axis=2).ravel())[0, 1] > 0.9
    uv, at = np.asarray(scan.visual.uv), scan.vertices
    shirt, head = uv[at[:, 1] < 0.05, 1], uv[at[:, 1] > 0.25, 1]
    assert shirt.max() < head.min()


def test_an_object_that_the_bench_has_not_is_refused_with_all_that_it_has(tmp_path: Path) -> None:
    for name in ("vase", "Painting", "", ["painting"], 3):
        with pytest.raises(PluginError, match="painting, relief, statue, corner, cylinder, sphere, two-") as refused:
            DRIVER.open({"object": name}, OpenContext(stage=tmp_path), in_seconds(5))
        assert refused.value.code == "setting-wrong"


def test_what_the_camera_sees_of_a_painting_is_enough_to_lay_its_original_on_it(
    seen: Callable[[str], Seen], tmp_path: Path
) -> None:
    from controller.optics.solve.targets.files import read_picture
    from controller.optics.solve.targets.registration import register

    hung = seen("painting")
    truth = read_truth(hung.folder)
    camera = dataclasses.replace(truth.camera, focus_m=1.0)
    truth = dataclasses.replace(truth, subsamples=1, camera=camera, projectors=truth.projectors[:1])
    samples = cast(truth, object_of(hung.folder, truth.object), lambda share: None)
    width, height = camera.lens.size_px
    own = np.full((height * width, 3), np.nan, np.float32)
    own[samples.pixels] = samples.albedo * (1 + 0.01 * np.random.default_rng(1).standard_normal(samples.albedo.shape))
    picture = read_picture(hung.folder / "original.png")[..., :3]
    found = register(picture, own.reshape(height, width, 3))
    x, y = samples.points[:, 0], samples.points[:, 1]
    on_canvas = samples.on_object & (np.abs(x) < 0.148) & (np.abs(y) < 0.118)
    at = np.stack([(x / 0.30 + 0.5) * 1125 - 0.5, (y / 0.24 + 0.5) * 900 - 0.5], axis=-1)[on_canvas]
    off = np.linalg.norm(found.position_px.reshape(-1, 2)[samples.pixels[on_canvas]] - at, axis=1)
    off /= np.sqrt(1125 * 900 / on_canvas.sum())  # in camera pixels
    assert np.nanmedian(off) < 0.5
    assert np.nanpercentile(off, 95) < 2.0
    assert np.isfinite(off).mean() > 0.95
