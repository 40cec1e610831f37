"""``velatura study``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from controller.commands.running import Json, work


def study(
    names: Annotated[
        list[str] | None, typer.Argument(help="Experiments, for example ablation; without names all but optional ones.")
    ] = None,
    size: Annotated[str, typer.Option(help="small, medium or paper.")] = "small",
    out: Annotated[Path, typer.Option(help="Where the stages and their calibrations are kept.")] = Path("study"),
    pages: Annotated[Path | None, typer.Option(help="Where the pages go; else into OUT/pages.")] = None,
    seed: Annotated[int, typer.Option(help="Which of the random stages.", min=0, max=2**32 - 1)] = 1,
    as_json: Json = False,
) -> None:
    """Do the paper's experiments again on emulated stages, and write a page for each; goes on with unfinished ones."""
    work(
        "controller.study_services:study", as_json=as_json,
        names=tuple(names or ()), size=size, out=out, pages=pages, seed=seed,
    )  # fmt: skip
