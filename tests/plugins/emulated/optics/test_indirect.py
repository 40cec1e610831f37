"""Light between surfaces: the integrating sphere, a wall behind the object, and what is kept."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
import trimesh

from hal.errors import DeviceError
from plugins.emulated.bench import EmulatedBench
from plugins.emulated.core.tables import dump, load
from plugins.emulated.core.truth import BenchTruth, SurfaceTruth, read_truth
from plugins.emulated.optics.indirect.radiosity import Transfer, scattering_of, transfer_of
from plugins.emulated.optics.indirect.transfers import IndirectTransfers
from plugins.emulated.optics.layout import table_and_wall
from plugins.emulated.optics.objects import StageObject, corner_normals, scene_of
from plugins.emulated.optics.rays import cast
from plugins.emulated.optics.render import Renderer

ALBEDO = np.array([0.8, 0.5, 0.2])
RADIUS_M = 2.0


def sphere() -> StageObject:
    """Round all devices."""
    ball = trimesh.creation.icosphere(4, RADIUS_M)
    faces = np.asarray(ball.faces, np.int32)
    return StageObject(
        vertices=ball.vertices.astype(np.float32),
        faces=faces,
        normals=corner_normals(np.asarray(ball.vertices), faces),
        paint="corners",
        corner_values=np.broadcast_to(ALBEDO, (len(faces), 3, 3)).astype(np.float32),
        texture=np.zeros(0, np.float32),
        parts=np.zeros(1, np.int32),
    )


def white(truth: BenchTruth) -> list[npt.NDArray[np.uint8]]:
    return [np.full((*p.lens.size_px[::-1], 3), 255, np.uint8) for p in truth.projectors]


def ideal(truth: BenchTruth) -> BenchTruth:
    camera = dataclasses.replace(truth.camera, psf_sigma_px=0.0, vignetting=0.0)
    return dataclasses.replace(truth, engine="radiosity", ambient=(0.0, 0.0, 0.0), camera=camera)


def test_an_integrating_sphere_has_even_light_by_its_formula(
    tiny_truth: BenchTruth, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Many rays from few patches, so that chance counts for less than the tolerance.
    monkeypatch.setattr("plugins.emulated.optics.indirect.radiosity.RAYS", 4096)
    truth, thing = dataclasses.replace(ideal(tiny_truth), patches=200), sphere()
    samples = cast(truth, thing, lambda share: None)
    transfer = transfer_of(truth, scattering_of(thing, truth.patches, 1), samples.pixels)
    arrived, power = np.zeros((transfer.back.shape[2], 3), np.float32), np.zeros(3)
    for index, projector in enumerate(truth.projectors):
        light, (width, height) = projector.light, projector.lens.size_px
        y, x = np.mgrid[:height, :width]
        corner = (((x - (width - 1) / 2) / (width / 2)) ** 2 + ((y - (height - 1) / 2) / (height / 2)) ** 2) / 2
        sent = np.broadcast_to(np.array([1.0, 0.7, 0.4], np.float32), (height, width, 3))
        arrived += transfer.direct(index, sent)
        pixel = light.brightness * (light.reference_m / projector.lens.focal_px) ** 2
        power += pixel * (1.0 - light.vignetting * corner).sum() * np.array([1.0, 0.7, 0.4])
    returned = transfer.returned(arrived)
    wanted = power / (4.0 * np.pi * RADIUS_M**2) * ALBEDO / (1.0 - ALBEDO)
    np.testing.assert_allclose(returned.mean(axis=0), wanted, rtol=0.01)
    assert (returned.std(axis=0) < 0.1 * wanted).all()


@pytest.fixture(scope="module")
def roomy(tiny_truth: BenchTruth, vase_and_bust: StageObject) -> BenchTruth:
    return dataclasses.replace(ideal(tiny_truth), surfaces=table_and_wall(vase_and_bust), patches=400)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("bench")


@pytest.fixture(scope="module")
def indirect(folder: Path, vase_and_bust: StageObject) -> IndirectTransfers:
    return IndirectTransfers(vase_and_bust, folder)


def transfer_in(indirect: IndirectTransfers, truth: BenchTruth, thing: StageObject, shares: list[float]) -> Transfer:
    samples = cast(truth, thing, lambda share: None)
    found = indirect.transfer(truth, samples.pixels, shares.append, keep=True)
    assert isinstance(found, Transfer)
    return found


@pytest.mark.slow
def test_table_and_wall_light_the_object_in_their_colour(
    roomy: BenchTruth, vase_and_bust: StageObject, indirect: IndirectTransfers
) -> None:
    samples = cast(roomy, vase_and_bust, lambda share: None)
    transfer = transfer_in(indirect, roomy, vase_and_bust, [])
    levels = [1.0] * len(roomy.projectors)
    direct = Renderer(roomy, samples).light(white(roomy), levels)
    added = Renderer(roomy, samples, transfer).light(white(roomy), levels) - direct
    assert added.min() > 0.0
    alone = cast(dataclasses.replace(roomy, surfaces=()), vase_and_bust, lambda share: None)
    assert len(samples.pixels) == added[..., 0].size > len(alone.pixels)
    on_object = np.zeros(added.shape[:2], bool)
    on_object.ravel()[alone.pixels] = True
    assert 0.02 < np.median(added[on_object].sum(axis=1) / direct[on_object].sum(axis=1)) < 0.3
    halves = [Renderer(roomy, samples, transfer).light(white(roomy), [0.5 * level for level in levels])]
    np.testing.assert_allclose(2.0 * halves[0], direct + added, rtol=1e-4)


@pytest.mark.slow
def test_a_transfer_is_kept_for_the_very_stage(
    roomy: BenchTruth, vase_and_bust: StageObject, indirect: IndirectTransfers, folder: Path
) -> None:
    first = transfer_in(indirect, roomy, vase_and_bust, [])
    shares: list[float] = []
    again = transfer_in(IndirectTransfers(vase_and_bust, folder), roomy, vase_and_bust, shares)
    assert shares == [1.0]
    np.testing.assert_array_equal(first.back, again.back)
    assert abs(first.blend - again.blend).max() == 0.0
    wall = dataclasses.replace(roomy.surfaces[1], albedo=(0.1, 0.1, 0.1))
    darker = dataclasses.replace(roomy, surfaces=(roomy.surfaces[0], wall))
    assert transfer_in(indirect, darker, vase_and_bust, []).back.mean() < first.back.mean()


def test_a_stage_without_engine_has_no_transfer(tiny_truth: BenchTruth, vase_and_bust: StageObject) -> None:
    pixels = np.zeros(1, np.int32)
    assert IndirectTransfers(vase_and_bust, Path("/nowhere")).transfer(tiny_truth, pixels, print, keep=True) is None


def prepared(folder: Path, room: str) -> BenchTruth:
    EmulatedBench(room=room).prepare(folder / room, size="small", object_file=None, seed=4)
    truth = read_truth(folder / room)
    return dataclasses.replace(truth, camera=dataclasses.replace(truth.camera, command_port=0, event_port=0))


def test_rooms_differ_in_what_bench_toml_says_and_dark_says_nothing(tmp_path: Path) -> None:
    dark, room, hard = (prepared(tmp_path, name) for name in ("dark", "room", "hard"))
    assert (dark.surfaces, dark.engine, dark.camera.glare) == ((), "direct", 0.0)
    assert all(p.panels.aligned and not p.lamp.flicker and not p.light.white_segment for p in dark.projectors)
    assert [surface.name for surface in room.surfaces] == ["table", "wall"]
    assert (room.engine, room.projectors[0].lamp.flicker) == ("radiosity", 0.01)
    assert all(p.panels.aligned for p in room.projectors)
    assert hard.camera.sensor.shutter_spread > 0.0
    assert all(not p.panels.aligned and p.light.glare > 0.0 and p.light.white_segment for p in hard.projectors)
    assert hard.camera.spectral
    assert hard.camera.focus_m > 0.0
    assert hard.object.subsurface.share > 0.0
    assert all(p.dithering.levels > 1 for p in hard.projectors)
    assert all(any(p.lens.distortion) for p in hard.projectors)
    straight = [dataclasses.replace(p.lens, distortion=(0.0, 0.0)) for p in hard.projectors]
    assert straight == [p.lens for p in dark.projectors]
    same = [(p.pose, p.focus) for p in dark.projectors]
    assert all([(p.pose, p.focus) for p in other.projectors] == same for other in (room, hard))
    assert [p.lens for p in room.projectors] == [p.lens for p in dark.projectors]


def test_a_surface_of_no_use_is_refused() -> None:
    good = SurfaceTruth("wall", (0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.5, 0.5, 0.5))
    assert load(dump(good), SurfaceTruth, file="bench.toml") == good
    with pytest.raises(DeviceError, match=r"between 0 and 0\.95"):
        load(dump(good).replace("[0.5, 0.5, 0.5]", "[1.0, 0.5, 0.5]"), SurfaceTruth, file="bench.toml")
    with pytest.raises(DeviceError, match=r"'wall' in bench\.toml has no area"):
        scene_of(sphere(), (dataclasses.replace(good, along_m=good.across_m),))
