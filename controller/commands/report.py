"""``velatura report``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from controller import console
from controller.commands.running import Json


def report(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="The folder of a demo's run: STAGE/runs/...-demo.")],
    out: Annotated[Path | None, typer.Option(help="Where the report goes; else into the run's folder.")] = None,
    as_json: Json = False,
) -> None:
    """Write report.html and report.json of a finished demo again."""
    from controller.demo.report import report_again

    console.show_result(report_again(run, run if out is None else out), as_json=as_json)
