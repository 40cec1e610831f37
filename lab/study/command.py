"""``velatura study``."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from controller.cli.groups import BenchSize, Seeds, work

if TYPE_CHECKING:
    from controller.run.progress import Reporter


def study(
    names: Annotated[
        list[str] | None, typer.Argument(help="Experiments, for example ablation (default: all except optional ones).")
    ] = None,
    size: BenchSize = "small",
    out: Annotated[Path, typer.Option(help="Folder for the stages and their calibrations.")] = Path("study"),
    pages: Annotated[Path | None, typer.Option(help="Folder for the pages (default: OUT/pages).")] = None,
    seed: Seeds = None,
    list_only: Annotated[bool, typer.Option("--list", help="List the experiments, and end.")] = False,
) -> None:
    """Repeat the paper's experiments on emulated stages. Writes a page for each; continues unfinished experiments."""

    def do(reporter: Reporter, cancel: threading.Event) -> Mapping[str, Any]:
        from lab.study.service import experiments, study

        if list_only:
            return experiments()
        return study(
            names=tuple(names or ()),
            size=size,
            out=out,
            pages=pages,
            seeds=seed or [1],
            reporter=reporter,
            cancel=cancel,
        )

    work(do)
