"""``velatura plan``."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from controller.cli import console
from controller.cli.running import Json, work

if TYPE_CHECKING:
    from controller.run.progress import Reporter


def plan(
    file: Annotated[
        Path, typer.Argument(metavar="PLAN.toml", help="Plan file: object, projectors, places, requirements.")
    ],
    out: Annotated[
        Path | None, typer.Option(help="Folder for plan.html and plan.json (default: the plan file's folder).")
    ] = None,
    example: Annotated[bool, typer.Option("--example", help="Only write an example PLAN.toml.")] = False,
    as_json: Json = False,
) -> None:
    """Plan projector positions on a mesh: predict detail, light, angle of incidence and focus."""
    if example:
        from controller.stage.services.plan import write_example

        console.show_result(write_example(file), as_json=as_json)
        return

    def do(reporter: Reporter, cancel: threading.Event) -> Mapping[str, Any]:
        from controller.stage.services.plan import plan

        return plan(file=file, out=file.parent if out is None else out, reporter=reporter, cancel=cancel)

    work(do, as_json=as_json)
