"""The command line. Each command is thin: it parses, calls one function elsewhere, and prints what that returns.

Heavy imports happen inside the commands, so that ``velatura --help`` answers at once.
"""

from __future__ import annotations

import os
import platform
import sys
import threading
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

from controller.cli.plain_install import run_without_commands
from controller.core.extras import EXTRA_OF, extra_missing

try:
    import typer
except ModuleNotFoundError as missing:  # a plain installation, which has the player alone
    if missing.name not in EXTRA_OF:
        raise
    sys.exit(run_without_commands(sys.argv[1:], missing.name))

from controller.cli import console, derived
from controller.cli.commands import accounts as account_commands
from controller.cli.commands import bundle as bundle_commands
from controller.cli.commands import camera as camera_commands
from controller.cli.commands import kiosk as kiosk_commands
from controller.cli.commands import serve as serve_commands
from controller.cli.commands.doctor import doctor
from controller.cli.commands.drift import drift
from controller.cli.commands.export import export
from controller.cli.commands.keys import keys
from controller.cli.commands.live import live
from controller.cli.commands.photograph import photograph
from controller.cli.commands.plan import plan
from controller.cli.commands.report import report
from controller.cli.commands.study import study
from controller.cli.running import Json, StageFolder, group, projector_names, work
from controller.core.errors import UsageError, VelaturaError, WorkError
from controller.core.files import file_error
from hal.runtime.caches import prepare_libraries, state_folder, temporary_folder

if TYPE_CHECKING:
    from controller.run.progress import Reporter
    from hal.errors import DeviceError

__all__ = ["COMMANDS", "GROUPS", "Json", "StageFolder", "application", "main", "run", "work"]

AcceptGrade = Annotated[
    bool, typer.Option("--accept-grade", help="Accept a calibration that is worse than stage.toml asks for.")
]

DONE, FAILED, WRONG_USE, DEVICE_FAILED, STOPPED = 0, 1, 2, 3, 130

SUMMARY: Final = "Gives a physical object a new appearance with light from several superimposed projectors."


def states(
    mermaid: Annotated[bool, typer.Option("--mermaid", help="Print the diagram in Mermaid's language.")] = False,
) -> None:
    """Show the states of a stage and what leads from one to the next."""
    from controller.run.state_machine import TRANSITIONS
    from controller.run.state_machine import mermaid as diagram

    lines = (f"{before.value:12} {event.value:14} -> {after.value}" for (before, event), after in TRANSITIONS.items())
    console.show_result(diagram() if mermaid else "\n".join(lines), as_json=False)


def demo(
    size: Annotated[str, typer.Option(help="small, medium or paper.")] = "small",
    object: Annotated[  # noqa: A002 - the option's name is fixed
        Path | None, typer.Option(help="A mesh to put on the stage, .obj or .ply; else a vase and a bust.")
    ] = None,
    out: Annotated[Path, typer.Option(help="Where the stage and the report go.")] = Path("demo"),
    seed: Annotated[int, typer.Option(help="Which of the random stages.", min=0, max=2**32 - 1)] = 1,
    prepare_only: Annotated[bool, typer.Option("--prepare-only", help="Write OUT/stage and stop there.")] = False,
    as_json: Json = False,
) -> None:
    """Do the whole job on an emulated stage, from cold lamps to a report."""

    def do(reporter: Reporter, cancel: threading.Event) -> Mapping[str, Any]:
        from controller.demo.job import demo

        return demo(
            size=size, object_file=object, out=out, seed=seed, prepare_only=prepare_only,
            reporter=reporter, cancel=cancel,
        )  # fmt: skip

    work(do, as_json=as_json)


def emulate(
    stage: StageFolder,
    scenario: Annotated[
        Path | None, typer.Option(help="A script of faults (docs/how-to/emulated-devices.md) that the devices play.")
    ] = None,
    until_input_ends: Annotated[
        bool, typer.Option("--until-input-ends", help="End, too, when standard input is closed.")
    ] = False,
    as_json: Json = False,
) -> int:
    """Serve the emulated devices of a stage, and print the address of each, until Ctrl-C."""
    from controller.stage.bench import bench_of, terminated_when_input_ends

    if not stage.is_dir():
        raise UsageError(
            "stage-missing",
            what=f"There is no folder {stage}.",
            remedy="Give the stage's folder; `velatura demo --prepare-only` makes one.",
        )
    if until_input_ends:
        terminated_when_input_ends()
    return bench_of(stage).serve(stage, json_lines=as_json, scenario=scenario)


def calibrate(
    stage: StageFolder,
    mode: Annotated[
        str, typer.Option(help="fast (sinusoids), paper (dots everywhere) or auto (dots at depth edges).")
    ] = "fast",
    dot_spacing: Annotated[
        str | None, typer.Option(help='Projector pixels between dots, or "auto" for what the blur needs.')
    ] = None,
    quick: Annotated[bool, typer.Option("--quick", help="Look what has changed, and repeat only that.")] = False,
    projector: Annotated[
        str | None,
        typer.Option(
            help="Measure this projector anew, and keep what is known of the others.", autocompletion=projector_names
        ),
    ] = None,
    accept_grade: AcceptGrade = False,
    as_json: Json = False,
) -> None:
    """Photograph patterns and calibrate the stage; goes on with an unfinished calibration."""

    def do(reporter: Reporter, cancel: threading.Event) -> Mapping[str, Any]:
        from controller.services.calibrate import calibrate
        from controller.services.recalibrate import recalibrate
        from controller.stage.session import OwnSession

        session = OwnSession(stage)
        if quick or projector is not None:
            return recalibrate(
                session=session, accept_grade=accept_grade, projector=projector, reporter=reporter, cancel=cancel
            )
        return calibrate(
            session=session, mode=mode, dot_spacing=dot_spacing, accept_grade=accept_grade,
            reporter=reporter, cancel=cancel,
        )  # fmt: skip

    work(do, as_json=as_json)


def appearance(
    stage: StageFolder,
    names: Annotated[
        list[str] | None, typer.Argument(help="Names from stage.toml; all of them if none is given.")
    ] = None,
    blender: Annotated[
        list[str] | None,
        typer.Option(help="Instead, a scene that Blender renders: builtin:marble, ..., or a .blend file."),
    ] = None,
    base: Annotated[
        str | None, typer.Option(help="The base image: minimum, white or high-pass; else as stage.toml says.")
    ] = None,
    quick: Annotated[
        bool, typer.Option("--quick", help="A preview: base times scale alone, whatever detail the target has.")
    ] = False,
    scheduler: Annotated[
        str | None, typer.Option(help="Solve on the workers of a Dask scheduler: tcp://host:8786 or tls://host:8786.")
    ] = None,
    refine: Annotated[
        int | None,
        typer.Option(help="Correct each result by so many photographs of it; else as stage.toml says.", min=0, max=9),
    ] = None,
    accept_grade: AcceptGrade = False,
    as_json: Json = False,
) -> None:
    """Solve appearances on the last calibration, refine them by photographs, and publish them in a signed bundle."""

    def do(reporter: Reporter, cancel: threading.Event) -> Mapping[str, Any]:
        from controller.services.calibrate import make_appearances
        from controller.services.refine import refinement_of
        from controller.stage.session import OwnSession

        return make_appearances(
            session=OwnSession(stage), names=tuple(names or ()), scenes=tuple(blender or ()),
            accept_grade=accept_grade, base=base, scheduler=scheduler, quick=quick,
            refinement=refinement_of(stage, refine, quick=quick), reporter=reporter, cancel=cancel,
        )  # fmt: skip

    work(do, as_json=as_json)


def play(
    stage: StageFolder,
    names: Annotated[list[str] | None, typer.Argument(help="The appearances to show, in turn if several.")] = None,
    sequence: Annotated[Path | None, typer.Option(help="Instead, a TOML file of [[item]] tables.")] = None,
    seconds: Annotated[
        float, typer.Option(help="How long each; without it one until Ctrl-C, of several each 10 s.", min=0)
    ] = 0.0,
    fade: Annotated[float, typer.Option(help="Seconds in which each comes in.", min=0, max=600)] = 0,
    repeat: Annotated[int, typer.Option(help="Rounds of several; without it until Ctrl-C.", min=0)] = 0,
    as_json: Json = False,
) -> None:
    """Light the projectors and show appearances of the installed bundle."""

    def do(reporter: Reporter, cancel: threading.Event) -> Mapping[str, Any]:
        from controller.services.play import play
        from controller.stage.session import OwnSession

        return play(
            session=OwnSession(stage), names=tuple(names or ()), sequence=sequence, seconds=seconds or None,
            fade_s=fade, repeat=repeat, reporter=reporter, cancel=cancel,
        )  # fmt: skip

    work(do, as_json=as_json)


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
    export,
    plan,
    report,
    study,
    states,
    *serve_commands.COMMANDS,
    *kiosk_commands.COMMANDS,
    *derived.commands(),
)
"""Every command. The function's name is the command's, its docstring the help, its annotated parameters the options."""

GROUPS: Final[Mapping[str, tuple[str, tuple[Callable[..., Any], ...]]]] = {
    "account": (account_commands.SUMMARY, account_commands.COMMANDS),
    "bundle": (bundle_commands.SUMMARY, bundle_commands.COMMANDS),
    "camera": (camera_commands.SUMMARY, camera_commands.COMMANDS),
}
"""Commands of two words: the first word, what the group is for, and its commands."""


def application() -> typer.Typer:
    """The command line with every command of the table, and every group of commands."""
    app = group("velatura", SUMMARY, COMMANDS, completion=True)
    for name, (summary, commands) in GROUPS.items():
        app.add_typer(group(name, summary, commands), name=name)
    return app


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line and exit: 0 done, 1 the work failed, 2 wrong use, 3 a device failed, 130 stopped."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    console.prepare_streams()
    prepare_libraries()
    sys.exit(run(given))


def run(arguments: Sequence[str]) -> int:
    """Run one command and return its exit code; every error has been shown by then."""
    as_json = "--json" in arguments
    try:
        outcome = application()(args=list(arguments) or ["--help"], prog_name="velatura", standalone_mode=False)
        sys.stdout.flush()
    except SystemExit as exiting:  # by the command-line library, when the reader of our output went away
        return exiting.code if isinstance(exiting.code, int) else FAILED
    except BaseException as error:  # noqa: BLE001 - the last boundary: nobody above could show it
        return _told(error, as_json=as_json)
    return outcome if isinstance(outcome, int) else DONE


def _told(error: BaseException, *, as_json: bool) -> int:
    """Show ``error`` as two sentences and return the exit code; where the output is lost, say that instead."""
    if isinstance(error, typer.Exit):
        return error.exit_code
    if isinstance(error, OSError) and console.output_lost():
        return FAILED
    try:
        shown = _explained(error)
        if shown is None:
            return _crashed(error, as_json=as_json)
        console.show_error(shown.code, shown.what, shown.remedy, as_json=as_json)
    except OSError:
        if not console.output_lost():
            raise
    else:
        return shown.exit_code
    return FAILED


@dataclass(frozen=True, slots=True)
class _Shown:
    code: str
    what: str
    remedy: str
    exit_code: int


def _explained(error: BaseException) -> _Shown | None:
    """What to tell of ``error``; None for one that should never happen."""
    from hal.deadline import Cancelled
    from hal.errors import DeviceError

    if isinstance(error, KeyboardInterrupt | typer.Abort | Cancelled) or getattr(error, "code", None) == "cancelled":
        return _Shown("cancelled", "The work was stopped on request.", "The same command goes on from here.", STOPPED)
    if isinstance(error, typer.TyperException):
        message = error.format_message()
        sentence = message if message.endswith((".", "?")) else f"{message}."
        return _Shown("wrong-use", sentence, "`velatura --help` shows the commands and their options.", WRONG_USE)
    known = _as_velatura_error(error)
    if isinstance(known, DeviceError):
        return _Shown(known.code, known.what, known.remedy, DEVICE_FAILED)
    return None if known is None else _Shown(known.code, known.what, known.remedy, known.exit_code)


def _as_velatura_error(error: BaseException) -> VelaturaError | DeviceError | None:
    from hal.errors import DeviceError

    if isinstance(error, VelaturaError | DeviceError):
        return error
    if isinstance(error, ModuleNotFoundError):
        return extra_missing(error.name or "")
    if isinstance(error, OSError):
        return file_error(error)
    if isinstance(error, MemoryError):
        return WorkError("no-memory", what="The memory of this machine did not suffice.",
                         remedy="End other programs, or give a smaller stage, picture or mesh.")  # fmt: skip
    return None


def _crashed(error: BaseException, *, as_json: bool) -> int:
    """For what should never happen: the traceback goes into a file, a sentence to the person."""
    report = "".join(
        [
            f"time: {time.strftime('%Y-%m-%d %H:%M:%S%z')}\n",
            f"command: {sys.argv!r}\npython: {sys.version}\nsystem: {platform.platform()}\n\n",
            *traceback.format_exception(error),
        ]
    )
    name = f"crash-{time.strftime('%Y%m%d-%H%M%S')}-{os.getpid()}.txt"
    path = _kept(report, name)
    console.show_error(
        "crash",
        f"Velatura met an error that it does not know ({type(error).__name__}).",
        f"Send {path} to the maintainers; it says what happened." if path else "No report of it could be written.",
        as_json=as_json,
    )
    return FAILED


def _kept(report: str, name: str) -> Path | None:
    for folder in (state_folder, temporary_folder):
        try:
            place = folder()
            place.mkdir(parents=True, exist_ok=True)
            path = place / name
            # Only a new file, and only for this user: the folder may be shared with others.
            with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w", encoding="utf-8") as file:
                file.write(report)
        except (OSError, RuntimeError):  # RuntimeError: the user has no home folder
            continue
        return path
    return None


if __name__ == "__main__":
    main()
