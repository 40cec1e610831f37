"""From the [[appearances]] of stage.toml to target pictures on the calibrated object.

Blender renders some of them: each is a step of its own before the target is solved.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Final, Literal, get_type_hints

import numpy as np

from controller.config import Stage
from controller.config.models import AppearanceTable
from controller.config.table import allowed, checked_arguments
from controller.core.arrays import FloatImage, Mask
from controller.core.colour import ColourSpace
from controller.core.errors import UsageError
from controller.core.storage import sha256_of
from controller.optics.calibrate.mesh_alignment import Pose
from controller.optics.solve.targets.files import check_picture, load_target, read_picture
from controller.optics.solve.targets.patterns import (
    CheckerboardLook,
    Colour,
    PatternLook,
    checkerboard,
    replace_pattern,
)
from controller.optics.solve.targets.relight import GlossLook, gloss, recolour
from controller.optics.solve.targets.restoration import RestorationLook, restored
from controller.optics.solve.targets.sheets import as_it_is, mesh_places, paint_at, texture
from controller.optics.solve.targets.values import Target, in_box, on_each, through_camera
from controller.optics.solve.targets.wrap import PrintLook, wrap_photograph
from controller.run.runner import Context
from controller.stage.artefacts.calibrated import Calibrated
from controller.stage.artefacts.geometry import camera_px, require_shape
from controller.stage.artefacts.mesh import RegisteredMesh
from controller.stage.artefacts.names import safe_name
from controller.stage.artefacts.solved import read_target, render_folder, write_target
from controller.stage.blender.job import BUILTIN, RenderSettings, as_seen, light_alike, own_paint, write_job
from controller.stage.blender.run import find_blender, render
from controller.stage.steps.appearance.restoring import TITLE, Restoration, restoration_request
from controller.stage.steps.appearance.solving import AppearanceRequest
from controller.stage.steps.mesh import carried_mesh

TITLES: Mapping[str, str] = {
    "photograph": "A photograph wrapped around the object",
    "pattern": "Another pattern instead of the object's own",
    "checkerboard": "A checkerboard",
    "gloss": "A gloss",
    "recolour": "Recoloured",
    "picture": "A picture as seen from the camera",
    "restoration": TITLE,
    "blender": "Rendered by Blender",
    "texture": "A picture painted on the object",
}
"""Title of every kind of appearance."""

NEEDS_FILE = ("photograph", "picture", "restoration", "texture")
VIEW: Final = "{view}"
"""Stands for the name of each view in the file of a picture."""
NEEDS_NO_SHAPE: Final = ("recolour", "picture", "restoration", "texture")
"""Kinds that are made in the camera's picture alone; a texture may be."""


def requests_of(stage: Stage, calibrated: Calibrated, names: Sequence[str] = ()) -> list[AppearanceRequest]:
    """The appearances of stage.toml with these names, or all, checked before anything is solved.

    Raises UsageError with code "appearance-unknown", "stage-key-value" or "stage-key-unknown" (with the line), and
    "target-missing" for a missing file.
    """
    tables = {table.name: table for table in stage.tables.appearances}
    unknown = [name for name in names if name not in tables]
    if unknown or not tables:
        raise UsageError(
            "appearance-unknown",
            what=f"stage.toml has no appearance {unknown[0]!r}." if unknown else "stage.toml has no [[appearances]].",
            remedy=f"Available: {', '.join(tables)}."
            if tables
            else 'Add one with name and kind, for example kind = "gloss".',
        )
    made = [_request(stage, tables[name], calibrated) for name in (names or tables)]
    titles = [one.title for one in made]
    return [replace(one, title=f"{one.title}: {one.name}") if titles.count(one.title) > 1 else one for one in made]


def _request(stage: Stage, table: AppearanceTable, calibrated: Calibrated) -> AppearanceRequest:
    if table.kind not in TITLES:
        raise table.place.wrong_value("kind", table.kind, "is not a kind of appearance", f"one of {', '.join(TITLES)}")
    has_none = stage.tables.object.shape == "unknown"
    if table.kind not in NEEDS_NO_SHAPE and (has_none or calibrated.camera_px is not None):
        require_shape(calibrated.folder, f"The appearance {table.name} of kind {table.kind}")
    _ = table.hint_ms  # report its errors before an hour of solving
    wanted = _options(table.kind)
    required = ("tint",) if table.kind == "recolour" else ()
    settings = table.settings({key: allowed(kind) for key, kind in wanted.items()}, required)
    options = checked_arguments(table.place, settings, wanted)
    file = None if table.file is None else stage.path(table.file)
    if table.kind in NEEDS_FILE and file is None:
        raise table.place.missing("file", "a picture file, relative to the stage's folder", written=settings)
    files = [] if file is None else [file] if table.kind != "picture" else _pictures(table, file, calibrated)
    for one, folder in zip(files, calibrated.folders, strict=False):
        _check_picture(table, one, camera_px(folder), options.get("colour"))
    inputs = {"kind": table.kind, "settings": repr(sorted(options.items()))}
    if table.kind == "blender":
        return blender_request(table.name, calibrated, options, inputs, folder=stage.folder)
    for name, one in zip(calibrated.names, files, strict=False):
        inputs[f"file of {name}" if one is not files[0] else "file"] = sha256_of(one)
    if table.kind == "restoration":
        assert file is not None
        return restoration_request(table.name, file, options, calibrated, stage.tables.solve, inputs)
    if table.kind == "texture":
        assert file is not None
        inputs["mesh"] = _check_sheet(table, file, options, calibrated)
    elif table.kind not in NEEDS_NO_SHAPE and (mesh := RegisteredMesh.read(calibrated.folder)) is not None:
        inputs["filled"] = str(mesh.figures.get("filled_pixels", 0))

    def target() -> Target:
        arguments = {_ARGUMENTS.get(key, key): value for key, value in options.items()}
        return make_target(table.kind, file, arguments, calibrated)

    request = AppearanceRequest(table.name, TITLES[table.kind], target, inputs)
    if table.kind != "texture" or options.get("uv", "mesh") != "mesh" or file is None:
        return request
    return replace(request, sheet=partial(_unseen_paint, calibrated, lambda: _sheet(file, options.get("colour"))))


def _unseen_paint(calibrated: Calibrated, sheet: Callable[[], FloatImage], n: int, lit: Mask) -> FloatImage:
    """As of ``SheetOf``: what a camera in the place of projector ``n`` would see of the sheet on the mesh."""
    geometry, mesh = calibrated.first.known_geometry, RegisteredMesh.read(calibrated.folder)
    if geometry is None or mesh is None or mesh.uv is None:
        return np.full((*lit.shape, 3), np.nan, np.float32)
    own = geometry.projectors[n]
    pose = mesh.pose.then(Pose(1.0, own.rotation, own.translation_m))
    return paint_at(sheet(), mesh_places(mesh.solid, mesh.uv, pose, own), lit)


def _pictures(table: AppearanceTable, file: Path, calibrated: Calibrated) -> list[Path]:
    """The picture of each view."""
    if len(calibrated.names) > 1 and VIEW not in file.name:
        problem = f"is one picture, and the stage has {len(calibrated.names)} views"
        raise table.place.wrong_value("file", table.file, problem, f"a name with {VIEW}, which stands for each view's")
    return _of_views(file, calibrated)


def _of_views(file: Path, calibrated: Calibrated) -> list[Path]:
    return [file.with_name(file.name.replace(VIEW, safe_name(name))) for name in calibrated.names]


_MAKERS: Mapping[str, tuple[Callable[..., Target], type[Any]]] = {
    "pattern": (replace_pattern, PatternLook),
    "checkerboard": (checkerboard, CheckerboardLook),
    "gloss": (gloss, GlossLook),
    "photograph": (wrap_photograph, PrintLook),
    "restoration": (restored, RestorationLook),
}
"""What makes the target of a kind, and its settings."""


def _options(kind: str) -> dict[str, Any]:
    """The settings of a kind with their types: the fields of its look."""
    if kind == "recolour":
        return {"tint": Colour}
    if kind == "blender":
        return {"scene": str, "samples": int, "seed": int}
    if kind in ("picture", "texture"):
        return {**_OF_FILES, **({"uv": Literal["mesh", "camera"]} if kind == "texture" else {})}
    if kind not in _MAKERS:
        return {}
    options = {_RENAMED.get(name, name): kind_of for name, kind_of in get_type_hints(_MAKERS[kind][1]).items()}
    return {**options, **_OF_FILES} if kind in NEEDS_FILE else options


_OF_FILES: Mapping[str, Any] = {"colour": ColourSpace}
"""Settings on how a picture file is read."""
_RENAMED: Mapping[str, str] = {"kind": "figure"}
"""Settings with another name in stage.toml, where ``kind`` chooses the maker."""
_ARGUMENTS: Mapping[str, str] = {written: name for name, written in _RENAMED.items()}


def _check_picture(
    table: AppearanceTable, file: Path, camera_px: tuple[int, int] | None, colour: ColourSpace | None
) -> None:
    """Read a picture now, so that an error shows before an hour of solving."""
    if not file.is_file():
        raise UsageError(
            "target-missing",
            what=f"The picture {file} of appearance {table.name} does not exist.",
            remedy="Add the file, or correct `file` in stage.toml.",
        )
    if table.kind == "restoration" and camera_px is not None:
        return  # a large one is read once, when it is registered
    picture = read_picture(file, colour)
    size = camera_px if table.kind == "picture" else None
    check_picture(file, picture, (picture.shape[1], picture.shape[0]) if size is None else size)


def _check_sheet(table: AppearanceTable, file: Path, options: Mapping[str, Any], calibrated: Calibrated) -> str:
    """What identifies the mesh and its pose. Raises UsageError.

    A mesh that was laid on an earlier calibration is laid on this one; that raises as ``lay_mesh``.
    """
    height, width = read_picture(file, options.get("colour"), soft=True).shape[:2]
    size_px, identity = calibrated.camera_px, "camera"
    # A run that calibrates first has neither camera picture nor mesh yet.
    if options.get("uv", "mesh") == "mesh" and size_px is not None:
        require_shape(calibrated.folder, "A texture on a mesh")
        mesh = carried_mesh(calibrated.folder)
        if mesh is None or mesh.uv is None:
            raise UsageError(
                "mesh-not-registered" if mesh is None else "mesh-without-uv",
                what=f"The appearance {table.name} is painted on a mesh, "
                + ("and none was laid on the object." if mesh is None else "and the registered mesh has no UV."),
                remedy=(
                    "Run `velatura register STAGE MESH`, " if mesh is None else "Unwrap it, and register it again, "
                )
                + 'or set uv = "camera" for a sheet that shows the camera\'s view.',
            )
        size_px, identity = mesh.figures.get("sheet_px"), f"{mesh.figures['sha256']} {mesh.pose}"
    if size_px is not None and abs(width * size_px[1] / (height * size_px[0]) - 1) > SHEET_SHAPE:
        raise UsageError(
            "sheet-wrong-shape",
            what=f"{file.name} is {width} x {height} pixels, and its sheet is {size_px[0]} x {size_px[1]}.",
            remedy="Save it with the size of the exported sheet, or a multiple of it, and do not crop it.",
        )
    return identity


SHEET_SHAPE: Final = 0.005
"""Relative difference of width to height that comes from rounding alone."""


def make_target(kind: str, file: Path | None, options: Mapping[str, Any], calibrated: Calibrated) -> Target:
    """The target of a ``kind`` with its checked ``options``, on a calibrated object. Raises UsageError."""
    mask = calibrated.transport.object_mask
    options = dict(options)
    colour = options.pop("colour", None)
    if kind == "restoration":
        assert file is not None
        return Restoration(file, {**options, "colour": colour}, calibrated).made[0]
    if kind == "picture":
        assert file is not None
        sizes = (view.part(mask).shape[1::-1] for view in calibrated.views())
        made = [load_target(one, size, colour) for one, size in zip(_of_views(file, calibrated), sizes, strict=True)]
        return Target(calibrated.joined([one.image for one in made]), calibrated.joined([one.mask for one in made]))
    if kind == "recolour":
        return recolour(as_it_is(calibrated.transport, calibrated.matt), mask, **options)
    if kind == "texture":
        assert file is not None
        mesh = RegisteredMesh.read(calibrated.folder) if options.get("uv", "mesh") == "mesh" else None
        places = None if mesh is None else calibrated.places(mesh)
        return texture(_sheet(file, colour), places, as_it_is(calibrated.transport, calibrated.matt), mask)
    geometry = calibrated.geometry
    if kind == "photograph":
        assert file is not None
        photograph = np.maximum(read_picture(file, colour)[..., :3], 0)
        make = partial(wrap_photograph, photograph, look=PrintLook(**options))
    else:
        maker, look = _MAKERS[kind]
        make = partial(maker, look=look(**options))
    return through_camera(on_each(mask, lambda piece: in_box(geometry, piece, make), calibrated.objects(mask)))


def _sheet(file: Path, colour: ColourSpace | None) -> FloatImage:
    """(rows, columns, 4): with alpha, also where the file has none."""
    sheet = np.maximum(read_picture(file, colour, soft=True), 0)
    return sheet if sheet.shape[2] == 4 else np.dstack([sheet, np.ones(sheet.shape[:2], np.float32)])


PREFIX: Final = "builtin:"
RENDER_S: Final = 40.0
"""At size small on the reference machine."""


def blender_request(
    name: str, calibrated: Calibrated, options: Mapping[str, Any], inputs: Mapping[str, str], *, folder: Path
) -> AppearanceRequest:
    """A request whose target is rendered from ``options``: ``scene``, ``builtin:NAME`` (default: marble) or a .blend
    file relative to ``folder``; ``samples`` and ``seed``.

    Raises UsageError with code "blender-missing", "blender-scene-unknown" or "target-missing".
    """
    scene = _scene(str(options.get("scene", "builtin:marble")), folder)
    if calibrated.camera_px is not None:
        require_shape(calibrated.folder, f"The scene {name}")
    blender = find_blender()
    usual = RenderSettings()
    settings = RenderSettings(int(options.get("samples", usual.samples)), int(options.get("seed", usual.seed)))
    facts = dict(inputs) if isinstance(scene, str) else {**inputs, "file": sha256_of(scene)}

    def prepare(context: Context) -> Sequence[Path]:
        works = [render_folder(folder, name) for folder in (context.folder, *calibrated.folders[1:])]
        light, matt = calibrated.transport.reach(), calibrated.matt
        paint = own_paint(calibrated.geometry, light if matt is None else light * matt)
        parts, geometries = [view.part for view in calibrated.views()], calibrated.geometries()
        masks = [part(calibrated.transport.object_mask) for part in parts]
        for work, geometry, mask, part in zip(works, geometries, masks, parts, strict=True):
            work.mkdir(exist_ok=True)
            write_job(work, geometry, mask, part(paint), scene=scene, settings=settings)
        light_alike(works)
        pictures = []
        for n, work in enumerate(works):

            def advance(share: float, note: str, n: int = n) -> None:
                context.advance((n + share) / len(works), note)

            pictures.append(read_picture(render(blender, work, advance)))
        seen = as_seen(pictures, [geometry.camera for geometry in geometries], masks)
        images, said = ([getattr(one, key) for one in seen] for key in ("image", "mask"))
        return [write_target(context.folder, name, Target(calibrated.joined(images), calibrated.joined(said)))]

    def target() -> Target:
        return read_target(calibrated.folder, name)

    return AppearanceRequest(name, f"{name}, rendered by Blender", target, facts, prepare, RENDER_S)


def scene_request(calibrated: Calibrated, scene: str, *, folder: Path) -> AppearanceRequest:
    """The request for a scene given on the command line; ``builtin:marble`` is called marble, a file by its name."""
    name = scene.removeprefix(PREFIX) if scene.startswith(PREFIX) else Path(scene).stem
    return blender_request(name, calibrated, {"scene": scene}, {"kind": "blender", "scene": scene}, folder=folder)


def _scene(scene: str, folder: Path) -> str | Path:
    """The name of a built-in scene, or the file. Raises as ``blender_request``."""
    if scene.startswith(PREFIX):
        builtin = scene.removeprefix(PREFIX)
        if builtin not in BUILTIN:
            raise UsageError(
                "blender-scene-unknown",
                what=f"The scene {scene!r} is unknown.",
                remedy=f"Choose one of {', '.join(PREFIX + known for known in BUILTIN)}, or give a .blend file.",
            )
        return builtin
    file = folder / os.fspath(scene)
    if not file.is_file():
        raise UsageError(
            "target-missing",
            what=f"The scene file {file} does not exist.",
            remedy="Add the file, or correct `scene`. Paths are relative to the stage's folder.",
        )
    return file
