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
    file: Annotated[Path, typer.Argument(metavar="PLAN.toml", help="Object, projectors, places and what is wanted.")],
    out: Annotated[Path | None, typer.Option(help="The folder for plan.html and plan.json; else the file's.")] = None,
    example: Annotated[bool, typer.Option("--example", help="Write a PLAN.toml to begin with; plan nothing.")] = False,
    as_json: Json = False,
) -> None:
    """Choose where projectors stand, before there is a stage: predicted detail, light, grazing and focus on a mesh."""
    if example:
        from controller.services.plan import write_example

        console.show_result(write_example(file), as_json=as_json)
        return

    def do(reporter: Reporter, cancel: threading.Event) -> Mapping[str, Any]:
        from controller.services.plan import plan

        return plan(file=file, out=file.parent if out is None else out, reporter=reporter, cancel=cancel)

    work(do, as_json=as_json)
