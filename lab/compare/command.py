"""``velatura compare``."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from controller.cli.groups import BenchSize, Seeds, work

if TYPE_CHECKING:
    from controller.run.progress import Reporter


def compare(
    method: Annotated[
        list[str] | None,
        typer.Option(help="A method's name, module:function or file.py:function; repeat it for more (default: all)."),
    ] = None,
    scene: Annotated[
        list[str] | None, typer.Option(help="dark, flat, room or traced; repeat it for more (default: all).")
    ] = None,
    size: BenchSize = "small",
    out: Annotated[Path, typer.Option(help="Folder for the stages, the page and the results.")] = Path("comparison"),
    seed: Seeds = None,
    photographs: Annotated[
        Path | None,
        typer.Option(help="Learned methods, on a folder of real photographs instead of scenes."),
    ] = None,
) -> None:
    """Compare methods on fixed emulated scenes. Judges photographs of what they make. Continues unfinished work."""

    def do(reporter: Reporter, cancel: threading.Event) -> Mapping[str, Any]:
        if photographs is not None:
            from lab.compare.entries import LEARNED, LEARNED_GROUP, entries
            from lab.compare.photographs import compare_on_photographs

            learned = entries(tuple(method or ()), LEARNED, LEARNED_GROUP)
            return compare_on_photographs(learned, photographs, out, reporter, cancel)
        from lab.compare.service import compare

        return compare(
            methods=tuple(method or ()),
            scene_names=tuple(scene or ()),
            size=size,
            out=out,
            seeds=seed or [1],
            reporter=reporter,
            cancel=cancel,
        )

    work(do)
