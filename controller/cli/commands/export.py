"""``velatura export``: the object or the stage for other programs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from controller.cli import console
from controller.cli.running import Json
from controller.stage.exchange.formats import FORMATS


def export(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="Folder of a finished calibration: STAGE/runs/...")],
    kind: Annotated[
        str, typer.Option("--format", help="; ".join(f"{one.name}: {one.what}" for one in FORMATS) + ".")
    ] = "glb",
    out: Annotated[Path | None, typer.Option(help="Output file or folder (default: in the run's folder).")] = None,
    step: Annotated[
        int | None, typer.Option(help="Use every n-th camera pixel (default: at most 10^6 pixels).", min=1)
    ] = None,
    crop: Annotated[
        str | None, typer.Option(help="For transport: only X,Y,WIDTH,HEIGHT of the camera's picture.")
    ] = None,
    as_json: Json = False,
) -> None:
    """Export a calibration: the object, the views of camera and projectors, warps, or the light transport."""
    from controller.stage.services.export import export as written

    console.show_result(written(run=run, kind=kind, out=out, step=step, crop=crop), as_json=as_json)
