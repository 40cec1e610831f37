"""``velatura``: puts the commands of `controller.cli.commands` together, and runs one."""

from __future__ import annotations

import functools
import sys
from collections.abc import Callable, Sequence
from typing import Any, Final

from controller.cli.plain_install import run_without_commands
from controller.core.extras import EXTRA_OF

try:
    import pydantic  # noqa: F401 - the kiosk's operations, of which commands are made, need it
    import typer
except ModuleNotFoundError as missing:  # an installation with only the player
    if missing.name not in EXTRA_OF:
        raise
    sys.exit(run_without_commands(sys.argv[1:], missing.name))

from controller.cli import console
from controller.cli.commands.appearances import appearance, live, photograph, play
from controller.cli.commands.bundles import BUNDLE
from controller.cli.commands.calibration import calibrate, drift, export, register, report
from controller.cli.commands.emulation import demo, emulate, record
from controller.cli.commands.kiosk import KIOSK
from controller.cli.commands.stage import CAMERA, doctor, init, plan
from controller.cli.error_reports import DONE, FAILED, report_error
from controller.cli.groups import PROGRAM, Members, group
from hal.runtime.caches import prepare_libraries

SUMMARY: Final = "Gives a physical object a new appearance with light from several superimposed projectors."
MEMBERS: Final[Members] = {
    "Set up a stage": (init, doctor, plan, CAMERA),
    "Calibrate it, and make appearances": (calibrate, drift, register, appearance, photograph, report),
    "Show them": (play, live, KIOSK),
    "Take them elsewhere": (BUNDLE, export),
    "Work without hardware": (demo, emulate),
    "": (record,),
}
"""The commands in the order of a technician's life, by the titles of the help. Other distributions add theirs.

Without a title: what the first help leaves out, because only the writer of a driver needs it."""


def application(members: Members = MEMBERS) -> typer.Typer:
    """The command line with these commands and groups."""
    return group(PROGRAM, SUMMARY, members, whole=True)


@functools.cache
def _built() -> Callable[..., Any]:
    """All commands with their options, read once from the functions: that takes longer than most commands."""
    return typer.main.get_command(application())


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line and exit with a code of ``cli.error_reports``."""
    typed = list(sys.argv[1:] if arguments is None else arguments)
    console.prepare_streams()
    prepare_libraries()
    sys.exit(run(typed))


def run(arguments: Sequence[str]) -> int:
    """Run one command and return its exit code. Errors have been shown."""
    own = arguments[: arguments.index("--")] if "--" in arguments else arguments
    with console.json_lines("--json" in own):
        try:
            outcome = _built()(args=list(arguments) or ["--help"], prog_name=PROGRAM, standalone_mode=False)
            sys.stdout.flush()
        except SystemExit as exiting:  # raised by the command-line library when the reader of our output has closed it
            return exiting.code if isinstance(exiting.code, int) else FAILED
        except BaseException as error:  # noqa: BLE001 - the last boundary: no caller could show it
            return report_error(error)
    return outcome if isinstance(outcome, int) else DONE


if __name__ == "__main__":
    main()
