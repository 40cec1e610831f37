"""The stages that experiments work on."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from controller.storage import write_atomically


@dataclass(frozen=True, slots=True)
class Scene:
    """A stage that a bench can set up.

    ``write_object``: writes the mesh (.ply, y up, facing +z) that stands on it; None: the bench's own painted vase and
    bust; ``settings``: of the bench's driver, for instance ``{"projectors": 6}``
    """

    name: str
    title: str
    write_object: Callable[[Path], None] | None = None
    settings: Mapping[str, Any] = ()  # type: ignore[assignment]


def curved_object(path: Path, *, columns: int = 121, rows: int = 101) -> None:
    """Write a pale, unpainted shell, bent in both directions and waved a little, 0.36 m wide and 0.30 m high."""
    u, v = np.meshgrid(np.linspace(-1, 1, columns), np.linspace(-1, 1, rows))
    angle = np.deg2rad(62) * u
    radius = 0.2 * (1 - 0.10 * v**2 + 0.03 * np.cos(np.pi * (1.5 * u + 0.8 * v)))
    points = np.stack([radius * np.sin(angle), 0.15 * v, radius * np.cos(angle)], axis=-1).reshape(-1, 3)
    first = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
    right, up = first + 1, first + columns
    faces = np.concatenate([np.stack([first, right, up + 1], 1), np.stack([first, up + 1, up], 1)])
    head = (
        "ply", "format ascii 1.0", f"element vertex {len(points)}", "property float x", "property float y",
        "property float z", "property uchar red", "property uchar green", "property uchar blue",
        f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header",
    )  # fmt: skip
    colour = "226 224 220"
    body = [f"{x:.6f} {y:.6f} {z:.6f} {colour}" for x, y, z in points]
    triangles = [f"3 {a} {b} {c}" for a, b, c in faces]
    write_atomically(path, ("\n".join([*head, *body, *triangles]) + "\n").encode())


def planned_object(path: Path) -> None:
    """Write the shell, and beside it where the projectors stand that were planned for it."""
    from controller.study import placement  # which stands on this module

    placement.planned_object(path)


_ALL: Final = (
    Scene("painted", "a painted vase and bust, three projectors"),
    Scene("curved", "a pale curved shell, three projectors", curved_object),
    Scene("curved-six", "a pale curved shell, six projectors", curved_object, {"projectors": 6}),
    Scene(
        "planned", "the shell, three projectors where they were planned", planned_object, {"stands": "../stands.toml"}
    ),
)
SCENES: Final[Mapping[str, Scene]] = {scene.name: scene for scene in _ALL}
