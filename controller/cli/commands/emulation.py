"""``velatura demo``, ``emulate`` and ``record``: work without hardware, and what devices said."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from controller.cli import console
from controller.cli.groups import StageFolder, stage_folders, work
from controller.core.errors import UsageError

if TYPE_CHECKING:
    from controller.run.progress import Reporter


@dataclass(frozen=True, slots=True)
class DeviceChoice:
    """How many devices an emulated stage has."""

    projectors: Annotated[int | None, typer.Option(help="How many projectors (default: 3, painting 2).", min=1)] = None
    cameras: Annotated[int, typer.Option(help="How many cameras; from 4, all around the object.", min=1, max=8)] = 1


def demo(
    devices: DeviceChoice,
    size: Annotated[
        Literal["small", "medium", "paper", "uhd"], typer.Option(help="Size of projectors and camera.")
    ] = "small",
    object: Annotated[  # noqa: A002 - the option's name is fixed
        str | None, typer.Option(help="painting, relief, statue, or a mesh, .obj or .ply (default: a vase and a bust).")
    ] = None,
    out: Annotated[Path, typer.Option(help="Folder for the stage and the report.")] = Path("demo"),
    seed: Annotated[int, typer.Option(help="Random seed of the stage.", min=0, max=2**32 - 1)] = 1,
    room: Annotated[
        Literal["dark", "room", "hard"],
        typer.Option(help="Light: from the projectors alone, also from the room, or with every fault (velatura-lab)."),
    ] = "room",
    prepare_only: Annotated[bool, typer.Option("--prepare-only", help="Only write OUT/stage.")] = False,
) -> None:
    """Run a complete job on an emulated stage, up to the report."""

    def do(reporter: Reporter, cancel: threading.Event) -> Mapping[str, Any]:
        from controller.demo import DemoStage, prepare

        stage = prepare(out.resolve(), DemoStage(size, seed, object, room, devices.projectors, devices.cameras))
        if prepare_only:
            from controller.stage.sessions.check import check_stage

            check_stage(stage)
            return {"stage": str(stage)}
        # Only now: all that the job uses takes seconds to import.
        from controller.demo import demo

        return demo(stage, reporter=reporter, cancel=cancel)

    work(do)


def emulate(
    stage: Annotated[
        Path | None, typer.Argument(metavar="STAGE", help="The stage's folder.", autocompletion=stage_folders)
    ] = None,
    tape: Annotated[Path | None, typer.Option(help="Replay the devices of a tape (`velatura record`).")] = None,
    scenario: Annotated[
        Path | None, typer.Option(help="A script of faults (see docs/how-to/emulated-devices.md).")
    ] = None,
    until_input_ends: Annotated[
        bool, typer.Option("--until-input-ends", help="Also stop when standard input is closed.")
    ] = False,
) -> int:
    """Run the emulated devices of a stage, or of a tape. Prints their addresses, and runs until Ctrl-C."""
    from controller.stage.sessions.bench import bench_of, terminated_when_input_ends

    if tape is not None:
        if until_input_ends:
            terminated_when_input_ends()
        return bench_of(stage or Path.cwd()).replay(tape, json_lines=console.as_json())
    if stage is None or not stage.is_dir():
        raise UsageError(
            "stage-missing",
            what=f"The folder {stage} does not exist.",
            remedy="Give the stage's folder. `velatura demo --prepare-only` creates one.",
        )
    if until_input_ends:
        terminated_when_input_ends()
    return bench_of(stage).serve(stage, json_lines=console.as_json(), scenario=scenario)


def record(
    stage: StageFolder,
    command: Annotated[
        list[str] | None,
        typer.Argument(help="The command to record, after --: `-- calibrate STAGE` (default: `doctor STAGE`)."),
    ] = None,
    out: Annotated[Path | None, typer.Option(help="The tape (default: a new file in STAGE/tapes).")] = None,
) -> int:
    """Record all device traffic of a command on a tape. It has no passwords; `velatura emulate --tape` replays it."""
    from controller.stage.sessions.run import VARIABLE, new_tape

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
    console.show_result({"tape": str(tape) if tape.is_file() else None, "exit_code": code}, text)
    return code
