"""The camera's lens from boards that this test renders itself, ray by ray, through a lens that it bends itself."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from controller.core.errors import CalibrationError, UsageError, WorkError
from controller.optics.calibrate.geometry.intrinsics import CameraIntrinsics, read_intrinsics, write_intrinsics
from controller.optics.calibrate.geometry.lenses import (
    SQUARES,
    BoardView,
    board_picture,
    calibrate_views,
    find_corners,
    intrinsics_from_exif,
)
from controller.optics.capture.raw import raw_size
from tests.controller.optics.capture.test_raw import write_dng

Grey = npt.NDArray[np.uint8]
SIZE = (776, 520)
FOCAL, CENTRE, K1, K2 = 1100.0, (391.5, 255.0), -0.09, 0.01
TILTS = ((25, 0), (-25, 5), (5, 28), (-5, -28), (20, 20), (-20, -20), (22, -18), (0, 2))


@functools.cache
def ray_through(dx: float, dy: float) -> npt.NDArray[np.float64]:
    """Of each pixel, at this place in it: before the lens bends it."""
    column, row = np.meshgrid(np.arange(SIZE[0]) + dx, np.arange(SIZE[1]) + dy)
    bent = np.stack([column - CENTRE[0], row - CENTRE[1]], axis=2) / FOCAL
    flat = bent
    for _ in range(30):
        r2 = np.sum(flat**2, axis=2, keepdims=True)
        flat = bent / (1 + K1 * r2 + K2 * r2**2)
    return np.concatenate([flat, np.ones((*flat.shape[:2], 1))], axis=2)


@functools.cache
def printed_board() -> npt.NDArray[np.float32]:
    return board_picture(2200).astype(np.float32)


def photograph(tilt_x: float, tilt_y: float, *, noise: float = 2.0, seed: int = 0) -> Grey:
    """The printed board as a camera sees it: 2 x 2 rays a pixel, traced to the board's plane."""
    rng = np.random.default_rng([seed, int(tilt_x) + 100, int(tilt_y) + 100])
    paper = printed_board()
    scale = (SQUARES[0] + 1) / paper.shape[1]
    turn = cv2.Rodrigues(np.radians([tilt_x, tilt_y, rng.uniform(-15, 15)]))[0]
    middle = np.array([rng.uniform(-1, 1), rng.uniform(-0.7, 0.7), 20.0 + rng.uniform(-1, 3)])
    offsets = (np.arange(2) + 0.5) / 2 - 0.5
    grey = np.zeros(SIZE[::-1], dtype=np.float32)
    for dx in offsets:
        for dy in offsets:
            ray = ray_through(dx, dy)
            reach = (turn[:, 2] @ middle) / (ray @ turn[:, 2])
            on_board = (ray * reach[..., None] - middle) @ turn
            x = on_board[..., 0] / scale + (paper.shape[1] - 1) / 2
            y = on_board[..., 1] / scale + (paper.shape[0] - 1) / 2
            grey += cv2.remap(paper, x.astype(np.float32), y.astype(np.float32), cv2.INTER_LINEAR, borderValue=180.0)
    return np.asarray(np.clip(20 + 0.8 * grey / 4 + rng.normal(0, noise, grey.shape), 0, 255), dtype=np.uint8)


@pytest.fixture(scope="module")
def found() -> CameraIntrinsics:
    views = [find_corners(photograph(*tilt)) for tilt in TILTS]
    return calibrate_views([view for view in views if view is not None], SIZE)


def test_the_lens_of_the_photographs_is_found_within_its_sigmas(found: CameraIntrinsics) -> None:
    focal, cx, cy, _ = found.sigmas
    assert abs(np.log(found.focal_px / FOCAL)) < min(4 * focal, 0.002)
    assert abs(found.centre_px[0] - CENTRE[0]) < min(4 * cx, 3.0)
    assert abs(found.centre_px[1] - CENTRE[1]) < min(4 * cy, 3.0)
    assert found.k1 == pytest.approx(K1, abs=0.02)
    assert focal < 0.002
    assert found.views == len(TILTS)
    assert found.rms_px < 0.3


def test_the_lens_comes_back_from_its_file(found: CameraIntrinsics, tmp_path: Path) -> None:
    write_intrinsics(tmp_path / "lens.toml", found)
    again = read_intrinsics(tmp_path / "lens.toml")
    assert (again.size_px, again.focal_px, again.centre_px, again.k1) == (
        found.size_px,
        found.focal_px,
        found.centre_px,
        found.k1,
    )
    np.testing.assert_array_equal(again.covariance, found.covariance)
    prior = again.prior(distance_m=1.2)
    assert prior.focal_length_px == found.focal_px
    assert prior.focal_length_rel_sigma == pytest.approx(found.sigmas[0])
    assert (prior.distance_m, prior.distortion_k1, prior.size_px) == (1.2, found.k1, SIZE)


def test_a_lens_with_more_terms_comes_back_from_its_file(tmp_path: Path) -> None:
    covariance = np.diag(np.arange(1.0, 9.0) * 1e-6)
    lens = CameraIntrinsics(SIZE, FOCAL, CENTRE, K1, covariance, "charuco", other_terms=(0.1, 0.002, -0.003, 0.05))
    write_intrinsics(tmp_path / "lens.toml", lens)
    again = read_intrinsics(tmp_path / "lens.toml")
    assert again.other_terms == lens.other_terms == again.prior().other_terms
    np.testing.assert_array_equal(again.covariance, covariance)


def corners(
    tilts: list[tuple[float, float]],
    seed: int = 1,
    *,
    bent: tuple[float, ...] = (K1, 0, 0, 0),
    aspect: float = 1.0,
    stretched: float = 1.0,
) -> list[BoardView]:
    """Views by OpenCV's own projection, with a tenth of a pixel of noise."""
    rng = np.random.default_rng(seed)
    grid = np.stack(np.meshgrid(np.arange(1, SQUARES[0]), np.arange(1, SQUARES[1])), axis=2).reshape(-1, 2)
    board = np.concatenate([grid, np.zeros((len(grid), 1))], axis=1).astype(np.float32)
    matrix = np.array([[FOCAL, 0, CENTRE[0]], [0, FOCAL * aspect, CENTRE[1]], [0, 0, 1]])
    printed = board * np.array([stretched, 1, 1], np.float32)
    views = []
    for tilt in tilts:
        move = np.array([-5.5, -4.0, 22.0]) + rng.normal(0, 0.5, 3)
        px, _ = cv2.projectPoints(printed, np.radians([*tilt, rng.uniform(-9, 9)]), move, matrix, np.array(bent))
        views.append(BoardView(board, (px.reshape(-1, 2) + rng.normal(0, 0.1, (len(grid), 2))).astype(np.float32)))
    return views


def test_the_covariance_is_what_repeated_sessions_scatter_by() -> None:
    sessions = [calibrate_views(corners(list(TILTS), seed), SIZE) for seed in range(40)]
    logs = np.log([session.focal_px for session in sessions])
    expected = float(np.median([session.sigmas[0] for session in sessions]))
    assert np.std(logs) == pytest.approx(expected, rel=0.4)
    assert np.mean(np.abs(logs - np.log(FOCAL)) < 2 * expected) > 0.85


def test_a_wrong_corner_does_no_harm() -> None:
    views = corners(list(TILTS))
    views[0].seen_px[7] += 9.0
    assert calibrate_views(views, SIZE).focal_px == pytest.approx(FOCAL, rel=0.003)


def test_a_photograph_without_a_board_has_no_corners_and_two_views_are_too_few() -> None:
    blank = np.full(SIZE[::-1], 90, dtype=np.uint8)
    assert find_corners(blank) is None
    with pytest.raises(CalibrationError) as refused:
        calibrate_views(corners(list(TILTS[:2])), SIZE)
    assert refused.value.code == "camera-too-few-views"


def test_parallel_views_are_refused_as_such() -> None:
    with pytest.raises(CalibrationError) as refused:
        calibrate_views(corners([(x, 1.0) for x in (0.0, 1.0, 2.0, 0.5, 1.5, -1.0)]), SIZE)
    assert refused.value.code == "camera-views-parallel"


def test_corners_that_no_lens_explains_are_refused() -> None:
    rng = np.random.default_rng(2)
    views = [BoardView(v.board, (v.seen_px + rng.normal(0, 12, v.seen_px.shape)).astype(np.float32)) for v in corners(
        list(TILTS)
    )]  # fmt: skip
    with pytest.raises(CalibrationError) as refused:
        calibrate_views(views, SIZE)
    assert refused.value.code in ("camera-fit-poor", "camera-too-few-views")


KINDS: dict[str, dict[str, Any]] = {
    "k2": {"bent": (-0.3, 2.0, 0, 0)},
    "tangential": {"bent": (K1, 0, 0.004, -0.006)},
    "aspect": {"aspect": 1380 / 1300},
    "stretched": {"stretched": 1.02},
    "stretched, and aspect": {"stretched": 1.02, "aspect": 0.98},
}


@pytest.mark.parametrize("kind", KINDS)
def test_a_lens_gets_the_terms_that_the_pictures_ask_for_with_right_sigmas(kind: str) -> None:
    settings = KINDS[kind]
    found = calibrate_views(corners([*TILTS, *TILTS], **settings), SIZE)
    terms = settings.get("bent", (K1, 0, 0, 0))
    right = np.array([np.log(FOCAL), *CENTRE, *terms, np.log(settings.get("aspect", 1.0))])
    values = np.array([np.log(found.focal_px), *found.centre_px, found.k1, *found.other_terms])
    assert np.all(np.abs(values - right)[: len(found.sigmas)] < 3 * found.sigmas)
    assert found.sigmas[0] < 0.001
    named = ("k2", "tangential", "tangential", "aspect")
    assert {name for name, value in zip(named, found.other_terms, strict=True) if value} == {
        name for name in named if name in kind or (name == "aspect" and "stretched" in kind)
    }


@pytest.mark.parametrize("much", [0.02, 0.1, 1.0])
def test_photographs_that_were_turned_are_refused_or_have_larger_sigmas(much: float) -> None:
    views = corners([*TILTS, *TILTS])
    last = np.array(SIZE) - 1 + 30 * much
    views[::2] = [BoardView(view.board, (last - view.seen_px).astype(np.float32)) for view in views[::2]]
    refused = ""
    try:
        found = calibrate_views(views, SIZE)
    except CalibrationError as error:
        refused = error.code
    if refused:
        assert refused == "camera-lens-unlike"
        assert much > 0.02
    else:
        assert abs(np.log(found.focal_px / FOCAL)) < 4 * found.sigmas[0]


def test_a_board_that_is_always_upright_does_not_tell_pixels_that_are_not_square_from_its_own_stretch() -> None:
    grid = corners([(0, 0)])[0].board
    matrix, views = np.array([[FOCAL, 0, CENTRE[0]], [0, 1.05 * FOCAL, CENTRE[1]], [0, 0, 1]]), []
    for x, y in TILTS:
        turn = cv2.Rodrigues(np.radians([x, 0.0, 0.0]))[0] @ cv2.Rodrigues(np.radians([0.0, y, 0.0]))[0]
        px, _ = cv2.projectPoints(grid, cv2.Rodrigues(turn)[0], np.array([-5.5, -4.0, 22.0]), matrix, np.zeros(4))
        noise = np.random.default_rng(x + 50).normal(0, 3.0, (len(grid), 2))
        views.append(BoardView(grid, (px.reshape(-1, 2) + noise).astype(np.float32)))
    with pytest.raises(CalibrationError, match="not square, or the board"):
        calibrate_views(views, SIZE)


LENS = (1300.0, 1305.0, 610.0, 390.0, -0.12, 0.03, 0.001, -0.0005)


@pytest.mark.parametrize("name", ["cv.yml", "cv.xml", "cv.json", "ros.yaml", "cameras.txt"])
def test_lens_files_of_other_programs_are_read(tmp_path: Path, name: str) -> None:
    fx, fy, cx, cy, *bent = LENS
    matrix, path = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), tmp_path / name
    if name.startswith("cv"):
        file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
        file.write("image_width", 1200)
        file.write("image_height", 800)
        file.write("camera_matrix", matrix)
        file.write("distortion_coefficients", np.array([[*bent, 0.0]]))
        file.release()
    elif name.startswith("ros"):
        path.write_text(
            "image_width: 1200\nimage_height: 800\ncamera_name: cam\n"
            f"camera_matrix:\n  rows: 3\n  cols: 3\n  data: {matrix.ravel().tolist()}\n"
            "distortion_model: plumb_bob\n"
            f"distortion_coefficients:\n  rows: 1\n  cols: 5\n  data: {[*bent, 0]}\n"
        )
    else:
        path.write_text(
            f"# Camera list\n1 OPENCV 1200 800 {fx} {fy} {cx + 0.5} {cy + 0.5} {' '.join(map(str, bent))}\n"
        )
    found = read_intrinsics(path)
    assert found.size_px == (1200, 800)
    k2, p1, p2, log_aspect = found.other_terms
    np.testing.assert_allclose(
        [found.focal_px, found.focal_px * np.exp(log_aspect), *found.centre_px, found.k1, k2, p1, p2], LENS, rtol=1e-6
    )
    assert len(found.sigmas) == 8


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("a.json", '{"image_width": 1200, "image_height": 800, "camera_matrix": [[1300, 0, 610], [0, 1300, 390], '
                   '[0, 0, 1]], "dist_coeffs": [[-0.1, 0.02, 0, 0, 0]]}'),
        ("a.yaml", "image_width: 1200\nimage_height: 800\nK: [1300, 0, 610, 0, 1300, 390, 0, 0, 1]\n"
                   "distortion_model: rational_polynomial\nD: [-0.1, 0.02, 0, 0, 0, 0, 0, 0]\n"),
        ("a.txt", "1 FULL_OPENCV 1200 800 1300 1300 610.5 390.5 -0.1 0.02 0 0 0 0 0 0\n"),
    ],
)  # fmt: skip
def test_lens_files_may_nest_their_lists_and_have_terms_that_are_zero(tmp_path: Path, name: str, text: str) -> None:
    (tmp_path / name).write_text(text)
    found = read_intrinsics(tmp_path / name)
    np.testing.assert_allclose(
        [found.focal_px, *found.centre_px, found.k1, found.other_terms[0]], [1300, 610, 390, -0.1, 0.02], rtol=1e-6
    )


def test_a_third_radial_term_is_explained_by_the_others_within_their_sigmas(tmp_path: Path) -> None:
    terms = (-0.2, 0.1, 0.0, 0.0, -0.06)
    matrix = [1300, 0, 610, 0, 1300, 390, 0, 0, 1]
    (tmp_path / "a.yaml").write_text(
        f"image_width: 1200\nimage_height: 800\nK:\n  data: {matrix}\nD:\n  data: {list(terms)}\n"
    )
    found = read_intrinsics(tmp_path / "a.yaml")
    k2, p1, p2, _ = found.other_terms
    rays = np.random.default_rng(3).uniform((-0.45, -0.29), (0.44, 0.3), (500, 2))
    points = np.concatenate([rays, np.ones((500, 1))], axis=1)
    ours = np.array([[found.focal_px, 0, found.centre_px[0]], [0, found.focal_px, found.centre_px[1]], [0, 0, 1]])
    theirs, nearest = (
        cv2.projectPoints(points, np.zeros(3), np.zeros(3), one, np.array(bend))[0].reshape(-1, 2)
        for one, bend in ((np.reshape(matrix, (3, 3)) * 1.0, terms), (ours, [found.k1, k2, p1, p2]))
    )
    assert np.max(np.abs(theirs - nearest)) < 0.1
    assert abs(np.log(found.focal_px / 1300)) < found.sigmas[0]


@pytest.mark.parametrize(
    ("name", "text", "code"),
    [
        ("a.yml", "%YAML:1.0\n---\nimage_width: 3\n", "camera-intrinsics-unreadable"),
        ("a.yaml", "image_width: [", "camera-intrinsics-unreadable"),
        ("a.json", "{}", "camera-intrinsics-unreadable"),
        ("a.txt", "1 FISHEYE 1200 800 1 2 3 4\n", "camera-intrinsics-unreadable"),
        ("a.txt", "1 OPENCV 1200 800 1300\n", "camera-intrinsics-unreadable"),
        (
            "a.yaml",
            "image_width: 12\nimage_height: 8\nK: [13, 1, 6, 0, 13, 4, 0, 0, 1]\nD: [0, 0, 0, 0]\n",
            "camera-intrinsics-unreadable",
        ),
        ("a.txt", "1 OPENCV 1200 800 1300 1300 600 400 -3 0 0 0\n", "camera-lens-unlike"),
        ("a.txt", "1 SIMPLE_PINHOLE 1200 800 1300 61000 400\n", "camera-intrinsics-invalid"),
    ],
)
def test_lens_files_that_are_no_lens_here_are_refused(tmp_path: Path, name: str, text: str, code: str) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(UsageError) as refused:
        read_intrinsics(tmp_path / name)
    assert refused.value.code == code


@pytest.mark.parametrize(("wrong", "right"), [("distortion_k1", "distorsion_k1"), ("[391.5", "[61000.0")])
def test_a_misspelt_key_and_a_centre_far_outside_are_refused(tmp_path: Path, wrong: str, right: str) -> None:
    lens = CameraIntrinsics(SIZE, FOCAL, CENTRE, K1, np.diag([1e-6, 1.0, 1.0, 1e-4]), "charuco")
    write_intrinsics(tmp_path / "lens.toml", lens)
    assert "k2" not in (tmp_path / "lens.toml").read_text()
    text = (tmp_path / "lens.toml").read_text()
    (tmp_path / "lens.toml").write_text(text.replace(wrong, right))
    with pytest.raises(UsageError) as refused:
        read_intrinsics(tmp_path / "lens.toml")
    assert refused.value.code == "camera-intrinsics-invalid"


def jpeg(path: Path, tags: Mapping[int, object]) -> Path:
    from PIL import Image

    exif = Image.Exif()
    exif.get_ifd(0x8769).update(tags)
    Image.new("L", (388, 260)).save(path, exif=exif)
    return path


def test_exif_gives_the_focal_length_by_the_sensors_pitch_or_by_its_35_mm_equivalent(tmp_path: Path) -> None:
    from PIL.TiffImagePlugin import IFDRational

    pitch = {0x920A: IFDRational(35), 0xA20E: IFDRational(3888000, 877), 0xA210: 2}
    found = intrinsics_from_exif(jpeg(tmp_path / "a.jpg", pitch))
    assert found.focal_px == pytest.approx(35 / 25.4 * 3888000 / 877)
    assert (found.method, found.size_px) == ("exif", (388, 260))
    assert found.sigmas[0] == pytest.approx(0.03)
    found = intrinsics_from_exif(jpeg(tmp_path / "b.jpg", {0xA405: 50}))
    assert found.focal_px == pytest.approx(50 / 43.267 * np.hypot(388, 260))


@pytest.mark.parametrize("per_inch", [3888000 / 877, 44330.0, 500.0])
def test_a_density_that_contradicts_the_focal_length_on_35_mm_film_does_not_count(
    tmp_path: Path, per_inch: float
) -> None:
    from PIL.TiffImagePlugin import IFDRational

    by_film = 35 * 1.5 / 43.267 * np.hypot(388, 260)
    tags = {0x920A: IFDRational(35), 0xA20E: IFDRational(per_inch), 0xA210: 2, 0xA405: 35 * 1.5}
    found = intrinsics_from_exif(jpeg(tmp_path / "a.jpg", tags))
    assert found.focal_px == pytest.approx(by_film, rel=0.001)
    assert found.sigmas[0] == pytest.approx(0.15)


def test_a_raw_file_has_the_size_of_what_libraw_develops(tmp_path: Path) -> None:
    write_dng(tmp_path / "a.dng", np.full((400, 600), 500, np.uint16))
    assert raw_size(tmp_path / "a.dng") == (600, 400)


def test_a_photograph_that_tells_nothing_is_refused(tmp_path: Path) -> None:
    with pytest.raises(CalibrationError) as refused:
        intrinsics_from_exif(jpeg(tmp_path / "c.jpg", {}))
    assert refused.value.code == "camera-focal-length-unknown"
    (tmp_path / "d.jpg").write_bytes(b"not a picture")
    with pytest.raises(WorkError) as unreadable:
        intrinsics_from_exif(tmp_path / "d.jpg")
    assert unreadable.value.code == "photograph-unreadable"


@pytest.mark.parametrize(
    ("text", "code"),
    [
        ("focal = [", "camera-intrinsics-unreadable"),
        ("width_px = 3", "camera-intrinsics-invalid"),
        ("width_px = 3\nheight_px = 2\nprincipal_point_px = [1, true]", "camera-intrinsics-invalid"),
        ("width_px = 3\nheight_px = 2\nprincipal_point_px = [1, 1]\ncovariance = [[1]]", "camera-intrinsics-invalid"),
    ],
)
def test_a_damaged_file_is_refused_with_the_key(tmp_path: Path, text: str, code: str) -> None:
    (tmp_path / "lens.toml").write_text(text)
    with pytest.raises(UsageError) as refused:
        read_intrinsics(tmp_path / "lens.toml")
    assert refused.value.code == code
    with pytest.raises(UsageError) as missing:
        read_intrinsics(tmp_path / "none.toml")
    assert missing.value.code == "camera-intrinsics-missing"
