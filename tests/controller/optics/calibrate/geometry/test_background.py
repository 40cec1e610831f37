"""The room behind and below an object is distinguished from it; an object alone is left whole."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from controller.optics.calibrate.geometry.background import room_beside_planes, room_pixels

ROWS, COLUMNS = 120, 180
Floats = npt.NDArray[np.float64]


def rays() -> Floats:
    y, x = np.mgrid[:ROWS, :COLUMNS]
    return np.stack(((x - 89.5) / 200.0, (y - 59.5) / 200.0, np.ones((ROWS, COLUMNS))), axis=-1)


def ball(middle: tuple[float, float, float], radius: float) -> Floats:
    """Distances along the rays; infinite beside it."""
    ray = rays()
    along, square = ray @ np.array(middle), (ray**2).sum(axis=2)
    root = along**2 - square * (np.dot(middle, middle) - radius**2)
    return np.where(root > 0, (along - np.sqrt(np.maximum(root, 0))) / square, np.inf)


def plane(normal: tuple[float, float, float], offset: float) -> Floats:
    away = offset / (rays() @ np.array(normal))
    return np.where(away > 0, away, np.inf)


def points(*surfaces: Floats) -> npt.NDArray[np.float32]:
    nearest = np.min(surfaces, axis=0)
    noise = 1.0 + 1e-4 * np.random.default_rng(1).standard_normal(nearest.shape)
    return np.where(np.isfinite(nearest)[..., None], rays() * (nearest * noise)[..., None], np.nan).astype(np.float32)


BALL = ball((0.03, 0.02, 1.0), 0.15)
TABLE = plane((0.0, 0.97, 0.24), 0.415)
WALL = plane((0.1, 0.05, 1.0), 1.4)


def test_table_and_wall_are_the_rooms_and_the_ball_is_not() -> None:
    found, on_ball = room_pixels(points(BALL, TABLE, WALL)), np.isfinite(BALL)
    assert found[on_ball].mean() < 0.03
    assert found[~on_ball].mean() > 0.98


@pytest.mark.parametrize("wave", [0.004, 0.008, 0.012])
def test_a_floor_whose_points_lie_in_waves_is_no_object_in_stripes(wave: float) -> None:
    rows = np.arange(ROWS)[:, None]
    floor = TABLE * (1 + wave * np.sin(2 * np.pi * rows / 14))
    found, on_ball = room_pixels(points(BALL, floor, WALL)), np.isfinite(BALL)
    assert found[~on_ball].mean() > 0.95
    assert found[on_ball].mean() < 0.05


def test_two_things_are_the_object_and_what_goes_on_beyond_the_picture_is_not() -> None:
    small, pillar = ball((-0.18, 0.05, 1.0), 0.06), ball((0.75, 0.0, 1.3), 0.25)
    found = room_pixels(points(BALL, small, pillar, TABLE, WALL))
    on_small, on_pillar = (
        np.isfinite(one) & (one < np.minimum(BALL, np.minimum(TABLE, WALL))) for one in (small, pillar)
    )
    assert found[on_small].mean() < 0.1
    assert on_pillar.sum() > 300
    assert found[on_pillar].mean() > 0.9


def test_a_wall_that_is_lit_in_the_middle_alone_does_not_end_the_search_for_the_table() -> None:
    y, x = np.mgrid[:ROWS, :COLUMNS]
    seen = points(BALL, TABLE, np.where((y > 8) & (x > 8) & (x < 171), WALL, np.inf))
    on_table = np.minimum(BALL, WALL) > TABLE
    assert room_pixels(seen)[on_table].mean() > 0.98


def test_shadows_without_points_go_with_what_is_beside_them() -> None:
    seen = points(BALL, TABLE, WALL)
    seen[20:60, 140:170] = np.nan
    assert room_pixels(seen)[20:60, 140:170].all()


@pytest.mark.parametrize("alone", [BALL, np.where(np.isfinite(BALL), WALL, np.inf)], ids=["ball", "flat"])
def test_an_object_before_nothing_is_left_whole_even_a_flat_one(alone: Floats) -> None:
    assert not room_pixels(points(alone)).any()


def test_round_things_that_fill_the_picture_are_no_room() -> None:
    assert not room_pixels(points(ball((0.0, 0.0, 1.5), 1.2))).any()


def test_a_wall_alone_is_the_object() -> None:
    assert not room_pixels(points(WALL)).any()
    assert not room_pixels(points(WALL, ball((0.0, 0.0, 1.4), 0.1))).any()


@pytest.mark.parametrize("wide", [8, 16])
def test_a_picture_in_its_frame_is_no_part_of_the_wall_that_it_almost_touches(wide: int) -> None:
    y, x = np.mgrid[:ROWS, :COLUMNS]
    outside, inside = (np.maximum(np.abs(x - 89.5) / 1.4, np.abs(y - 59.5)) < size for size in (48, 48 - wide))
    before = np.where(inside, 0.004, np.where(outside, 0.016, 0.0))
    found = room_pixels(points(WALL * (1.0 - before)))
    assert not found[(np.abs(y - 59.5) < 44) & (np.abs(x - 89.5) < 60)].any()
    assert found[~outside].mean() > 0.98


def test_a_wall_behind_a_handle_is_the_rooms() -> None:
    y, x = np.mgrid[:ROWS, :COLUMNS]
    away = np.hypot(x - 89.5, y - 59.5)
    handle = np.where((away < 36) & (away > 20), 1.1, np.inf)
    found = room_pixels(points(WALL, handle))
    assert found[away < 18].all()
    assert not found[(away > 22) & (away < 34)].any()


def board(*, wide: float = 0.5, turned: float = 0.1) -> npt.NDArray[np.bool_]:
    """Where a board ends that stands in the middle of the picture."""
    y, x = np.mgrid[:ROWS, :COLUMNS] / ROWS - 0.5
    return np.asarray((np.abs(x - 0.25 + turned * y) < wide) & (np.abs(y + 0.05) < 0.4))


def on_plane(where: npt.NDArray[np.bool_]) -> npt.NDArray[np.float32]:
    seen = points(plane((0.1, 0.05, 1.0), 1.0))
    return np.where(where[..., None], seen, np.nan).astype(np.float32)


def test_floor_and_wall_around_a_flat_board_are_the_rooms() -> None:
    here, lit = board(), np.ones((ROWS, COLUMNS), np.bool_)
    foot = np.zeros_like(here)
    # where the board's plane meets the floor
    foot[104:107] = True
    found = room_beside_planes(on_plane(here | foot), lit)
    assert found[~here].mean() > 0.98
    assert found[here].mean() < 0.01


def test_a_frame_and_a_dark_part_belong_to_a_flat_picture() -> None:
    here, lit = board(), np.ones((ROWS, COLUMNS), np.bool_)
    frame = cv2.dilate(here.astype(np.uint8), np.ones((7, 7), np.uint8)) > 0
    dark = here.copy()
    dark[40:60, 70:90] = False
    lit[~frame] = False
    assert not room_beside_planes(on_plane(dark), lit).any()


def test_a_mural_that_fills_the_picture_keeps_its_holes_at_the_border() -> None:
    here, lit = np.ones((ROWS, COLUMNS), np.bool_), np.ones((ROWS, COLUMNS), np.bool_)
    here[50:58, :9] = here[:5, 100:112] = False
    assert not room_beside_planes(on_plane(here), lit).any()
