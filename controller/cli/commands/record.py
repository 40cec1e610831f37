"""`velatura record`: another command, with all device traffic on a tape."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Annotated

import typer

from controller.cli import console
from controller.cli.running import StageFolder


def record(
    stage: StageFolder,
    command: Annotated[
        list[str] | None,
        typer.Argument(help="The command to record, after --: `-- calibrate STAGE` (default: `doctor STAGE`)."),
    ] = None,
    out: Annotated[Path | None, typer.Option(help="The tape (default: a new file in STAGE/tapes).")] = None,
) -> int:
    """Record all device traffic of a command on a tape, without passwords; `velatura emulate --tape` replays it."""
    from controller.core.errors import UsageError
    from controller.stage.sessions.recording import VARIABLE, new_tape

    if not (stage / "stage.toml").is_file():
        raise UsageError(
            "stage-missing",
            what=f"The folder {stage} has no stage.toml.",
            remedy="Give the stage's folder. `velatura init` makes one.",
        )
    tape = out.absolute() if out is not None else new_tape(stage.absolute(), time.strftime("%Y-%m-%d-%H%M%S"))
    words = command or ["doctor", str(stage)]
    # Ctrl-C is for the recorded command, which cools its lamps; this one waits for it.
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        begun = [sys.executable, "-m", "controller", *words]
        code = subprocess.Popen(  # noqa: S603 - this Python, with our own program
            begun,
            env={**os.environ, VARIABLE: str(tape)},
            preexec_fn=lambda: signal.signal(signal.SIGINT, before),  # noqa: PLW1509
        ).wait()
    finally:
        signal.signal(signal.SIGINT, before)
    text = f"The tape is {tape}." if tape.is_file() else "The command opened no device, so there is no tape."
    console.show_result(text, as_json=False)
    return code
