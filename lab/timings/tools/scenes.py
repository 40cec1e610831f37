"""Objects whose surfaces light each other: a bust in a painted corner, a bowl, a vase beside a bust, steps, a bust in a
niche, a vase between walls, a fence before a wall; and a board, on which nothing lights anything."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt
import trimesh

from controller.core.arrays import Float64
from controller.core.colour import linear_to_srgb
from plugins.emulated.optics.shapes import BUST_AXIS_X, VASE_AXIS_X, bust, paint_bust, paint_vase, vase

Part = tuple[Float64, Float64, Float64]
"""Vertices (V, 3) in metres, y up and z towards the audience, triangles (F, 3), and linear colours (V, 3)."""
GRID: Final = 120
OPENING: Final = np.deg2rad(110.0)
"""Between the walls of the corner."""


def corner() -> Part:
    """Two walls and a floor, painted in squares and stripes, and a bust before them."""
    half, side, high = 0.5 * OPENING, 0.22, 0.30
    walls = []
    for sign, light, dark in (
        (-1.0, (0.80, 0.35, 0.28), (0.62, 0.22, 0.20)),
        (1.0, (0.35, 0.62, 0.78), (0.24, 0.45, 0.62)),
    ):
        out = np.array([sign * np.sin(half), 0.0, np.cos(half)])
        walls.append(_plane(np.zeros(3), side * out, np.array([0.0, high, 0.0]), light, dark, 5))
    out = side * np.array([[-np.sin(half), 0.0, np.cos(half)], [np.sin(half), 0.0, np.cos(half)]])
    floor = _plane(np.zeros(3), out[0], out[1], (0.75, 0.72, 0.65), (0.55, 0.52, 0.46), 4)
    head = _standing(bust(200, 240), paint_bust, BUST_AXIS_X)
    head[0][:] = 0.62 * head[0] + (0.0, 0.002, 0.115)
    return _together(*walls, floor, head)


def bowl() -> Part:
    """A deep bowl that opens towards the audience, with rings and sectors."""
    turn, tilt = np.meshgrid(np.linspace(0, 2 * np.pi, 2 * GRID), np.linspace(0.0, np.deg2rad(75.0), GRID))
    points = 0.15 * np.stack((np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), -np.cos(tilt)), axis=-1)
    marked = (np.floor(turn / (np.pi / 6)) + np.floor(tilt / 0.26)) % 2 < 1
    return _sheet(points, marked, (0.80, 0.62, 0.42), (0.70, 0.72, 0.74))


def two_objects() -> Part:
    """A vase beside a bust, less than a finger's width apart."""
    left = _standing(vase(240, 320), paint_vase, VASE_AXIS_X)
    right = _standing(bust(240, 280), paint_bust, BUST_AXIS_X)
    right[0][:, 0] += left[0][:, 0].max() - right[0][:, 0].min() + 0.006
    return _together(left, right)


def steps() -> Part:
    """Three steps of painted bricks, which the camera sees from the side, and striped balls that lie on them."""
    paints = (
        ((0.80, 0.78, 0.72), (0.50, 0.20, 0.18)),
        ((0.70, 0.75, 0.80), (0.20, 0.35, 0.30)),
        ((0.80, 0.60, 0.30), (0.30, 0.30, 0.32)),
    )
    wide, high, parts = 0.30, 0.07, []
    for number in range(3):
        front = np.array([-0.5 * wide, high * number, 0.08 - high * number])
        across, up, back = (np.array(edge) for edge in ((wide, 0.0, 0.0), (0.0, high, 0.0), (0.0, 0.0, -high)))
        parts.append(_plane(front, across, up, *paints[number], 9))
        parts.append(_plane(front + up, across, back, *paints[(number + 1) % 3], 6))
    for x, step, radius in ((-0.08, 0, 0.030), (0.05, 1, 0.032), (0.09, 0, 0.025)):
        middle = np.array([x, high * (step + 1) + radius, 0.045 - high * step])
        ball = trimesh.creation.icosphere(5, radius)
        turn = np.arctan2(ball.vertices[:, 0], ball.vertices[:, 2])
        colours = np.where((np.floor(turn / 0.5) % 2 < 1)[:, None], (0.85, 0.85, 0.85), (0.60, 0.10, 0.30))
        parts.append((np.asarray(ball.vertices) + middle, np.asarray(ball.faces, np.float64), colours))
    return _together(*parts)


def niche() -> Part:
    """A bust in a niche with a half dome: orange and red walls around it, blue and white above."""
    radius, high = 0.11, 0.20
    turn, height = np.meshgrid(np.linspace(-np.pi / 2, np.pi / 2, 2 * GRID), np.linspace(0, high, GRID))
    points = np.stack((radius * np.sin(turn), height, -radius * np.cos(turn)), axis=-1)
    marked = (np.floor(turn / (np.pi / 10)) + np.floor(height / 0.03)) % 2 < 1
    wall = _sheet(points, marked, (0.75, 0.20, 0.12), (0.85, 0.50, 0.20))
    turn, tilt = np.meshgrid(np.linspace(-np.pi / 2, np.pi / 2, 2 * GRID), np.linspace(0, 0.98 * np.pi / 2, GRID))
    level = radius * np.cos(tilt)
    points = np.stack((level * np.sin(turn), high + radius * np.sin(tilt), -level * np.cos(turn)), axis=-1)
    marked = (np.floor(turn / (np.pi / 8)) + np.floor(tilt / 0.3)) % 2 < 1
    dome = _sheet(points, marked, (0.20, 0.30, 0.70), (0.70, 0.70, 0.75))
    floor = _plane(
        np.array([-radius, 0.0, 0.08]), np.array([2 * radius, 0.0, 0.0]), np.array([0.0, 0.0, -0.19]),
        (0.7, 0.7, 0.7), (0.3, 0.3, 0.3), 7,
    )  # fmt: skip
    head = _standing(bust(200, 240), paint_bust, BUST_AXIS_X)
    head[0][:] *= 0.7
    return _together(wall, dome, floor, head)


def alcove() -> Part:
    """A vase between a green and a purple wall, a third behind it."""
    left, right, high = np.array([-0.13, 0.0, -0.10]), np.array([0.13, 0.0, -0.10]), np.array([0.0, 0.22, 0.0])
    pot = _standing(vase(240, 320), paint_vase, VASE_AXIS_X)
    pot[0][:] = 0.75 * pot[0]
    return _together(
        _plane(left, np.array([-0.05, 0.0, 0.22]), high, (0.10, 0.60, 0.20), (0.60, 0.75, 0.30), 6),
        _plane(right, np.array([0.05, 0.0, 0.22]), high, (0.70, 0.15, 0.50), (0.75, 0.50, 0.70), 6),
        _plane(left, right - left, high, (0.60, 0.60, 0.75), (0.30, 0.30, 0.50), 6),
        _plane(np.array([-0.18, 0.0, 0.12]), np.array([0.36, 0.0, 0.0]), np.array([0.0, 0.0, -0.22]),
               (0.70, 0.65, 0.50), (0.50, 0.40, 0.30), 5),
        pot,
    )  # fmt: skip


def fence() -> Part:
    """Nine thin bars and two rails before a wall in squares: a third of what the camera sees is beside a depth edge."""
    wide, high = np.array([0.32, 0.0, 0.0]), np.array([0.0, 0.24, 0.0])
    parts = [_plane(np.array([-0.16, 0.0, -0.08]), wide, high, (0.25, 0.45, 0.70), (0.75, 0.70, 0.50), 7)]
    for number in range(9):
        bar = trimesh.creation.cylinder(0.004, 0.2, sections=24)
        points = np.asarray(bar.vertices)[:, [0, 2, 1]] + (-0.14 + 0.035 * number, 0.1, 0.02)
        colours = np.tile((0.80, 0.75, 0.60), (len(points), 1))
        parts.append((points, np.asarray(bar.faces, np.float64)[:, ::-1], colours))
    for level in (0.05, 0.15):
        at, along = np.array([-0.15, level, 0.028]), np.array([0.30, 0.0, 0.0])
        parts.append(_plane(at, along, np.array([0.0, 0.012, 0.0]), (0.60, 0.20, 0.15), (0.80, 0.75, 0.60), 6))
    return _together(*parts)


def board() -> Part:
    """A flat board in squares of two paints, turned by 12 degrees to its right."""
    turn = np.deg2rad(12.0)
    across = np.array([0.34 * np.cos(turn), 0.0, 0.34 * np.sin(turn)])
    return _plane(-0.5 * across, across, np.array([0.0, 0.26, 0.0]), (0.72, 0.58, 0.42), (0.38, 0.46, 0.55), 6)


SCENES: Final[Mapping[str, Callable[[], Part]]] = {
    "corner": corner, "bowl": bowl, "two-objects": two_objects, "steps": steps, "niche": niche, "alcove": alcove,
    "fence": fence, "board": board,
}  # fmt: skip


def write_scene(name: str, file: Path) -> Path:
    """Write a scene of ``SCENES`` as a mesh file that the bench reads; returns ``file``."""
    vertices, faces, colours = SCENES[name]()
    encoded = np.rint(255 * linear_to_srgb(colours.astype(np.float32))).astype(np.uint8)
    trimesh.Trimesh(vertices, faces, vertex_colors=encoded, process=False).export(file)
    return file


def _plane(at: Float64, across: Float64, up: Float64, light: object, dark: object, squares: int) -> Part:
    u, v = np.meshgrid(np.linspace(0, 1, GRID), np.linspace(0, 1, GRID))
    points = at + u[..., None] * across + v[..., None] * up
    marked = (np.floor(squares * u) + np.floor(squares * v)) % 2 < 1
    return _sheet(points, marked, light, dark)


def _sheet(points: Float64, marked: npt.NDArray[np.bool_], light: object, dark: object) -> Part:
    """A surface through (rows, columns, 3) points in two paints: the ``light`` one where it is ``marked``."""
    colours = np.where(marked[..., None], np.asarray(light), np.asarray(dark))
    return points.reshape(-1, 3), _triangles(*marked.shape), colours.reshape(-1, 3)


def _standing(surface: tuple[Float64, object], paint: Callable[[Float64], object], axis_x: float) -> Part:
    points = np.asarray(surface[0], np.float64)
    colours = np.asarray(paint(points), np.float64)
    return points - (axis_x, 0.0, 0.0), np.asarray(surface[1], np.float64), colours


def _triangles(rows: int, columns: int) -> Float64:
    first = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
    one, two = (first, first + 1, first + columns), (first + 1, first + columns + 1, first + columns)
    return np.stack([np.stack(corners, axis=1) for corners in (one, two)], axis=1).reshape(-1, 3).astype(np.float64)


def _together(*parts: Part) -> Part:
    first = np.cumsum([0, *(len(part[0]) for part in parts[:-1])])
    faces = [part[1] + offset for part, offset in zip(parts, first, strict=True)]
    return np.concatenate([p[0] for p in parts]), np.concatenate(faces), np.concatenate([p[2] for p in parts])
