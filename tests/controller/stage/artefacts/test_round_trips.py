"""What is written of any stage is read back the same, whatever its projectors are called and in whatever order."""

from __future__ import annotations

import dataclasses
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from hypothesis import given, settings

from controller.core.arrays import load_arrays, save_arrays
from controller.core.errors import CalibrationError, UsageError
from controller.optics.calibrate.geometry.shape import FoundShape
from controller.optics.calibrate.geometry.values import Reconstruction
from controller.optics.calibrate.values import Geometry, Pinhole
from controller.optics.solve.bounded.equations import Solution
from controller.stage.artefacts.camera import Exposures
from controller.stage.artefacts.geometry import (
    ShapeRecord,
    camera_px,
    has_geometry,
    known_geometry,
    known_points_m,
    projectors_of,
    read_geometry,
    read_shape,
    require_shape,
    write_geometry,
)
from controller.stage.artefacts.grade import ErrorMaps, graded, read_error_maps, write_grade
from controller.stage.artefacts.photographs import DRIFT, PATTERN, VERIFICATION, PhotographSet, TakenPhotograph
from controller.stage.artefacts.projectors import Light, PixelFigures, Pixels
from controller.stage.artefacts.solved import Solved, SolvedBase, is_solved, read_solved, remove_solved
from tests.controller.stage.artefacts.names import projectors

if TYPE_CHECKING:
    pass

FEW = settings(max_examples=8, deadline=None)


def image(value: float) -> Any:
    return np.full((2, 3, 3), value, np.float32)


def light(value: float) -> Light:
    return Light(np.full((3, 256), value), np.eye(3), image(value), image(0), np.eye(3))


def same(one: Any, other: Any) -> bool:
    return all(
        np.array_equal(getattr(one, field.name), getattr(other, field.name)) for field in dataclasses.fields(one)
    )


@FEW
@given(projectors)
def test_what_was_measured_of_each_projector_is_its_own(names: list[str]) -> None:
    with tempfile.TemporaryDirectory() as place:
        run = Path(place)
        for number, name in enumerate(names):
            light(number).write(run, name)
            PixelFigures(number, number + 1, number + 2).write(run, name)
        Exposures.write(run, {name: Exposures(number, (1.0, number)) for number, name in enumerate(names)})
        for number, name in enumerate(names):
            assert same(Light.read(run, name), light(number))
            assert PixelFigures.read(run, name) == PixelFigures(number, number + 1, number + 2)
            assert Exposures.read(run)[name] == Exposures(number, (1.0, number))


@FEW
@given(projectors)
def test_photographs_are_found_by_projector_and_name(names: list[str]) -> None:
    with tempfile.TemporaryDirectory() as place:
        run = Path(place)
        for kept in (DRIFT, VERIFICATION):
            shot = [TakenPhotograph(PATTERN, run / f"{n}.dng", n + 1.0, projector=name) for n, name in enumerate(names)]
            shot += [TakenPhotograph(shown, run / f"{shown}.dng", 9.0) for shown in ("white", "black")]
            kept.write(run, shot)
            assert kept.read(run) == tuple(shot)
            assert {name: one.exposure_s for name, one in kept.by_projector(run).items()} == {
                name: n + 1.0 for n, name in enumerate(names)
            }
        for n, name in enumerate(names):
            for batch in (None, 0, 1):
                some = PhotographSet("dots", name, batch)
                some.write(run, [TakenPhotograph(f"{n}-{batch}", run / "a.dng", 1.0, projector=name)])
        for n, name in enumerate(names):
            for batch in (None, 0, 1):
                assert list(PhotographSet("dots", name, batch).by_name(run)) == [f"{n}-{batch}"]


@FEW
@given(projectors)
def test_error_maps_are_found_by_projector(names: list[str]) -> None:
    with tempfile.TemporaryDirectory() as place:
        run = Path(place)
        figures = {name: {"relative_rms": n / 100, "grade": "A"} for n, name in enumerate(names)}
        maps = {name: ErrorMaps(image(n), image(-n)) for n, name in enumerate(names)}
        write_grade(run, figures, maps, b"")
        found = read_error_maps(run)
        assert list(found) == names
        assert all(same(found[name], maps[name]) for name in names)
        assert graded(run) == pytest.approx({name: float(n) for n, name in enumerate(names)})


@FEW
@given(projectors)
def test_frames_are_found_by_projector_in_any_order(names: list[str]) -> None:
    with tempfile.TemporaryDirectory() as place:
        run = Path(place)
        frames = {name: np.full((2, 3, 3), n, np.uint8) for n, name in enumerate(names)}
        linear = {name: image(n / 10) for n, name in enumerate(names)}
        solved = Solved(frames, linear, image(5), np.ones((2, 3), bool), {"exposure": 2.0, "title": "Gold"})
        solved.write(run, "gold")
        solution = Solution(frames=tuple(linear.values()), objective=1.0, kkt=0.1, iterations=3,
                            seconds=0.5, converged=True)  # fmt: skip
        SolvedBase(image(6), solution).write(run, names)
        for order in (names, names[::-1]):
            found = read_solved(run, "gold", order)
            assert list(found.frames) == order
            assert all(np.array_equal(found.frames[name], frames[name]) for name in names)
            assert all(np.array_equal(found.linear[name], linear[name]) for name in names)
            assert (found.exposure, float(found.target[0, 0, 0])) == (2.0, 5.0)
            base = SolvedBase.read(run, order)
            assert all(np.array_equal(one, linear[name]) for one, name in zip(base.solution.frames, order, strict=True))
            assert float(base.image[0, 0, 0]) == 6.0
        remove_solved(run, "gold")
        assert not is_solved(run, "gold")


def pinhole(number: int) -> Pinhole:
    return Pinhole(np.eye(3) * (number + 1), np.zeros(2), np.eye(3), np.full(3, float(number)), (30, 20))


@FEW
@given(projectors)
def test_poses_are_found_by_projector_in_any_order(names: list[str]) -> None:
    with tempfile.TemporaryDirectory() as place:
        run = Path(place)
        poses = tuple(pinhole(n) for n in range(len(names)))
        geometry = Geometry(pinhole(9), poses, image(1), image(2), 0.1, True)
        sure = Reconstruction(geometry, np.eye(1), ("x",), 0.1, 0.1, 0.1, 1.0, 0.9, np.ones((2, 3), np.float32))
        write_geometry(run, names, FoundShape("surface", (30, 20), sure))
        assert projectors_of(run) == names
        found = read_geometry(run, names[::-1])
        assert [one.translation_m[0] for one in found.projectors] == [float(n) for n in range(len(names))][::-1]


def test_colours_that_lie_apart_are_kept_with_the_phase_map(tmp_path: Path) -> None:
    one = np.ones((2, 2), np.float32)
    apart = np.array([(0.3, 0.0), (0.0, 0.0), (-0.1, 0.25)])
    for colours_px in (apart, None):
        Pixels(one, one, one > 0, one, one, one > 0, one, one, None, colours_px).write(tmp_path, "left")
        found = Pixels.read(tmp_path, "left").phase_map
        assert found is not None
        np.testing.assert_array_equal(found.colours_px, colours_px)


def test_arrays_whose_names_end_like_files_are_told_apart(tmp_path: Path) -> None:
    save_arrays(tmp_path / "a.npz", {"x": image(1), "x.npy": image(2)})
    found = load_arrays(tmp_path / "a.npz")
    assert {name: float(array[0, 0, 0]) for name, array in found.items()} == {"x": 1.0, "x.npy": 2.0}


def test_a_run_without_a_shape_says_so_and_keeps_its_names_and_the_cameras_size(tmp_path: Path) -> None:
    sure = Reconstruction(
        Geometry(pinhole(9), (pinhole(1),), image(1), image(2), 0.1, True),
        np.eye(1), ("x",), 0.1, 0.1, 0.1, 1.0, 0.9, np.ones((2, 3), np.float32),
    )  # fmt: skip
    write_geometry(tmp_path, ["camera"], FoundShape("surface", (30, 20), sure))
    assert read_shape(tmp_path) == ShapeRecord("surface")
    assert has_geometry(tmp_path)
    flat = CalibrationError("scene-flat", what="It is flat.", remedy="Add depth.")
    write_geometry(tmp_path, ["camera"], FoundShape("unknown", (30, 20), why=flat))
    assert read_shape(tmp_path) == ShapeRecord("unknown", "scene-flat", "It is flat.", "Add depth.")
    assert not has_geometry(tmp_path)
    assert known_points_m(tmp_path) is None
    assert known_geometry(tmp_path) is None
    assert (projectors_of(tmp_path), camera_px(tmp_path)) == (["camera"], (30, 20))
    with pytest.raises(UsageError, match=r"A gloss needs the shape of the object.*It is flat") as refused:
        require_shape(tmp_path, "A gloss")
    assert (refused.value.code, refused.value.remedy) == ("shape-unknown", "Add depth.")
