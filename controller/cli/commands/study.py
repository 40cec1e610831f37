"""``velatura study``."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from controller.cli.running import Json, work

if TYPE_CHECKING:
    from controller.run.progress import Reporter


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

    def do(reporter: Reporter, cancel: threading.Event) -> Mapping[str, Any]:
        from controller.services.study import study

        return study(
            names=tuple(names or ()), size=size, out=out, pages=pages, seed=seed, reporter=reporter, cancel=cancel
        )

    work(do, as_json=as_json)
