"""The stages that experiments work on."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from controller.calibrate.mesh.export import ply_bytes
from controller.core.storage import write_atomically


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


def same_object(path: Path, seed: int) -> None:
    """``curved_object``: the same for every seed."""
    curved_object(path)


def curved_object(path: Path, *, columns: int = 121, rows: int = 101) -> None:
    """Write a pale, unpainted shell, bent in both directions and waved a little, 0.36 m wide and 0.30 m high."""
    u, v = np.meshgrid(np.linspace(-1, 1, columns), np.linspace(-1, 1, rows))
    angle = np.deg2rad(62) * u
    radius = 0.2 * (1 - 0.10 * v**2 + 0.03 * np.cos(np.pi * (1.5 * u + 0.8 * v)))
    points = np.stack([radius * np.sin(angle), 0.15 * v, radius * np.cos(angle)], axis=-1).reshape(-1, 3)
    first = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
    right, up = first + 1, first + columns
    faces = np.concatenate([np.stack([first, right, up + 1], 1), np.stack([first, up + 1, up], 1)])
    colours = np.full(points.shape, (226, 224, 220), np.uint8)
    # to micrometres, as they have always been written: a study on the same object finds the same
    write_atomically(path, ply_bytes(np.round(points, 6), faces, colours=colours))
