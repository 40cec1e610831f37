"""Blender renderings as steps of a run: with progress, stopped at once, not repeated on resuming."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from controller.core.errors import UsageError
from controller.core.storage import sha256_of
from controller.optics.solve.targets.files import read_picture
from controller.optics.solve.targets.values import Target
from controller.run.runner import Context
from controller.stage.artefacts.calibrated import Calibrated
from controller.stage.artefacts.geometry import read_geometry
from controller.stage.artefacts.solved import read_target, render_folder, write_target
from controller.stage.blender.job import BUILTIN, RenderSettings, as_seen, write_job
from controller.stage.blender.run import find_blender, render
from controller.stage.steps.appearance.solving import AppearanceRequest

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
    scene = str(options.get("scene", "builtin:marble"))
    builtin, file = _scene(scene, folder)
    blender = find_blender()
    usual = RenderSettings()
    settings = RenderSettings(int(options.get("samples", usual.samples)), int(options.get("seed", usual.seed)))
    facts = dict(inputs) if file is None else {**inputs, "file": sha256_of(file)}

    def prepare(context: Context) -> Sequence[Path]:
        work = render_folder(context.folder, name)
        work.mkdir(exist_ok=True)
        geometry, mask = read_geometry(calibrated.folder, calibrated.projectors), calibrated.transport.object_mask
        write_job(
            work, geometry, mask, calibrated.transport.reach(), builtin=builtin, scene_file=file, settings=settings
        )
        picture = render(blender, work, context.advance)
        return [write_target(context.folder, name, as_seen(read_picture(picture), geometry.camera, mask))]

    def target() -> Target:
        return read_target(calibrated.folder, name)

    return AppearanceRequest(name, f"{name}, rendered by Blender", target, facts, prepare, RENDER_S)


def scene_request(calibrated: Calibrated, scene: str, *, folder: Path) -> AppearanceRequest:
    """The request for a scene given on the command line; ``builtin:marble`` is called marble, a file by its name."""
    name = scene.removeprefix(PREFIX) if scene.startswith(PREFIX) else Path(scene).stem
    return blender_request(name, calibrated, {"scene": scene}, {"kind": "blender", "scene": scene}, folder=folder)


def _scene(scene: str, folder: Path) -> tuple[str | None, Path | None]:
    if scene.startswith(PREFIX):
        builtin = scene.removeprefix(PREFIX)
        if builtin not in BUILTIN:
            raise UsageError(
                "blender-scene-unknown",
                what=f"The scene {scene!r} is unknown.",
                remedy=f"Choose one of {', '.join(PREFIX + known for known in BUILTIN)}, or give a .blend file.",
            )
        return builtin, None
    file = folder / os.fspath(scene)
    if not file.is_file():
        raise UsageError(
            "target-missing",
            what=f"The scene file {file} does not exist.",
            remedy="Add the file, or correct `scene`. Paths are relative to the stage's folder.",
        )
    return None, file
