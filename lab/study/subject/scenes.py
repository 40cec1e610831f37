"""The stages that experiments work on."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from controller.core.arrays import Float64
from controller.core.storage import write_atomically
from controller.optics.calibrate.mesh import ply_bytes

DARK = "dark"


@dataclass(frozen=True, slots=True)
class Scene:
    """A stage that a bench can set up.

    ``write_object``: writes the mesh (.ply, y up, facing +z) that stands on it, for a seed; None: the bench's own
    painted vase and bust; ``settings``: of the bench's driver, for instance ``{"projectors": 6}``
    """

    name: str
    title: str
    write_object: Callable[[Path, int], None] | None = None
    settings: Mapping[str, Any] = ()  # type: ignore[assignment]

    @property
    def room(self) -> str:
        """The stage's light, by its name in stage.toml; without a word of the scene there is nothing around it."""
        return str(dict(self.settings).get("room", DARK))


def same_object(path: Path, seed: int) -> None:
    """``curved_object``: the same for every seed."""
    curved_object(path)


def plate_object(path: Path, seed: int) -> None:
    """Write a pale, unpainted plate, 0.36 m wide and 0.30 m high, whose rim is bent back: the same for every ``seed``.

    The middle, three quarters of the width and the height, is flat. A calibration needs the rim: from a plane alone,
    the poses of projectors can't be determined.
    """

    def plate(u: Float64, v: Float64) -> tuple[Float64, Float64, Float64]:
        beyond = np.maximum(np.maximum(np.abs(u), np.abs(v)) - 0.75, 0) / 0.25
        return 0.18 * u, 0.15 * v, -0.06 * beyond

    _write_pale(path, *_grid(121, 101, plate))


def curved_object(path: Path, *, columns: int = 121, rows: int = 101) -> None:
    """Write a pale, unpainted shell, bent in both directions and waved a little, 0.36 m wide and 0.30 m high."""

    def shell(u: Float64, v: Float64) -> tuple[Float64, Float64, Float64]:
        angle = np.deg2rad(62) * u
        radius = 0.2 * (1 - 0.10 * v**2 + 0.03 * np.cos(np.pi * (1.5 * u + 0.8 * v)))
        return radius * np.sin(angle), 0.15 * v, radius * np.cos(angle)

    _write_pale(path, *_grid(columns, rows, shell))


def _grid(
    columns: int, rows: int, surface: Callable[[Float64, Float64], tuple[Float64, Float64, Float64]]
) -> tuple[Float64, npt.NDArray[np.int64]]:
    """Points (rows * columns, 3) of ``surface`` over u to the right and v up, both from -1 to 1, and its triangles."""
    u, v = np.meshgrid(np.linspace(-1, 1, columns), np.linspace(-1, 1, rows))
    points = np.stack(surface(u, v), axis=-1).reshape(-1, 3)
    first = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
    right, up = first + 1, first + columns
    return points, np.concatenate([np.stack([first, right, up + 1], 1), np.stack([first, up + 1, up], 1)])


def _write_pale(path: Path, points: Float64, faces: npt.NDArray[np.int64]) -> None:
    colours = np.full(points.shape, (226, 224, 220), np.uint8)
    # to micrometres, as they have always been written: a study on the same object finds the same
    write_atomically(path, ply_bytes(np.round(points, 6), faces, colours=colours))
