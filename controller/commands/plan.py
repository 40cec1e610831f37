"""``velatura plan``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from controller import console
from controller.commands.running import Json, work


def plan(
    file: Annotated[Path, typer.Argument(metavar="PLAN.toml", help="Object, projectors, places and what is wanted.")],
    out: Annotated[Path | None, typer.Option(help="The folder for plan.html and plan.json; else the file's.")] = None,
    example: Annotated[bool, typer.Option("--example", help="Write a PLAN.toml to begin with; plan nothing.")] = False,
    as_json: Json = False,
) -> None:
    """Choose where projectors stand, before there is a stage: predicted detail, light, grazing and focus on a mesh."""
    if example:
        from controller.plan_services import write_example

        console.show_result(write_example(file), as_json=as_json)
        return
    work("controller.plan_services:plan", as_json=as_json, file=file, out=file.parent if out is None else out)
