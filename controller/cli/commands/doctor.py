"""``velatura doctor``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from controller.cli import console
from controller.cli.running import Json

DEVICE_FAILED = 3


def doctor(
    stage: Annotated[
        Path | None,
        typer.Argument(metavar="[STAGE]", help="The stage's folder; without it, only what is plugged in is told."),
    ] = None,
    write: Annotated[bool, typer.Option("--write", help="Put what was found into STAGE/stage.toml.")] = False,
    outputs: Annotated[
        bool,
        typer.Option("--outputs", help="Light the lamps and find out which projector shows which output."),
    ] = False,
    as_json: Json = False,
) -> int:
    """Find devices on every bus, try them without striking a lamp, and say what is wrong and how to mend it."""
    from controller.core.errors import UsageError
    from controller.doctor.examine import examine
    from controller.doctor.outputs import examine_outputs
    from controller.run.signals import cancelled_by_signals

    if stage is None and (write or outputs):
        raise UsageError(
            "stage-missing", what="No stage was given.", remedy="Give the folder that holds, or is to hold, stage.toml."
        )
    with cancelled_by_signals() as cancel, console.reporter(as_json=as_json) as reporter:
        seen = examine(stage=stage, write_it=write, reporter=reporter, cancel=cancel)
        if outputs and stage is not None:
            seen = examine_outputs(seen, stage=stage, reporter=reporter, cancel=cancel)
    console.show_result(seen.as_json() if as_json else seen.as_text(), as_json=as_json)
    return 0 if seen.healthy else DEVICE_FAILED
