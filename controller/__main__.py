"""The command line. A command parses its arguments, calls one function elsewhere and prints the result.

Heavy imports are inside the commands, so that ``velatura --help`` is fast.
"""

from __future__ import annotations

import functools
import sys
import threading
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

from controller.cli.plain_install import run_without_commands
from controller.core.extras import EXTRA_OF

try:
    import typer
except ModuleNotFoundError as missing:  # an installation with only the player
    if missing.name not in EXTRA_OF:
        raise
    sys.exit(run_without_commands(sys.argv[1:], missing.name))

from controller.cli import console, derived
from controller.cli.commands import accounts as account_commands
from controller.cli.commands import bundle as bundle_commands
from controller.cli.commands import camera as camera_commands
from controller.cli.commands import installation as installation_commands
from controller.cli.commands import kiosk as kiosk_commands
from controller.cli.commands import serve as serve_commands
from controller.cli.commands.doctor import doctor
from controller.cli.commands.drift import drift
from controller.cli.commands.export import export
from controller.cli.commands.keys import keys
from controller.cli.commands.live import live
from controller.cli.commands.photograph import photograph
from controller.cli.commands.plan import plan
from controller.cli.commands.record import record
from controller.cli.commands.report import report
from controller.cli.error_reports import DONE, FAILED, report_error
from controller.cli.running import Json, StageFolder, group, projector_names, work
from controller.core.errors import UsageError
from hal.runtime.caches import prepare_libraries

if TYPE_CHECKING:
    from controller.run.progress import Reporter

__all__ = ["COMMANDS", "GROUPS", "Json", "StageFolder", "application", "main", "run", "work"]

AcceptGrade = Annotated[
    bool, typer.Option("--accept-grade", help="Accept a calibration below the grade in stage.toml.")
]

SUMMARY: Final = "Gives a physical object a new appearance with light from several superimposed projectors."


def states(
    mermaid: Annotated[bool, typer.Option("--mermaid", help="Print a Mermaid diagram.")] = False,
) -> None:
    """Show the states of a stage and the events between them."""
    from controller.run.state_machine import TRANSITIONS
    from controller.run.state_machine import mermaid as diagram

    lines = (f"{before.value:12} {event.value:14} -> {after.value}" for (before, event), after in TRANSITIONS.items())
    console.show_result(diagram() if mermaid else "\n".join(lines), as_json=False)


def demo(
    size: Annotated[str, typer.Option(help="small, medium, paper or uhd.")] = "small",
    object: Annotated[  # noqa: A002 - the option's name is fixed
        Path | None, typer.Option(help="Mesh of the object, .obj or .ply (default: a vase and a bust).")
    ] = None,
    out: Annotated[Path, typer.Option(help="Folder for the stage and the report.")] = Path("demo"),
    seed: Annotated[int, typer.Option(help="Random seed of the stage.", min=0, max=2**32 - 1)] = 1,
    room: Annotated[str | None, typer.Option(help="Light of the stage: dark, room or hard (default: room).")] = None,
    prepare_only: Annotated[bool, typer.Option("--prepare-only", help="Only write OUT/stage.")] = False,
    as_json: Json = False,
) -> None:
    """Run a complete job on an emulated stage, from cold lamps to the report."""

    def do(reporter: Reporter, cancel: threading.Event) -> Mapping[str, Any]:
        from controller.demo.stage import DEFAULT_ROOM, prepare

        stage = prepare(out.resolve(), size=size, object_file=object, seed=seed, room=room or DEFAULT_ROOM)
        if prepare_only:
            from controller.stage.sessions.check import check_stage

            check_stage(stage)
            return {"stage": str(stage)}
        # Only now: all that the job uses takes seconds to import.
        from controller.demo.job import demo

        return demo(stage, reporter=reporter, cancel=cancel)

    work(do, as_json=as_json)


def emulate(
    stage: Annotated[Path | None, typer.Argument(metavar="STAGE", help="The stage's folder.")] = None,
    tape: Annotated[Path | None, typer.Option(help="Replay the devices of a tape (`velatura record`).")] = None,
    scenario: Annotated[
        Path | None, typer.Option(help="A script of faults (see docs/how-to/emulated-devices.md).")
    ] = None,
    until_input_ends: Annotated[
        bool, typer.Option("--until-input-ends", help="Also stop when standard input is closed.")
    ] = False,
    as_json: Json = False,
) -> int:
    """Run the emulated devices of a stage, or those of a tape, and print their addresses, until Ctrl-C."""
    from controller.stage.sessions.bench import bench_of, terminated_when_input_ends

    if tape is not None:
        if until_input_ends:
            terminated_when_input_ends()
        return bench_of(stage or Path.cwd()).replay(tape, json_lines=as_json)
    if stage is None or not stage.is_dir():
        raise UsageError(
            "stage-missing",
            what=f"The folder {stage} does not exist.",
            remedy="Give the stage's folder. `velatura demo --prepare-only` creates one.",
        )
    if until_input_ends:
        terminated_when_input_ends()
    return bench_of(stage).serve(stage, json_lines=as_json, scenario=scenario)


def calibrate(
    stage: StageFolder,
    mode: Annotated[
        str, typer.Option(help="fast (sinusoids), paper (dots everywhere), auto (dots at depth edges).")
    ] = "fast",
    dot_spacing: Annotated[
        str | None, typer.Option(help='Projector pixels between dots, or "auto" (from the blur).')
    ] = None,
    photographs: Annotated[
        str | None,
        typer.Option(
            help="full; few (white instead of opposite pictures, code in colours); fewest (few, and no code where "
            "nothing moved). Default: from stage.toml."
        ),
    ] = None,
    quick: Annotated[bool, typer.Option("--quick", help="Redo only what changed since the last calibration.")] = False,
    projector: Annotated[
        str | None,
        typer.Option(help="Recalibrate only this projector.", autocompletion=projector_names),
    ] = None,
    accept_grade: AcceptGrade = False,
    as_json: Json = False,
) -> None:
    """Photograph patterns and calibrate the stage. Continues an unfinished calibration."""

    def do(reporter: Reporter, cancel: threading.Event) -> Mapping[str, Any]:
        from controller.stage.services.calibrate import calibrate
        from controller.stage.services.recalibrate import recalibrate
        from controller.stage.sessions.session import OwnSession

        session = OwnSession(stage)
        if quick or projector is not None:
            return recalibrate(
                session=session, accept_grade=accept_grade, projector=projector, photographs=photographs,
                reporter=reporter, cancel=cancel,
            )  # fmt: skip
        return calibrate(
            session=session, mode=mode, dot_spacing=dot_spacing, photographs=photographs,
            accept_grade=accept_grade, reporter=reporter, cancel=cancel,
        )  # fmt: skip

    work(do, as_json=as_json, stage=stage)


def appearance(
    stage: StageFolder,
    names: Annotated[list[str] | None, typer.Argument(help="Names from stage.toml (default: all).")] = None,
    blender: Annotated[
        list[str] | None,
        typer.Option(help="Instead: a scene for Blender, builtin:marble, ... or a .blend file."),
    ] = None,
    base: Annotated[
        str | None, typer.Option(help="Base image: minimum, white or high-pass (default: from stage.toml).")
    ] = None,
    quick: Annotated[bool, typer.Option("--quick", help="Only a quick preview, with base times scale.")] = False,
    scheduler: Annotated[
        str | None, typer.Option(help="Solve on a Dask cluster: tcp://host:8786 or tls://host:8786.")
    ] = None,
    refine: Annotated[
        int | None,
        typer.Option(help="Photographs that correct each result (default: from stage.toml).", min=0, max=9),
    ] = None,
    device: Annotated[
        str | None, typer.Option(help="What solves: auto, cpu or gpu (default: from stage.toml).")
    ] = None,
    accept_grade: AcceptGrade = False,
    as_json: Json = False,
) -> None:
    """Solve appearances with the latest calibration, refine them by photographs, and publish a signed bundle."""

    def do(reporter: Reporter, cancel: threading.Event) -> Mapping[str, Any]:
        from controller.stage.services.calibrate import make_appearances
        from controller.stage.services.refine import refinement_of
        from controller.stage.sessions.session import OwnSession

        return make_appearances(
            session=OwnSession(stage), names=tuple(names or ()), scenes=tuple(blender or ()),
            accept_grade=accept_grade, base=base, scheduler=scheduler, quick=quick,
            refinement=refinement_of(stage, refine, quick=quick), device=device, reporter=reporter, cancel=cancel,
        )  # fmt: skip

    work(do, as_json=as_json, stage=stage)


def play(
    stage: StageFolder,
    names: Annotated[list[str] | None, typer.Argument(help="The appearances to show, one after the other.")] = None,
    sequence: Annotated[Path | None, typer.Option(help="Instead: a TOML file with [[item]] tables.")] = None,
    seconds: Annotated[
        float,
        typer.Option(help="Seconds per appearance (several: 10; one: until Ctrl-C).", min=0, show_default=False),
    ] = 0.0,
    fade: Annotated[float, typer.Option(help="Cross-fade in seconds.", min=0, max=600)] = 0,
    repeat: Annotated[
        int, typer.Option(help="How often the playlist repeats (default: until Ctrl-C).", min=0, show_default=False)
    ] = 0,
    as_json: Json = False,
) -> None:
    """Switch the projectors on and show appearances of the installed bundle."""

    def do(reporter: Reporter, cancel: threading.Event) -> Mapping[str, Any]:
        from controller.stage.services.play import play
        from controller.stage.sessions.session import OwnSession

        return play(
            session=OwnSession(stage), names=tuple(names or ()), sequence=sequence, seconds=seconds or None,
            fade_s=fade, repeat=repeat, reporter=reporter, cancel=cancel,
        )  # fmt: skip

    work(do, as_json=as_json, stage=stage)


COMMANDS: Final[tuple[Callable[..., Any], ...]] = (
    demo,
    doctor,
    calibrate,
    drift,
    appearance,
    play,
    photograph,
    live,
    keys,
    emulate,
    record,
    export,
    plan,
    report,
    states,
    *serve_commands.COMMANDS,
    *kiosk_commands.COMMANDS,
    *derived.commands(),
)
"""Every command: the function's name is the command, its docstring the help, its parameters the options."""

GROUPS: Final[Mapping[str, tuple[str, tuple[Callable[..., Any], ...]]]] = {
    "account": (account_commands.SUMMARY, account_commands.COMMANDS),
    "bundle": (bundle_commands.SUMMARY, bundle_commands.COMMANDS),
    "camera": (camera_commands.SUMMARY, camera_commands.COMMANDS),
    "kiosk": (installation_commands.SUMMARY, installation_commands.COMMANDS),
}
"""Commands of two words: the first word, what the group is for, and its commands."""


def application(commands: tuple[Callable[..., Any], ...] = COMMANDS) -> typer.Typer:
    """The command line with these commands and all groups."""
    app = group("velatura", SUMMARY, commands, whole=True)
    for name, (summary, members) in GROUPS.items():
        app.add_typer(group(name, summary, members), name=name)
    return app


@functools.cache
def _built(commands: tuple[Callable[..., Any], ...]) -> Callable[..., Any]:
    """All commands with their options, read once from the functions: that takes longer than most commands."""
    return typer.main.get_command(application(commands))


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line and exit with a code of ``cli.error_reports``."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    console.prepare_streams()
    prepare_libraries()
    sys.exit(run(given))


def run(arguments: Sequence[str]) -> int:
    """Run one command and return its exit code. Errors have been shown."""
    as_json = "--json" in arguments
    try:
        outcome = _built(COMMANDS)(args=list(arguments) or ["--help"], prog_name="velatura", standalone_mode=False)
        sys.stdout.flush()
    except SystemExit as exiting:  # raised by the command-line library when the reader of our output has closed it
        return exiting.code if isinstance(exiting.code, int) else FAILED
    except BaseException as error:  # noqa: BLE001 - the last boundary: no caller could show it
        return report_error(error, as_json=as_json)
    return outcome if isinstance(outcome, int) else DONE


if __name__ == "__main__":
    main()
