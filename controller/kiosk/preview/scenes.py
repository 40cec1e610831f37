"""The scenes that Blender can render on the calibrated object, and a quick look at one before it is computed."""

from __future__ import annotations

import json
import os
import re
import tempfile
import threading
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from controller.core.errors import UsageError
from controller.core.storage import sha256_of, write_atomically
from controller.kiosk.preview import reach
from controller.kiosk.values import Reach, Scene
from controller.stage.sessions.calibrations import finished_calibration
from controller.stage.sessions.check import Checked

if TYPE_CHECKING:
    from controller.kiosk.preview.preview_light import PreviewLight
    from controller.optics.calibrate.values import Pinhole

FOLDER: Final = "kiosk/scenes"
OWN: Final = "scenes"
"""The stage's folder of the user's own scenes, .blend files."""
SHIPPED: Final = Path(__file__).parents[2] / "stage" / "blender" / "pictures"
"""A small picture of each scene that comes with Velatura, on the object of the demo."""
NAME: Final = r"[A-Za-z0-9][A-Za-z0-9 ._-]{0,47}"
MOST_OWN: Final = 24
SAMPLES: Final = 24
"""A pixel; the denoiser does the rest. The computation takes its own number of samples."""
_one_at_a_time = threading.Lock()


def scenes(stage: Path) -> tuple[Scene, ...]:
    """Those that come with Velatura, then the stage's own by name."""
    from controller.stage.blender.job import BUILTIN

    own = sorted(file.name for file in (stage / OWN).glob("*.blend") if re.fullmatch(NAME, file.name))
    return tuple(Scene(name, name in BUILTIN, _picture(stage, name)) for name in (*BUILTIN, *own[:MOST_OWN]))


def _picture(stage: Path, name: str) -> Path | None:
    """On the stage's own object, once it was looked at; else on the demo's."""
    found = (stage / reach.FOLDER / _stem(name) / reach.FILES["result"], SHIPPED / f"{name}.jpg")
    return next((file for file in found if file.is_file()), None)


def entry(stage: Path, name: str, scene: str) -> Mapping[str, str]:
    """The table of ``[[appearances]]`` in stage.toml that renders ``scene``. Raises UsageError("scene-unknown")."""
    known = next((one for one in scenes(stage) if one.name == scene), None)
    if known is None:
        raise UsageError("scene-unknown", what=f"There is no scene {scene[:64]!r}.",
                         remedy=f"Choose one of the list, or copy a .blend file into the folder {OWN}.")  # fmt: skip
    return {"name": name, "kind": "blender", "scene": f"builtin:{scene}" if known.shipped else f"{OWN}/{scene}"}


def scene_reach(checked: Checked, scene: str) -> Reach:
    """As ``reach`` of the picture that Blender renders quickly, and small; kept until calibration or scene change.

    Raises as ``entry``, ``find_blender``, ``render`` and ``reach``.
    """
    of = entry(checked.stage.folder, scene, scene)["scene"]
    with _one_at_a_time:
        target = _rendered(checked, scene, of)
    return reach.reach(checked, target)


def _stem(scene: str) -> str:
    return f"scene-{scene}"


def _rendered(checked: Checked, scene: str, of: str) -> Path:
    stage = checked.stage.folder
    run = finished_calibration(stage)
    file = None if of.startswith("builtin:") else stage / of
    about = {"run": run.name, "scene": of, "file": None if file is None else sha256_of(file)}
    kept = stage / FOLDER / f"{_stem(scene)}.npz"
    facts = kept.with_suffix(".json")
    if kept.is_file() and _read(facts) == about:
        return kept
    kept.parent.mkdir(parents=True, exist_ok=True)
    _render(checked, run, kept, scene if file is None else file)
    write_atomically(facts, json.dumps(about).encode())
    return kept


def _read(facts: Path) -> Any:
    try:
        return json.loads(facts.read_text())
    except (OSError, ValueError):
        return None


def _render(checked: Checked, run: Path, kept: Path, scene: str | Path) -> None:
    """Write the target as the preview's samples see it, into ``kept``."""
    from controller.core.arrays import save_arrays
    from controller.kiosk.preview.preview_light import preview_light
    from controller.optics.solve.targets.files import read_picture
    from controller.stage.artefacts.calibrated import Calibrated
    from controller.stage.artefacts.geometry import read_geometry, require_shape
    from controller.stage.blender.job import RenderSettings, as_seen, own_paint, write_job
    from controller.stage.blender.run import find_blender, render

    require_shape(run, "A scene of Blender")
    blender = find_blender()
    light = preview_light(checked.stage.folder, run, checked.names)
    transport = Calibrated(run, checked.names).transport
    geometry = read_geometry(run, checked.names)
    view = _small(geometry.camera, light)
    # One processor is left for the picture that plays meanwhile.
    settings = RenderSettings(samples=SAMPLES, threads=max(1, (os.cpu_count() or 2) - 1))
    with tempfile.TemporaryDirectory(dir=kept.parent) as scratch:
        work = Path(scratch)
        write_job(work, geometry, transport.object_mask, own_paint(geometry, transport.reach()),
                  scene=scene, settings=settings, view=view)  # fmt: skip
        picture = read_picture(render(blender, work, lambda share, note: None))
    (target,) = as_seen([picture], [view], [light.drive.mask])
    save_arrays(kept, {"image": target.image, "mask": target.mask})


def _small(camera: Pinhole, light: PreviewLight) -> Pinhole:
    """The calibrated camera with as many pixels as the preview has."""
    rows, columns = light.drive.mask.shape
    matrix = camera.matrix.copy()
    matrix[:2] /= light.step
    # Pixel centres lie at whole numbers, in the large picture and in the small one.
    matrix[:2, 2] += 0.5 / light.step - 0.5
    return replace(camera, matrix=matrix, size_px=(columns, rows))
