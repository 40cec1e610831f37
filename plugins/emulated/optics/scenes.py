"""The bench's built-in objects beside vase and bust: flat ones, a statue, and what their owner has of them, as files.

Local frame: metres, x to the right, y up, z towards the audience. Paint is linear RGB between 0 and 1.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Final

import cv2
import numpy as np
import numpy.typing as npt

from plugins.emulated.core.extensions import extension
from plugins.emulated.optics.objects import StageObject, assembled, srgb_bytes
from plugins.emulated.optics.shapes import BUST_AXIS_X, Floats, Rgb, bust, paint_bust

CANVAS_M: Final = (0.30, 0.24)
FRAME: Final = ((0.0, 0.0), (0.0, 0.010), (0.009, 0.012), (0.020, 0.007), (0.024, 0.007), (0.024, -0.004))
"""Its profile: how far outside the canvas, and how far before it, in metres."""
STRIP_PX: Final = 96
"""Rows of gilded wood below the picture, for the frame."""
RELIEF_M: Final = 0.005
STONE: Final = (0.74, 0.68, 0.56)
LEFT_OF_IT: Final = 0.22
"""How much of its colours a faded object still has."""


@dataclass(frozen=True, slots=True)
class Part:
    """A surface through a grid of points (rows, columns, 3); ``uv`` (rows, columns, 2): their places in the picture.

    Rows go down and columns to the right, as the audience sees them.
    """

    points: Floats
    uv: Floats

    @property
    def faces(self) -> npt.NDArray[np.int32]:
        """(F, 3): triangles that face the audience."""
        rows, columns = self.points.shape[:2]
        at = np.arange(rows * columns, dtype=np.int32).reshape(rows, columns)
        a, b, c, d = at[:-1, :-1], at[:-1, 1:], at[1:, :-1], at[1:, 1:]
        return np.concatenate([np.stack(one, -1).reshape(-1, 3) for one in ((a, c, b), (b, c, d))])


@dataclass(frozen=True, slots=True)
class Model:
    """Parts that are painted with one ``picture`` (rows, columns, 3); ``files``: their bytes by name."""

    parts: tuple[Part, ...]
    picture: Rgb
    files: Mapping[str, bytes] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class BuiltIn:
    """``places``: names of ``layout.PLACES`` for its projectors; (): as stages usually have them; ``hung``: a wall is
    right behind it; ``apart``: each projector is aimed at one part, in turn.
    """

    model: Callable[[], Model]
    places: tuple[str, ...] = ()
    hung: bool = False
    apart: bool = False

    def on_stage(self) -> tuple[StageObject, Mapping[str, bytes]]:
        """It in the middle of the stage, and the files that a technician gets of it."""
        model = self.model()
        pieces, counts = [part.faces for part in model.parts], [part.points[..., 0].size for part in model.parts]
        vertices = np.concatenate([part.points.reshape(-1, 3) for part in model.parts]) * (1.0, -1.0, -1.0)
        vertices -= 0.5 * (vertices.min(axis=0) + vertices.max(axis=0))
        first = np.cumsum([0, *counts[:-1]])
        faces = np.concatenate([piece + start for piece, start in zip(pieces, first, strict=True)]).astype(np.int32)
        uv = np.concatenate([part.uv.reshape(-1, 2) for part in model.parts])[faces].astype(np.float32)
        starts = np.cumsum([0, *(len(piece) for piece in pieces[:-1])]) if self.apart else np.zeros(1)
        parts = starts.astype(np.int32)
        thing = assembled(vertices, faces, "texture", corner_values=uv, texture=model.picture, parts=parts)
        return thing, model.files


def landscape(rows: int = 900, columns: int = 1125) -> Rgb:
    """A painted lake between hills in the evening, (rows, columns, 3): the same each time."""
    rng = np.random.default_rng(50)
    y, x = np.meshgrid((np.arange(rows) + 0.5) / rows, (np.arange(columns) + 0.5) / rows, indexing="ij")

    def mixed(low: tuple[float, ...], high: tuple[float, ...], share: Floats) -> Floats:
        share = np.clip(share, 0.0, 1.0)[..., None]
        return np.asarray((1.0 - share) * low + share * np.asarray(high))

    picture = mixed((0.10, 0.22, 0.55), (0.80, 0.50, 0.26), (y / 0.6) ** 1.4)
    picture += 0.5 * np.exp(-np.hypot(x - 0.86, y - 0.36)[..., None] / (0.14, 0.09, 0.05))
    hills = ((0.44, 0.09, (0.30, 0.34, 0.55)), (0.52, 0.06, (0.16, 0.30, 0.34)), (0.58, 0.03, (0.10, 0.26, 0.12)))
    for foot, high, colour in hills:
        waves = sum(np.sin(f * x + rng.uniform(0, 7)) / f for f in (5.0, 9.0, 17.0, 41.0))
        picture = np.where(
            (y > foot - 2.5 * high * waves)[..., None], mixed(colour, (0.5, 0.42, 0.3), (y - foot) * 2), picture
        )
    shore = int(0.66 * rows)
    mirrored = picture[shore - 1 :: -1][: rows - shore]
    ripples = np.exp(-((np.sin(260.0 * np.sqrt(y[shore:]) + 2.0 * np.sin(9.0 * x[shore:])) - 1.0) ** 2))[..., None]
    picture[shore:] = 0.75 * mirrored + 0.12 * ripples * (0.9, 0.75, 0.5) + (0.01, 0.03, 0.06)
    for _ in range(9):
        at, foot, high = rng.uniform(0.02, 0.42), rng.uniform(0.68, 0.80), rng.uniform(0.16, 0.30)
        below = (foot - y) / high
        tree = (below > 0) & (np.abs(x - at) < 0.16 * high * (1.0 - below) * (1.0 + 0.3 * np.sin(50.0 * below)))
        picture[tree] = rng.uniform((0.05, 0.14, 0.07), (0.10, 0.19, 0.12))
    wall, roof = (np.abs(x - 0.62) < 0.05) & (np.abs(y - 0.635) < 0.035), np.abs(x - 0.62) < (y - 0.555) * 1.4
    picture[wall] = (0.78, 0.70, 0.58)
    picture[roof & (y < 0.60)] = (0.62, 0.14, 0.09)
    picture[(np.hypot((x - 0.98) / 0.07, (y - 0.80) / 0.022) < 1.0) & (y > 0.80)] = (0.55, 0.12, 0.10)
    picture[(x > 0.98) & (x < 0.98 + (y - 0.66) * 0.45) & (y < 0.795)] = (0.80, 0.76, 0.66)
    strokes = cv2.GaussianBlur(rng.normal(0.0, 1.0, (rows, columns)), (0, 0), 6.0, sigmaY=1.5)
    picture = picture * (1.0 + 0.5 * strokes[..., None])
    return np.clip(cv2.GaussianBlur(picture, (0, 0), 1.2), 0.04, 0.85).astype(np.float32)


def faded(colours: Rgb) -> Rgb:
    """Paint as centuries of light leave it: pale, with little of its colour."""
    return np.asarray(LEFT_OF_IT * colours + (1.0 - LEFT_OF_IT) * np.array(STONE), dtype=np.float32)


def painting() -> Model:
    """A faded landscape on canvas, in a gilded frame that stands out 16 mm from the wall."""
    original = landscape()
    rows, columns = original.shape[:2]
    share = STRIP_PX / (STRIP_PX + rows)
    across, up = (0.5 * size for size in CANVAS_M)
    (canvas,) = facets(sheet(2, 2, lambda u, v: (across * (2 * u - 1), up * (2 * v - 1), 0.0 * u)))
    canvas.uv[..., 1] = share + (1.0 - share) * canvas.uv[..., 1]
    corners = np.array([[-1, 1], [1, 1], [1, -1], [-1, -1], [-1, 1]], dtype=np.float64)
    rings = [np.column_stack((corners * (across + out, up + out), np.full(5, before))) for out, before in FRAME[::-1]]
    places = np.meshgrid(np.linspace(0.0, 0.999, 5), share * np.linspace(0.2, 0.8, len(FRAME)))
    frame = Part(np.array(rings), np.stack(places, axis=-1))
    grain = np.random.default_rng(51).normal(1.0, 0.5, (STRIP_PX, columns))
    wood = cv2.GaussianBlur(grain, (0, 0), 8.0, sigmaY=2.0)[..., None] * (0.52, 0.36, 0.15)
    picture = np.concatenate([faded(original), wood.astype(np.float32)])
    return Model((canvas, *facets(frame)), picture, {"original.png": _png(original)})


def relief() -> Model:
    """A slab with a rosette over a row of waves, 5 mm deep, once gilded on blue."""

    def slab(u: Floats, v: Floats) -> tuple[Floats, ...]:
        x, y = 0.15 * (2 * u - 1), 0.12 * (2 * v - 1)
        turn, away = np.arctan2(y - 0.02, x), np.hypot(x, y - 0.02)
        petals = np.cos(7.0 * turn) * np.exp(-(((away - 0.05) / 0.02) ** 2))
        waves = np.cos(2 * np.pi * (x + 0.4 * y) / 0.05) * np.exp(-(((y + 0.09) / 0.014) ** 2))
        high = petals + waves + np.cos(2 * np.pi * away / 0.035) * np.exp(-((away / 0.08) ** 4))
        return x, y, RELIEF_M * (high - high.min()) / np.ptp(high)

    part = sheet(240, 300, slab)
    high = cv2.resize(part.points[..., 2] / RELIEF_M, (1200, 960), interpolation=cv2.INTER_CUBIC)[..., None]
    colours = np.clip(high * (0.80, 0.58, 0.20) + (1.0 - high) * (0.08, 0.16, 0.45), 0.04, 0.85).astype(np.float32)
    return Model((part,), faded(colours), {"original.png": _png(colours)})


def statue() -> Model:
    """A bust of stone with the last traces of its paint; a scan of it, and its colours of old on the scan's sheet."""
    rows, columns = 230, 240
    points = bust(rows, columns)[0][: rows * columns].reshape(rows, columns, 3)[::-1, ::-1]
    points = np.concatenate([points, points[:, :1]], axis=1)
    u, v = np.meshgrid(np.linspace(0.0, 1.0, columns + 1), np.linspace(1.0, 0.0, rows))
    part = Part(points - (BUST_AXIS_X, 0.0, 0.0), np.stack((u, v), axis=-1))
    y, x = np.meshgrid(np.linspace(0, rows - 1, 6 * rows), np.linspace(0, columns, 6 * columns), indexing="ij")
    between = cv2.remap(points.astype(np.float32), x.astype(np.float32), y.astype(np.float32), cv2.INTER_LINEAR)
    colours = paint_bust(between.reshape(-1, 3).astype(np.float64)).reshape(between.shape)
    today = faded(colours)
    return Model((part,), today, {"statue.glb": _scan(part, today), "colours.png": _png(colours)})


BUILT_IN: Final[Mapping[str, BuiltIn]] = {
    "painting": BuiltIn(painting, ("left", "right"), hung=True),
    "relief": BuiltIn(relief),
    "statue": BuiltIn(statue),
}
SOLIDS: Final = ("corner", "cylinder", "sphere", "two-objects")
"""Those of velatura-lab."""


def built_in(name: str) -> BuiltIn:
    """The object of this name, of ``BUILT_IN`` or ``SOLIDS``. Raises DeviceError("bench-part-missing")."""
    thing: BuiltIn = BUILT_IN.get(name) or extension("solids", asked_by=f"The object {name}")[name]
    return thing


def sheet(rows: int, columns: int, surface: Callable[[Floats, Floats], tuple[Floats, ...]]) -> Part:
    """Points of ``surface`` over u to the right and v up, both from 0 to 1."""
    u, v = np.meshgrid(np.linspace(0.0, 1.0, columns), np.linspace(1.0, 0.0, rows))
    return Part(np.stack(surface(u, v), axis=-1), np.stack((u, v), axis=-1))


def facets(part: Part) -> tuple[Part, ...]:
    """Its quadrilaterals, each a micrometre larger, so that they share no corners and each has its own normal."""
    windows = [np.s_[i : i + 2, j : j + 2] for i, j in np.ndindex(*(side - 1 for side in part.points.shape[:2]))]
    out = [1e-6 * np.sign(part.points[at] - part.points[at].mean(axis=(0, 1))) for at in windows]
    return tuple(Part(part.points[at] + step, part.uv[at]) for at, step in zip(windows, out, strict=True))


def _png(colours: Rgb) -> bytes:
    ok, data = cv2.imencode(".png", srgb_bytes(colours)[..., ::-1])
    assert ok
    return data.tobytes()


def _scan(part: Part, picture: Rgb) -> bytes:
    """A glTF file of it."""
    trimesh: Any = importlib.import_module("trimesh")  # its functions carry no types
    image: Any = importlib.import_module("PIL.Image")
    material = trimesh.visual.material.PBRMaterial(baseColorTexture=image.fromarray(srgb_bytes(picture)))
    visual = trimesh.visual.TextureVisuals(uv=part.uv.reshape(-1, 2), material=material)
    mesh = trimesh.Trimesh(part.points.reshape(-1, 3), part.faces, visual=visual, process=False)
    return bytes(mesh.export(file_type="glb"))
