"""Several views of a run as one: the same units, one solve, and results for each view."""

from __future__ import annotations

import dataclasses
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from controller.core.errors import UsageError
from controller.kiosk.jobs.failover import Survivors
from controller.optics.calibrate.geometry.shape import FoundShape
from controller.optics.calibrate.geometry.values import Reconstruction
from controller.optics.calibrate.mesh_alignment import Pose
from controller.optics.calibrate.photometry.view_colours import in_common_units, view_gains
from controller.optics.calibrate.values import Calibration, Geometry, Pinhole
from controller.optics.solve.request import SolveOptions
from controller.optics.solve.targets.values import Target, connected
from controller.run.journal import Journal
from controller.run.progress import Silent
from controller.run.runner import Runner
from controller.stage.artefacts.calibrated import AllViews, Calibrated, all_views, share_above
from controller.stage.artefacts.geometry import write_geometry, write_view_pose
from controller.stage.artefacts.projectors import Light, Pixels
from controller.stage.artefacts.solved import SolvedBase, is_solved, read_solved
from controller.stage.artefacts.views import view_folder, write_view
from controller.stage.report.galleries import views_gallery
from controller.stage.steps.appearance.solving import AppearanceRequest, solve_steps
from controller.stage.steps.calibrate.drift import changed_lamps
from hal.deadline import in_seconds
from hal.notices import Level
from lab.timings.tools.synthetic import NAMES, synthetic_calibration, write_synthetic_run

PROJECTOR = (14, 18)
CAMERAS = {"left": (36, 50), "right": (52, 70)}
GAIN = np.array([0.7, 1.9, 1.2], np.float32)


class Told(Silent):
    def __init__(self) -> None:
        self.said: list[str] = []

    def say(self, text: str, level: Level = Level.INFO) -> None:
        self.said.append(text)


def other_units(calibration: Calibration, matrix: np.ndarray) -> Calibration:
    """As a camera sees it whose colours are ``matrix`` (3, 3) times these."""
    parts = []
    for part in calibration.projectors:
        radiometry = part.radiometry
        level = (matrix @ radiometry.mixing).sum(axis=1)
        mixing = matrix @ radiometry.mixing / level[:, None]
        radiometry = dataclasses.replace(radiometry, mixing=mixing)
        parts.append(dataclasses.replace(part, white=(part.white * level).astype(np.float32), radiometry=radiometry))
    black = (calibration.black * matrix.sum(axis=1)).astype(np.float32)
    return dataclasses.replace(calibration, projectors=tuple(parts), black=black)


def two_views(run: Path, larger: int = 1) -> tuple[list[str], AllViews]:
    """The same object by two cameras in one place, one of them with more pixels and other units.

    All pictures are so many times ``larger``.
    """
    for number, (name, size) in enumerate(CAMERAS.items()):
        camera = larger * size[0], larger * size[1]
        folder = run if number == 0 else view_folder(run, name)
        folder.mkdir(parents=True, exist_ok=True)
        pixels = larger * PROJECTOR[0], larger * PROJECTOR[1]
        names = write_synthetic_run(folder, projector=pixels, camera=camera)
        if number:
            for projector in names:
                light = Light.read(folder, projector)
                changed = dataclasses.replace(light, white=light.white * GAIN, black=light.black * GAIN)
                changed.write(folder, projector)
        write_view(folder, name, number)
    made = all_views(run, names)
    assert isinstance(made, AllViews)
    return names, made


def test_colour_differences_are_measured_on_the_overlap_and_removed(tmp_path: Path) -> None:
    first = synthetic_calibration(projector=(40, 52), camera=(100, 140))
    matrix = np.diag([0.5, 1.4, 0.9]) @ np.array([[0.9, 0.1, 0.0], [0.05, 0.9, 0.05], [0.0, 0.15, 0.85]])
    second = other_units(synthetic_calibration(projector=(40, 52), camera=(150, 210)), matrix)
    gains, lamps = view_gains([first, second])
    np.testing.assert_array_equal(lamps, 1)
    np.testing.assert_allclose(gains[0], 1, atol=1e-3)
    np.testing.assert_allclose(gains[1], 1 / matrix.sum(axis=1), rtol=0.02)
    common = in_common_units(second, gains[1], lamps[1], tmp_path)
    lit = [np.median(one.projectors[1].white[one.object_mask], axis=0) for one in (first, common)]
    np.testing.assert_allclose(lit[1], lit[0], rtol=0.04)


def test_views_that_share_nothing_stay_as_they_are() -> None:
    first = synthetic_calibration(projector=(20, 26), camera=(50, 70))
    parts = [dataclasses.replace(part, metapixels=dataclasses.replace(
        part.metapixels, valid=np.zeros_like(part.metapixels.valid))) for part in first.projectors]  # fmt: skip
    gains, _ = view_gains([first, dataclasses.replace(first, projectors=tuple(parts))])
    np.testing.assert_allclose(gains, 1, atol=1e-6)


def test_one_solve_is_right_from_both_sides_and_each_view_has_its_results(tmp_path: Path) -> None:
    names, calibrated = two_views(tmp_path)

    def target() -> Target:
        parts = [np.full((*camera, 3), 0.4, np.float32) for camera in CAMERAS.values()]
        return Target(
            calibrated.joined(parts), calibrated.joined([np.ones(size, np.bool_) for size in CAMERAS.values()])
        )

    with Journal(tmp_path) as journal:
        steps = solve_steps(calibrated, [AppearanceRequest("look", "Look", target, {})],
                            SolveOptions(0.9, 0.001), ())  # fmt: skip
        Runner(steps, journal, reporter=Silent()).run("appearance", deadline=in_seconds(120))
    for folder, camera in zip((tmp_path, view_folder(tmp_path, "right")), CAMERAS.values(), strict=True):
        solved, own = read_solved(folder, "look", names), Calibrated(folder, names)
        assert solved.target.shape == (*camera, 3)
        assert SolvedBase.read(folder, names).image.shape == (*camera, 3)
        frames = [solved.linear[name] for name in names]
        light = own.predicted_light(frames) + own.calibration.black
        off = np.abs(light - solved.target)[solved.reachable]
        assert np.median(off) < 0.06 * np.median(solved.target[solved.reachable])
    again = all_views(tmp_path, names)
    np.testing.assert_allclose(again.base.image, calibrated.base.image)


def solved_grey(calibrated: Calibrated, names: list[str]) -> list[float]:
    """By how much each view's light is off from an even target, relative."""
    shapes = [view.part(calibrated.transport.object_mask).shape for view in calibrated.views()]
    grey = Target(
        calibrated.joined([np.full((*shape, 3), 0.4, np.float32) for shape in shapes]),
        calibrated.joined([np.ones(shape, np.bool_) for shape in shapes]),
    )
    with Journal(calibrated.folder) as journal:
        request = AppearanceRequest("grey", "Grey", lambda: grey, {})
        steps = solve_steps(calibrated, [request], SolveOptions(0.9, 0.001), ())
        Runner(steps, journal, reporter=Silent()).run("appearance", deadline=in_seconds(120))
    off = []
    for folder in calibrated.folders:
        solved, own = read_solved(folder, "grey", names), Calibrated(folder, names)
        light = own.predicted_light([solved.linear[name] for name in names]) + own.calibration.black
        wanted = solved.target[solved.reachable]
        off.append(float(np.median(np.abs(light[solved.reachable] - wanted)) / np.median(wanted)))
    return off


def test_a_camera_that_makes_jpeg_files_only_spoils_no_view_of_one_with_raw_files(tmp_path: Path) -> None:
    names, raw = two_views(tmp_path / "raw")
    of_raw = solved_grey(raw, names)
    names, mixed = two_views(tmp_path / "mixed")
    right = view_folder(tmp_path / "mixed", "right")
    for name in names:
        # each of its pixels has three colours, in steps of 8 bits
        pixels, light = Pixels.read(right, name), Light.read(right, name)
        dataclasses.replace(pixels, mosaic=np.zeros((0, 0), np.int64)).write(right, name)
        levels = np.rint(255 * np.sqrt(light.white / light.white.max())) / 255
        dataclasses.replace(light, white=(levels**2 * light.white.max()).astype(np.float32)).write(right, name)
    alone, together = solved_grey(Calibrated(right, names), names), solved_grey(mixed, names)
    assert together[0] < 1.02 * of_raw[0]
    assert together[1] < 1.1 * alone[0]


def test_where_views_ask_for_different_colours_is_told_and_kept(tmp_path: Path) -> None:
    names, calibrated = two_views(tmp_path, 3)
    masks = [np.ones((3 * rows, 3 * columns), np.bool_) for rows, columns in CAMERAS.values()]
    grey = [np.full((*mask.shape, 3), 0.4, np.float32) for mask in masks]
    other = [image.copy() for image in grey]
    rows, columns = masks[1].shape
    there = np.s_[rows // 4 : rows // 2, columns // 4 : columns // 2]
    other[1][there] = 0.4 * np.array([1.3, 0.9, 0.6], np.float32)
    told, shares = Told(), []
    for name, images in (("alike", grey), ("apart", other)):
        with Journal(tmp_path) as journal:
            target = Target(calibrated.joined(images), calibrated.joined(masks))
            request = AppearanceRequest(name, name, partial(Target, target.image, target.mask), {})
            steps = solve_steps(calibrated, [request], SolveOptions(0.9, 0.001), ())
            Runner(steps, journal, reporter=told).run("appearance", deadline=in_seconds(120))
        shares.append(float(str(read_solved(tmp_path, name, names).figures["views_differ_share"])))
    assert shares[0] < 0.01, "too little to be told"
    assert 0.06 < shares[1] < 0.3, "a sixteenth of both, and what is near it"
    assert [line for line in told.said if "views ask" in line] == [
        f"apart: views ask for different colours on {shares[1]:.0%} of what several of them see, and get something "
        "between. `velatura report STAGE` shows where."
    ]
    with np.load(view_folder(tmp_path, "right") / "appearance-apart.npz") as kept:
        differs = kept["differs"]
    assert differs.shape == masks[1].shape
    assert np.nanmedian(differs[there]) > 3
    assert np.nanmedian(differs[rows // 2 + 36 :]) < 1
    text, pictures = views_gallery(tmp_path, names)[0][1:]
    assert len(pictures) == 3 * 2
    assert f"alike 0 %, apart {100 * shares[1]:.0f} %" in text


def test_a_highlight_that_one_view_sees_is_a_difference(tmp_path: Path) -> None:
    names, calibrated = two_views(tmp_path, 3)
    white = np.sum([part.white for part in calibrated.calibration.projectors], axis=0)
    mask = calibrated.calibration.object_mask
    usual = float(white.mean(axis=2)[mask].max())
    even = calibrated.differences(white, mask, usual)
    assert even is not None
    assert np.nanmedian(even) < 1
    box = calibrated.sheet.boxes()[1]
    place = np.s_[box.top + 60 : box.top + 96, 75:135]
    shining = white.copy()
    shining[place] *= 1.6
    found = calibrated.differences(shining, mask, usual)
    assert found is not None
    assert np.nanmedian(found[place]) > 3
    assert share_above(found) > share_above(even)
    assert Calibrated(tmp_path, names).differences(white, mask, usual) is None


def test_a_view_added_with_a_weaker_lamp_is_told_and_the_other_views_light_is_corrected(tmp_path: Path) -> None:
    names, _ = two_views(tmp_path)
    right = view_folder(tmp_path, "right")
    weaker = Light.read(right, names[1])
    dataclasses.replace(weaker, white=weaker.white * np.float32(0.9)).write(right, names[1])
    np.testing.assert_array_equal(all_views(tmp_path, names).lamps, 1)
    assert changed_lamps(tmp_path, names) == [], "both views were photographed at once"
    write_view(right, "right", 1, "20261206-120000")
    later = all_views(tmp_path, names)
    assert isinstance(later, AllViews)
    np.testing.assert_allclose(later.lamps, np.array([[1, 0.9, 1], [1, 1, 1]]), atol=0.01)
    own = Calibrated(tmp_path, names).calibration.projectors
    first = later.views()[0]
    for lamp, one, part in zip((1, 0.9, 1), own, later.calibration.projectors, strict=True):
        np.testing.assert_allclose(first.part(part.white), lamp * one.white, rtol=0.02, atol=1e-6)
    np.testing.assert_allclose(later.gains[1], 1 / GAIN, rtol=0.01)
    (said,) = changed_lamps(tmp_path, names)
    assert f"projector {names[1]} has 10% less light than when view left was photographed" in said


def test_what_was_solved_for_fewer_views_is_solved_again(tmp_path: Path) -> None:
    names, calibrated = two_views(tmp_path)
    one, folder = Calibrated(tmp_path, names), view_folder(tmp_path, "right")
    for of, sizes in ((one, [CAMERAS["left"]]), (calibrated, list(CAMERAS.values()))):
        grey = [np.full((*size, 3), 0.4, np.float32) for size in sizes]
        target = Target(of.joined(grey), of.joined([np.ones(size, np.bool_) for size in sizes]))
        with Journal(tmp_path) as journal:
            request = AppearanceRequest("look", "Look", partial(Target, target.image, target.mask), {})
            steps = solve_steps(of, [request], SolveOptions(0.9, 0.001), ())
            Runner(steps, journal, reporter=Silent()).run("appearance", deadline=in_seconds(120))
    assert is_solved(folder, "look")
    replaced = [dict(step.inputs) for step in solve_steps(calibrated, [], SolveOptions(0.9, 0.001), ())]
    (folder / "verification.json").write_text("{}")
    assert [dict(step.inputs) for step in solve_steps(calibrated, [], SolveOptions(0.9, 0.001), ())] != replaced


def test_views_that_become_whole_before_the_first_use_count(tmp_path: Path) -> None:
    early = AllViews(tmp_path, NAMES[:3])
    assert list(early.folders) == [tmp_path]
    two_views(tmp_path)
    assert early.names == ("left", "right")
    assert early.folders == (tmp_path, view_folder(tmp_path, "right"))
    assert len(early.views()) == 2


def test_one_view_is_read_as_ever(tmp_path: Path) -> None:
    names = write_synthetic_run(tmp_path, projector=PROJECTOR, camera=CAMERAS["left"])
    assert type(all_views(tmp_path, names)) is Calibrated


def test_solutions_without_a_projector_stay_beside_those_with_all(tmp_path: Path) -> None:
    names = write_synthetic_run(tmp_path, projector=PROJECTOR, camera=CAMERAS["left"])
    (own := tmp_path / "without").mkdir()
    grey = Target(np.full((*CAMERAS["left"], 3), 0.3, np.float32), np.ones(CAMERAS["left"], np.bool_))
    survivors, request = Survivors(tmp_path, names[1:], own), AppearanceRequest("look", "Look", lambda: grey, {})
    with Journal(own) as journal:
        steps = solve_steps(survivors, [request], SolveOptions(0.9, 0.001), ())
        Runner(steps, journal, reporter=Silent()).run("takeover", deadline=in_seconds(120))
    assert is_solved(own, "look")
    assert not is_solved(tmp_path, "look")


def test_views_without_a_common_place_are_refused_where_the_shape_counts(tmp_path: Path) -> None:
    _, calibrated = two_views(tmp_path)
    with pytest.raises(UsageError) as refused:
        _ = calibrated.geometry
    assert refused.value.code == "shape-unknown"


def test_all_views_stand_in_the_frame_of_the_first_camera(tmp_path: Path) -> None:
    names, calibrated = two_views(tmp_path)
    turn, shift_m = np.array([[0.0, 0, -1], [0, 1, 0], [1, 0, 0]]), np.array([0.1, 0.2, 1.5])
    point_m = np.array([0.3, -0.1, 2.0])
    for n, folder in enumerate(calibrated.folders):
        rows, columns = CAMERAS[list(CAMERAS)[n]]
        own = turn @ point_m + shift_m if n else point_m
        points, sigma_m = np.full((rows, columns, 3), own, np.float32), np.ones((rows, columns), np.float32)
        poses = tuple(Pinhole(np.eye(3), np.zeros(2), np.eye(3), np.full(3, 10.0 * n + k), (30, 20)) for k in range(3))
        camera = Pinhole(np.eye(3), np.zeros(2), np.eye(3), np.zeros(3), (columns, rows))
        geometry = Geometry(camera, poses[: len(names)], points, points, 0.1, True)
        sure = Reconstruction(geometry, np.eye(1), ("x",), 0.1, 0.1, 0.1, 1.0, 0.9, sigma_m)
        write_geometry(folder, names, FoundShape("surface", (columns, rows), sure))
        write_view_pose(folder, Pose(1.0, turn, shift_m) if n else Pose(1.0, np.eye(3), np.zeros(3)))
    first, second = calibrated.geometries()
    np.testing.assert_allclose(second.points_m, np.full_like(second.points_m, point_m), atol=1e-6)
    assert [one.translation_m[0] for one in second.projectors] == [one.translation_m[0] for one in first.projectors]
    assert [one.translation_m[0] for one in first.projectors] == [0.0, 1.0, 2.0][: len(names)]
    np.testing.assert_allclose(second.camera.rotation @ point_m + second.camera.translation_m, turn @ point_m + shift_m)


def test_parts_of_two_views_are_one_object_where_they_meet_in_space() -> None:
    points = np.full((20, 30, 3), np.nan, np.float32)
    y, x = np.mgrid[:20, :10].astype(np.float32)
    for start, shift in ((0, 0.0), (10, 5.0), (20, 40.0)):
        points[:, start : start + 10] = np.stack([x + shift, y, 0 * x], -1)
    parts = [np.zeros((20, 30), np.bool_) for _ in range(3)]
    for n, part in enumerate(parts):
        part[:, 10 * n : 10 * n + 10] = True
    objects = connected(parts, points)
    assert [int(one.sum()) for one in objects] == [400, 200]


def test_a_pose_after_another_places_as_both() -> None:
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    one, other = Pose(2.0, turn, np.array([1.0, 2, 3])), Pose(1.0, turn.T, np.array([-1.0, 0, 2]))
    points = np.random.default_rng(0).normal(size=(5, 3))
    np.testing.assert_allclose(one.then(other).placed(points), other.placed(one.placed(points)))
