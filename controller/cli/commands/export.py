"""``velatura export``: the object or the stage for other programs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from controller.cli import console
from controller.cli.running import Json


def export(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="Folder of a finished calibration: STAGE/runs/...")],
    kind: Annotated[
        str, typer.Option("--format", help="glb, ply, or blender (a folder with object.glb and scene.py).")
    ] = "glb",
    out: Annotated[
        Path | None, typer.Option(help="Output file, or folder for blender (default: in the run's folder).")
    ] = None,
    step: Annotated[
        int | None, typer.Option(help="Use every n-th camera pixel (default: at most 10^6 pixels).", min=1)
    ] = None,
    as_json: Json = False,
) -> None:
    """Export the reconstructed object with normals and texture coordinates, or the whole stage for Blender."""
    from controller.services.export import export as written

    console.show_result(written(run=run, kind=kind, out=out, step=step), as_json=as_json)
