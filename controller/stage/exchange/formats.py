"""Every format of `velatura export`, declared once: its name, what it holds, where it is written, and by what."""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from controller.core.errors import UsageError

if TYPE_CHECKING:
    from controller.stage.exchange.content import Content


@dataclass(frozen=True, slots=True)
class Format:
    """``place``: the file, or the folder, in the run's folder if no other is named.

    ``shape``: whether it needs the object's shape.
    ``writer``: MODULE:FUNCTION, called with the content and the path; it returns figures on what it wrote. It is
    imported when it is used, since most need large libraries.
    """

    name: str
    what: str
    place: str
    writer: str
    shape: bool = True

    def write(self, content: Content, path: Path) -> Mapping[str, Any]:
        module, _, function = self.writer.partition(":")
        figures: Mapping[str, Any] = getattr(importlib.import_module(module), function)(content, path)
        return figures


_HERE: Final = "controller.stage.exchange"
FORMATS: Final = (
    Format("glb", "the object with its picture, poses of camera and projectors (glTF)", "object.glb",
           f"{_HERE}.meshes:write_glb_file"),
    Format("ply", "the object with colours", "object.ply", f"{_HERE}.meshes:write_ply_file"),
    Format("blender", "a folder with object.glb and scene.py", "blender", f"{_HERE}.meshes:write_blender_folder"),
    Format("usd", "the object and all views (.usda)", "stage.usda", f"{_HERE}.meshes:write_usd"),
    Format("colmap", "a folder with COLMAP's text files", "colmap", f"{_HERE}.views:write_text"),
    Format("colmap-binary", "a folder with COLMAP's binary files", "colmap-binary", f"{_HERE}.views:write_binary"),
    Format("opencv", "views and points for OpenCV (YAML)", "stage.yml", f"{_HERE}.views:write_storage"),
    Format("st-maps", "a folder with warps as EXR pictures", "st-maps", f"{_HERE}.warps:write_maps",
           shape=False),
    Format("mpcdi", "a folder with warps and poses for media servers (MPCDI 2.0)", "mpcdi",
           f"{_HERE}.warps:write_mpcdi"),
    Format("transport", "a folder with the light transport as scipy.sparse files", "transport",
           f"{_HERE}.sparse:write_transport", shape=False),
    Format("dataset", "a folder with photographs, calibration, targets and results, for research", "dataset",
           f"{_HERE}.dataset:write_dataset", shape=False),
    Format("uv", "a sheet to paint on: the registered mesh's UV, or the camera's view, with the object's picture (PNG)",
           "sheet.png", f"{_HERE}.meshes:write_sheet", shape=False),
)  # fmt: skip


def format_of(name: str) -> Format:
    """The format of that name. Raises UsageError("export-format-unknown")."""
    for one in FORMATS:
        if one.name == name:
            return one
    raise UsageError(
        "export-format-unknown",
        what=f"The export format {name!r} is unknown.",
        remedy=f"Choose one of {', '.join(one.name for one in FORMATS)}.",
    )
