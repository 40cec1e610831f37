"""The targets of ``appearances``: what the paper's figures show, on whatever object was calibrated."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Final

import numpy as np

from controller.core.arrays import FloatImage, Mask
from controller.core.blur import nearest_known
from controller.core.storage import sha256_of, write_atomically
from controller.optics.solve.targets.files import read_picture
from controller.optics.solve.targets.patterns import replace_pattern
from controller.optics.solve.targets.relight import GlossLook, gloss, recolour
from controller.optics.solve.targets.values import Target, on_each, through_camera
from controller.optics.solve.targets.wrap import object_space, painted
from controller.stage.blender import job
from controller.stage.blender.job import RenderSettings, as_seen, own_paint, write_job
from controller.stage.blender.run import find_blender, render
from lab.study.subject.subject import Subject

BRIGHTEST_PERCENT: Final = 99.0
TINT: Final = (1.0, 0.62, 0.80)
LIGHT_FROM: Final = (0.9, -0.35, -0.45)
LEAVES_ACROSS: Final = 5.0
LEAF: Final = (0.09, 0.30, 0.05)
VEIN: Final = (0.34, 0.52, 0.16)
LEAF_WIDTH: Final = 0.40
"""Of half of its length."""
WANDER: Final = 0.15
"""How far a leaf's centre may lie from its cell's centre, in cells."""
SAMPLES: Final = 48

ProgressCallback = Callable[[float, str], None]
"""Progress of a target, 0 to 1, and a note; raises where the run is stopped."""


@dataclass(frozen=True, slots=True)
class Look:
    """One appearance. ``title`` as the paper's figures name it; ``made_by``: this program, or Blender."""

    name: str
    title: str
    made_by: str
    make: Callable[[Subject, ProgressCallback], Target]


def as_it_is(subject: Subject) -> FloatImage:
    """(rows, columns, 3) the object under the white of all projectors, its brightest parts at 1."""
    light = subject.transport.reach()
    brightest = np.percentile(light[subject.mask], BRIGHTEST_PERCENT)
    return np.asarray(np.clip(light / brightest, 0, 1), np.float32)


def _glossy(subject: Subject, _: ProgressCallback) -> Target:
    return through_camera(gloss(subject.geometry, subject.mask))


def _lit_anew(subject: Subject, _: ProgressCallback) -> Target:
    """The object's own paint under one lamp at its right."""
    matt = GlossLook(base_colour=(1.0, 1.0, 1.0), light_direction=LIGHT_FROM, strength=0.0, ambient=0.15)
    light = gloss(subject.geometry, subject.mask, matt)
    paint = _paint_everywhere(subject)
    return Target(np.asarray(light.image * paint, np.float32), light.mask)


def _paint_everywhere(subject: Subject) -> FloatImage:
    """The object's own paint; where its shape is not known, that of the nearest place where it is."""
    geometry = subject.geometry
    known = subject.mask & np.isfinite(geometry.normals).all(axis=2) & np.isfinite(geometry.points_m).all(axis=2)
    paint: FloatImage = own_paint(geometry, subject.transport.reach())[nearest_known(known)[1]]
    return paint


def _recoloured(subject: Subject, _: ProgressCallback) -> Target:
    """Red and blue change places."""
    return recolour(as_it_is(subject)[..., ::-1], subject.mask, TINT)


def _dotted(subject: Subject, _: ProgressCallback) -> Target:
    made = on_each(subject.mask, lambda piece: replace_pattern(subject.geometry, piece))
    return through_camera(made)


def _leaved(subject: Subject, _: ProgressCallback) -> Target:
    """Leaves over the object as it is."""
    bare = as_it_is(subject)

    def added(piece: Mask) -> Target:
        space = object_space(subject.geometry, piece)
        low, high = np.percentile(space.across_m[space.mask], [0.5, 99.5])
        cell_m = max(float(high - low) / LEAVES_ACROSS, 1e-6)
        share, colour = (
            through_camera(painted(space, partial(leaves, cell_m=cell_m, coloured=coloured)))
            for coloured in (False, True)
        )
        return Target(np.asarray(bare * (1 - share.image) + colour.image, np.float32), share.mask, share.softened)

    return on_each(subject.mask, added)


def leaves(across: FloatImage, above: FloatImage, *, cell_m: float, coloured: bool) -> FloatImage:
    """(pixels, 3): how much of a place leaves cover, 0 or 1; or, ``coloured``, their colour there and 0 between them.

    One leaf in each cell of a grid of ``cell_m``, its place and direction by chance, the same each time. ``across``,
    ``above`` (pixels,) metres along the surface.
    """
    chance = np.random.default_rng(14).random((3, 64, 64)).astype(np.float32)
    x, y = across / np.float32(cell_m), above / np.float32(cell_m)
    first = np.floor(x - 0.5).astype(np.int64), np.floor(y - 0.5).astype(np.int64)
    out = np.zeros((len(x), 3), np.float32)
    # A leaf reaches 0.61 cells from its cell's middle, so only the four nearest cells can cover a place.
    for row in (0, 1):
        for column in (0, 1):
            i, j = first[0] + column, first[1] + row
            cell = chance[:, j % 64, i % 64]
            angle = 2 * np.pi * cell[2]
            dx = x - (i + 0.5 + WANDER * (2 * cell[0] - 1))
            dy = y - (j + 0.5 + WANDER * (2 * cell[1] - 1))
            along, aside = _turned(dx, dy, angle)
            inside = np.abs(aside) < LEAF_WIDTH * np.maximum(1 - along**2, 0) * (1 - 0.25 * along)
            out[inside] = _leaf_colour(along[inside], aside[inside]) if coloured else 1.0
    return out


def _turned(dx: FloatImage, dy: FloatImage, angle: FloatImage) -> tuple[FloatImage, FloatImage]:
    """Along a leaf and aside of it, in halves of its length."""
    cosine, sine = np.cos(angle) / np.float32(0.46), np.sin(angle) / np.float32(0.46)
    return np.asarray(dx * cosine + dy * sine), np.asarray(dy * cosine - dx * sine)


def _leaf_colour(along: FloatImage, aside: FloatImage) -> FloatImage:
    rib = np.abs(aside) < 0.035 * (1.2 - along)
    branch = np.abs((along - 0.7 * np.abs(aside)) * 4 % 1 - 0.5) < 0.06
    colours: FloatImage = np.where((rib | branch)[:, None], np.array(VEIN, np.float32), np.array(LEAF, np.float32))
    return colours


def rendered(subject: Subject, on_progress: ProgressCallback, *, scene: str) -> Target:
    """The reconstructed object in one of Blender's scenes; not rendered again if an earlier run did the same.

    Raises UsageError("blender-missing") and WorkError("blender-failed", "target-no-geometry").
    """
    blender = find_blender()
    folder: Path = subject.parts.context.folder / f"study-render-{scene}"
    folder.mkdir(exist_ok=True)
    write_job(
        folder, subject.geometry, subject.mask, own_paint(subject.geometry, subject.transport.reach()), scene=scene,
        settings=RenderSettings(SAMPLES, subject.seed),
    )  # fmt: skip
    asked = [folder / "job.json", folder / "mesh.npz", Path(job.__file__).with_name("scenes.py")]
    key = hashlib.sha256(" ".join(map(sha256_of, asked)).encode()).hexdigest().encode()
    known, picture = folder / "rendered.txt", folder / "picture.exr"
    if not (picture.exists() and known.exists() and known.read_bytes() == key):
        known.unlink(missing_ok=True)
        picture = render(blender, folder, on_progress)
        write_atomically(known, key)
    return as_seen([read_picture(picture)], [subject.geometry.camera], [subject.mask])[0]


OURS: Final = "this program"
BLENDER: Final = "Blender"

LOOKS: Final[tuple[Look, ...]] = (
    Look("gloss", "gloss", OURS, _glossy),
    Look("light", "novel light", OURS, _lit_anew),
    Look("recoloured", "recoloured", OURS, _recoloured),
    Look("pattern", "pattern replaced", OURS, _dotted),
    Look("leaves", "leaves added", OURS, _leaved),
    Look("marble", "translucent marble", BLENDER, partial(rendered, scene="marble")),
    Look("gold", "inter-reflections", BLENDER, partial(rendered, scene="gold")),
    Look("glazed", "glaze", BLENDER, partial(rendered, scene="glazed")),
    Look("lowered-head", "head lowered", BLENDER, partial(rendered, scene="lowered-head")),
)
