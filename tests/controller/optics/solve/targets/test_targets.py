"""Targets on shapes with known answers: a sphere, a cylinder, a wall."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import OpenEXR
import pytest
import skimage.data
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from controller.core.arrays import FloatImage, Mask
from controller.core.colour import linear_to_srgb, srgb_to_linear
from controller.core.errors import UsageError, WorkError
from controller.optics.calibrate.values import Geometry, Pinhole
from controller.optics.solve.targets.files import load_target, read_large_picture, shipped_photograph
from controller.optics.solve.targets.patterns import CheckerboardLook, PatternLook, checkerboard, replace_pattern
from controller.optics.solve.targets.relight import GlossLook, gloss, recolour
from controller.optics.solve.targets.values import Target, in_box, through_camera
from controller.optics.solve.targets.wrap import PrintLook, object_space, wrap_photograph

ROWS, COLUMNS, FOCAL = 160, 240, 400.0
Array = npt.NDArray[np.float64]


def seen_from_camera(depth: Array, normals: Array) -> tuple[Geometry, Mask]:
    x, y = np.meshgrid((np.arange(COLUMNS) - 119.5) / FOCAL, (np.arange(ROWS) - 79.5) / FOCAL)
    points = np.stack([x * depth, y * depth, depth], axis=2)
    mask = np.isfinite(depth)
    normals = np.where(mask[..., None], normals, np.nan)
    matrix = np.array([[FOCAL, 0, 119.5], [0, FOCAL, 79.5], [0, 0, 1]])
    camera = Pinhole(matrix, np.zeros(2), np.eye(3), np.zeros(3), (COLUMNS, ROWS))
    return Geometry(camera, (), points.astype(np.float32), normals.astype(np.float32), 0.1, True), mask


def quadric(radius_m: float, *, upright: bool) -> tuple[Geometry, Mask]:
    """A sphere, or an upright cylinder, around (0, 0, 1 m)."""
    x, y = np.meshgrid((np.arange(COLUMNS) - 119.5) / FOCAL, (np.arange(ROWS) - 79.5) / FOCAL)
    rays = np.stack([x, 0 * y if upright else y, np.ones_like(x)], axis=2)
    a, b, c = np.sum(rays**2, axis=2), -2.0, 1.0 - radius_m**2
    inside = b * b - 4 * a * c
    depth = np.where(inside > 0, (-b - np.sqrt(np.maximum(inside, 0))) / (2 * a), np.nan)
    normals = (depth[..., None] * rays - np.array([0, 0, 1])) / radius_m
    return seen_from_camera(depth, normals)


def wall() -> tuple[Geometry, Mask]:
    return seen_from_camera(np.ones((ROWS, COLUMNS)), np.broadcast_to([0.0, 0.0, -1.0], (ROWS, COLUMNS, 3)))


def edges(line: FloatImage) -> Array:
    """Positions where a line crosses the middle between its darkest and brightest value, between pixels."""
    level = line.astype(np.float64) - (line.min() + line.max()) / 2
    k = np.flatnonzero(np.sign(level[:-1]) * np.sign(level[1:]) < 0)
    return np.asarray(k + level[k] / (level[k] - level[k + 1]))


def test_the_highlight_of_a_sphere_lies_where_the_normal_halves_light_and_view() -> None:
    geometry, mask = quadric(0.12, upright=False)
    light = np.array([-0.4, -0.5, -1.0]) / np.linalg.norm([-0.4, -0.5, -1.0])
    target = gloss(
        geometry,
        mask,
        GlossLook(light_direction=(-0.4, -0.5, -1.0), base_colour=(0.1, 0.1, 0.1), shininess=200, smoothing_px=0),
    )
    brightest = np.unravel_index(int(np.argmax(target.image[..., 0])), mask.shape)
    point = geometry.points_m[brightest].astype(np.float64)
    half = light - point / np.linalg.norm(point)
    expected = np.array([0, 0, 1]) + 0.12 * half / np.linalg.norm(half)
    px = expected[:2] / expected[2] * FOCAL + [119.5, 79.5]
    assert np.hypot(*(px - [brightest[1], brightest[0]])) < 1.0
    dark = gloss(geometry, mask, GlossLook(light_direction=(0, 0, 1), base_colour=(0.5, 0.2, 0.1), ambient=0.4))
    np.testing.assert_allclose(dark.image[80, 120], [0.2, 0.08, 0.04], rtol=1e-5)


def test_a_checkerboards_squares_have_their_size_on_the_cylinder() -> None:
    geometry, mask = quadric(0.15, upright=True)
    target = checkerboard(geometry, mask, CheckerboardLook(square_m=0.02))
    row = 90
    columns = edges(np.where(mask[row], target.image[row, :, 0], np.nan)[30:-30]) + 30
    x = np.interp(columns, np.arange(COLUMNS), geometry.points_m[row, :, 0].astype(np.float64))
    arc = 0.15 * np.arcsin(x / 0.15)
    np.testing.assert_allclose(np.diff(arc), 0.02, atol=8e-4)  # a quarter of a slanted pixel on either side
    middle = 130
    rows = edges(target.image[:, middle, 0])
    height = np.interp(rows, np.arange(ROWS), geometry.points_m[:, middle, 1].astype(np.float64))
    np.testing.assert_allclose(np.diff(height), 0.02, atol=8e-4)


def test_a_wall_is_mapped_as_a_plane_though_a_cylinder_was_asked_for() -> None:
    geometry, mask = wall()
    space = object_space(geometry, mask)
    assert np.isinf(space.radius_m)
    np.testing.assert_allclose(np.diff(space.across_m[10]), 1 / FOCAL, rtol=1e-3)
    np.testing.assert_allclose(np.diff(space.up_m[:, 10]), -1 / FOCAL, rtol=1e-3)


def test_a_cylinders_axis_and_radius_are_found_from_its_front() -> None:
    geometry, mask = quadric(0.15, upright=True)
    space = object_space(geometry, mask)
    assert space.radius_m == pytest.approx(0.15, rel=1e-3)
    x = geometry.points_m[80, :, 0][mask[80]].astype(np.float64)
    np.testing.assert_allclose(space.across_m[80][mask[80]], 0.15 * np.arcsin(x / 0.15), atol=1e-3)


def test_a_photograph_on_a_wall_is_the_photograph() -> None:
    geometry, mask = wall()
    rng = np.random.default_rng(1)
    photo = cv2.GaussianBlur(rng.random((ROWS, COLUMNS, 3)).astype(np.float32), (0, 0), 3).astype(np.float32)
    target = wrap_photograph(photo, geometry, mask, PrintLook(ink=0, paper=1))
    # 99 % of the wall's extent take the whole photograph, so it is 1 % smaller than pixel for pixel
    inner = (slice(40, -40), slice(60, -60))
    assert np.abs(target.image[inner] - photo[inner]).mean() < 0.02
    assert np.corrcoef(target.image[inner].ravel(), photo[inner].ravel())[0, 1] > 0.95
    assert np.corrcoef(target.image[inner].ravel(), photo[:, ::-1][inner].ravel())[0, 1] < 0.5


def test_fine_detail_is_averaged_and_does_not_alias() -> None:
    geometry, mask = wall()
    photo = np.zeros((2400, 3600, 3), dtype=np.float32)
    photo[::2, 1::2] = photo[1::2, ::2] = 1.0
    target = wrap_photograph(photo, geometry, mask, PrintLook(ink=0, paper=1))
    np.testing.assert_allclose(target.image[20:-20, 20:-20], 0.5, atol=0.05)
    checks = checkerboard(geometry, mask, CheckerboardLook(square_m=0.01, colours=((1, 1, 1), (0, 0, 0))))
    assert checks.image.mean() == pytest.approx(0.5, abs=0.02)


def test_shading_darkens_what_turns_away_and_only_that() -> None:
    geometry, mask = quadric(0.15, upright=True)
    white = np.ones((50, 50, 3), dtype=np.float32)
    flat = wrap_photograph(white, geometry, mask, PrintLook(paper=1))
    shaded = wrap_photograph(white, geometry, mask, PrintLook(paper=1, shading=0.5))
    assert np.all(flat.image[mask] == pytest.approx(1.0, abs=1e-5))
    assert shaded.image[80, 120, 0] == pytest.approx(1.0, abs=1e-3)
    assert 0.5 <= shaded.image[80][mask[80]].min() < 0.65


@pytest.mark.parametrize("kind", ["dots", "stripes"])
def test_a_pattern_covers_the_share_asked_for(kind: str) -> None:
    geometry, mask = wall()
    target = replace_pattern(
        geometry,
        mask,
        PatternLook(
            kind="dots" if kind == "dots" else "stripes", period_m=0.05, fill=0.25, body=(1, 1, 1), ink=(0, 0, 0)
        ),
    )
    assert 1 - target.image.mean() == pytest.approx(0.25, abs=0.02)
    plain = replace_pattern(geometry, mask, PatternLook(kind="plain", body=(0.6, 0.5, 0.4)))
    np.testing.assert_allclose(plain.image[80, 120], [0.6, 0.5, 0.4], rtol=1e-5)


def test_every_target_is_finite_in_range_and_black_off_the_object() -> None:
    geometry, mask = quadric(0.12, upright=False)
    holed = geometry.points_m.copy()
    holed[70:75, 100:105] = np.nan
    geometry = Geometry(geometry.camera, (), holed, geometry.normals, 0.1, True)
    made = [
        wrap_photograph(shipped_photograph(), geometry, mask, PrintLook(shading=0.3)),
        replace_pattern(geometry, mask),
        checkerboard(geometry, mask),
        gloss(geometry, mask),
        recolour(np.where(mask, 0.8, np.nan).astype(np.float32), mask, (1.0, 0.5, 0.2)),
    ]
    for target in made:
        assert target.image.shape == (ROWS, COLUMNS, 3)
        assert target.image.dtype == np.float32
        assert np.isfinite(target.image).all()
        assert target.image.min() >= 0.0
        assert target.image.max() <= 1.0
        assert not target.image[~target.mask].any()
        assert target.image[target.mask].max() > 0.1
        np.testing.assert_array_equal(target.mask, mask)


def test_an_object_without_known_positions_is_refused() -> None:
    geometry, mask = wall()
    blank = Geometry(geometry.camera, (), geometry.points_m * np.nan, geometry.normals, 0.1, True)
    with pytest.raises(WorkError) as refused:
        checkerboard(blank, mask)
    assert refused.value.code == "target-no-geometry"


@pytest.mark.parametrize("size", [0.0, -1.0, float("nan")])
def test_impossible_pattern_sizes_are_refused(size: float) -> None:
    with pytest.raises(UsageError) as refused:
        checkerboard(*wall(), look=CheckerboardLook(square_m=size))
    assert refused.value.code == "pattern-period-invalid"
    with pytest.raises(UsageError):
        replace_pattern(*wall(), look=PatternLook(fill=0.9))
    with pytest.raises(UsageError):
        gloss(*wall(), look=GlossLook(light_direction=(0, 0, 0)))


@settings(max_examples=30, deadline=None)
@given(hnp.arrays(np.float32, (4, 5, 3), elements=st.floats(0, 1, width=32)))
def test_srgb_goes_there_and_back(light: FloatImage) -> None:
    np.testing.assert_allclose(srgb_to_linear(linear_to_srgb(light)), light, atol=2e-6)


def test_srgb_has_its_published_values() -> None:
    encoded = np.array([0, 10, 128, 255], dtype=np.uint8)
    np.testing.assert_allclose(srgb_to_linear(encoded), [0, 0.003035, 0.215861, 1.0], rtol=1e-3)


def write_exr(path: Path, image: FloatImage) -> None:
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with OpenEXR.File(header, {"RGB": np.ascontiguousarray(image)}) as file:
        file.write(str(path))


def test_an_exr_is_linear_and_keeps_its_values(tmp_path: Path) -> None:
    image = np.random.default_rng(2).random((6, 8, 3)).astype(np.float32) * 3 - 0.1
    write_exr(tmp_path / "t.exr", image)
    target = load_target(tmp_path / "t.exr", (8, 6))
    np.testing.assert_array_equal(target.image, np.maximum(image, 0))
    assert target.mask.all()


@pytest.mark.parametrize("name", ["t.png", "t.jpg"])
def test_png_and_jpeg_are_srgb_in_rgb_order(tmp_path: Path, name: str) -> None:
    picture = np.zeros((16, 24, 3), dtype=np.uint8)
    picture[...] = (200, 100, 50)
    cv2.imwrite(str(tmp_path / name), picture[..., ::-1])
    target = load_target(tmp_path / name, (24, 16))
    np.testing.assert_allclose(target.image[8, 8], srgb_to_linear(picture[8, 8]), atol=0.01)


def test_a_sixteen_bit_png_with_alpha_masks_itself(tmp_path: Path) -> None:
    picture = np.full((4, 5, 4), 65535, dtype=np.uint16)
    picture[:2, :, 3] = 0
    cv2.imwrite(str(tmp_path / "t.png"), picture)
    target = load_target(tmp_path / "t.png", (5, 4))
    assert not target.mask[:2].any()
    assert target.mask[2:].all()
    np.testing.assert_allclose(target.image[2:], 1.0)
    assert not target.image[:2].any()


def test_a_wrong_size_names_both_sizes(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "t.png"), np.zeros((4, 5, 3), dtype=np.uint8))
    with pytest.raises(UsageError, match=r"5 x 4 .* 776 x 520") as refused:
        load_target(tmp_path / "t.png", (776, 520))
    assert refused.value.code == "target-wrong-size"


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_target_that_is_not_finite_is_refused(tmp_path: Path, value: float) -> None:
    image = np.zeros((4, 5, 3), dtype=np.float32)
    image[1, 2, 0] = value
    write_exr(tmp_path / "t.exr", image)
    with pytest.raises(UsageError, match="1 pixels") as refused:
        load_target(tmp_path / "t.exr", (5, 4))
    assert refused.value.code == "target-not-finite"


@pytest.mark.parametrize("name", ["t.png", "t.jpg", "t.exr", "t.bmp"])
@settings(max_examples=10, deadline=None)
@given(data=st.binary(max_size=300))
def test_bytes_that_are_no_picture_are_unreadable(
    tmp_path_factory: pytest.TempPathFactory, name: str, data: bytes
) -> None:
    path = tmp_path_factory.mktemp("bytes") / name
    path.write_bytes(data)
    with pytest.raises(UsageError) as refused:
        load_target(path, (8, 6))
    assert refused.value.code == "target-unreadable"


@pytest.mark.parametrize("name", ["t.png", "t.jpg", "t.exr"])
def test_a_file_cut_short_and_a_missing_one_are_unreadable(tmp_path: Path, name: str) -> None:
    image = np.random.default_rng(3).random((60, 80, 3)).astype(np.float32)
    if name.endswith("exr"):
        write_exr(tmp_path / name, image)
    else:
        cv2.imwrite(str(tmp_path / name), (image * 255).astype(np.uint8))
    data = (tmp_path / name).read_bytes()
    (tmp_path / name).write_bytes(data[: len(data) // 2])
    for path in (tmp_path / name, tmp_path / "missing" / name):
        with pytest.raises(UsageError) as refused:
            load_target(path, (80, 60))
        assert refused.value.code == "target-unreadable"


def test_a_picture_of_200_million_pixels_is_refused_with_the_size_that_is_possible(tmp_path: Path) -> None:
    whole = cv2.imencode(".png", np.zeros((1, 1, 3), np.uint8))[1].tobytes()
    header = b"IHDR" + struct.pack(">IIBBBBB", 16_000, 12_500, 8, 2, 0, 0, 0)
    (tmp_path / "large.png").write_bytes(
        whole[:8] + struct.pack(">I", 13) + header + struct.pack(">I", zlib.crc32(header)) + whole[33:]
    )
    with pytest.raises(UsageError) as refused:
        read_large_picture(tmp_path / "large.png", least_px=(1400, 1050))
    assert refused.value.code == "target-unreadable"
    assert "more than 128 million pixels" in refused.value.what
    assert "128 million pixels" in refused.value.remedy


def test_the_photograph_that_comes_with_the_installation_is_scikit_images() -> None:
    photo = shipped_photograph()
    assert photo.dtype == np.float32
    np.testing.assert_array_equal(photo, srgb_to_linear(skimage.data.astronaut()))  # type: ignore[no-untyped-call]


def test_what_goes_through_the_camera_keeps_flat_parts_and_softens_edges_inside_the_mask_only() -> None:
    mask = np.zeros((30, 40), np.bool_)
    mask[5:25, 5:35] = True
    image = np.zeros((30, 40, 3), np.float32)
    image[5:25, 5:20] = 0.2
    image[5:25, 20:35] = 0.8
    seen = through_camera(Target(image, mask))
    np.testing.assert_allclose(seen.image[6:24, 6:15], 0.2, atol=1e-4)
    np.testing.assert_allclose(seen.image[5:25, 5], 0.2, atol=1e-4)
    assert (seen.image[~mask] == 0).all()
    assert 0.3 < seen.image[15, 19, 0] < 0.5 < seen.image[15, 20, 0] < 0.7


def test_a_print_reflects_from_its_ink_to_its_paper() -> None:
    geometry, mask = wall()
    photo = np.zeros((20, 30, 3), dtype=np.float32)
    photo[:, 15:] = 1
    printed = wrap_photograph(photo, geometry, mask, PrintLook(ink=0.04, paper=0.85)).image[mask]
    assert printed.min() == pytest.approx(0.04, abs=1e-4)
    assert printed.max() == pytest.approx(0.85, abs=1e-4)
    with pytest.raises(UsageError) as refused:
        wrap_photograph(photo, geometry, mask, PrintLook(ink=0.9, paper=0.2))
    assert refused.value.code == "print-range-invalid"


@settings(max_examples=20, deadline=None)
@given(
    st.sampled_from([checkerboard, replace_pattern, gloss, partial(wrap_photograph, shipped_photograph())]),
    st.integers(0, 60), st.integers(80, 150), st.integers(0, 90), st.integers(120, 230), st.booleans(),
)  # fmt: skip
def test_a_target_of_an_objects_box_is_that_of_the_whole_picture(
    make: Callable[[Geometry, Mask], Target], top: int, bottom: int, left: int, right: int, upright: bool
) -> None:
    geometry, mask = quadric(0.15, upright=upright)
    mask[:top] = mask[bottom:] = mask[:, :left] = mask[:, right:] = False
    boxed, whole = in_box(geometry, mask, make), make(geometry, mask)
    assert np.array_equal(boxed.mask, whole.mask)
    np.testing.assert_allclose(boxed.image[mask], whole.image[mask], atol=1e-6)
    assert not boxed.image[~mask].any()
