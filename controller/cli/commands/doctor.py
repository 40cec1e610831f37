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
        typer.Argument(metavar="[STAGE]", help="The stage's folder (without it: only list connected devices)."),
    ] = None,
    write: Annotated[bool, typer.Option("--write", help="Write the devices found to STAGE/stage.toml.")] = False,
    outputs: Annotated[
        bool,
        typer.Option("--outputs", help="Switch the lamps on and find which output each projector shows."),
    ] = False,
    network: Annotated[
        str,
        typer.Option(
            "--network",
            metavar="INTERFACE",
            help="Also search for projectors on this network interface (such as eth0), or on all. Without it, "
            "nothing is sent except to the stage's own devices.",
        ),
    ] = "",
    as_json: Json = False,
) -> int:
    """Find and test the connected devices without switching a lamp on. Report faults and how to correct them."""
    from controller.core.errors import UsageError
    from controller.run.signals import cancelled_by_signals
    from controller.stage.doctor.examine import examine
    from controller.stage.doctor.outputs import examine_outputs

    if stage is None and (write or outputs):
        raise UsageError(
            "stage-missing", what="No stage was given.", remedy="Give the folder of stage.toml, existing or new."
        )
    with cancelled_by_signals() as cancel, console.reporter(as_json=as_json) as reporter:
        seen = examine(stage=stage, write_it=write, reporter=reporter, cancel=cancel, network=network)
        if outputs and stage is not None:
            seen = examine_outputs(seen, stage=stage, reporter=reporter, cancel=cancel)
    console.show_result(seen.as_json() if as_json else seen.as_text(), as_json=as_json)
    return 0 if seen.healthy else DEVICE_FAILED
