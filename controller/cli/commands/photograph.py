"""``velatura photograph``."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from typing import TYPE_CHECKING, Annotated, Any

import typer

from controller.cli.running import Json, StageFolder, appearance_names, work

if TYPE_CHECKING:
    from controller.run.progress import Reporter


def photograph(
    stage: StageFolder,
    names: Annotated[
        list[str] | None,
        typer.Argument(help="Appearances of the installed bundle (default: all).", autocompletion=appearance_names),
    ] = None,
    as_json: Json = False,
) -> None:
    """Photograph the installed appearances, compare them with their targets, and write a report."""

    def do(reporter: Reporter, cancel: threading.Event) -> Mapping[str, Any]:
        from controller.stage.services.compare import photograph
        from controller.stage.sessions.session import OwnSession

        return photograph(session=OwnSession(stage), names=tuple(names or ()), reporter=reporter, cancel=cancel)

    work(do, as_json=as_json, stage=stage)
