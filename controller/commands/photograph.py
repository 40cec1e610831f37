"""``velatura photograph``."""

from __future__ import annotations

from typing import Annotated

import typer

from controller.commands.running import Json, StageFolder, appearance_names, work


def photograph(
    stage: StageFolder,
    names: Annotated[
        list[str] | None,
        typer.Argument(
            help="Appearances of the installed bundle; all of them if none is given.", autocompletion=appearance_names
        ),
    ] = None,
    as_json: Json = False,
) -> None:
    """Photograph what the installed appearances achieve, compare with their targets, and write a report."""
    work("controller.comparison_services:photograph", as_json=as_json, stage=stage, names=tuple(names or ()))
