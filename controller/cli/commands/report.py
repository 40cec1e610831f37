"""``velatura report``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from controller.cli import console
from controller.cli.running import Json


def report(
    where: Annotated[
        Path, typer.Argument(metavar="RUN", help="A run's folder (STAGE/runs/...), or a stage for its newest run.")
    ],
    out: Annotated[Path | None, typer.Option(help="Folder for the report (default: the run's folder).")] = None,
    as_json: Json = False,
) -> None:
    """Write report.html and report.json again for a calibration, for photographs, or for a demo."""
    from controller.stage.services.report import report_of

    console.show_result(report_of(where, out), as_json=as_json)
