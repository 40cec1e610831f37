"""How a command that failed ends: two sentences for the user, an exit code, and a file for what should never happen."""

from __future__ import annotations

import os
import platform
import sys
import time
import traceback
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from controller.cli import console
from controller.core.errors import VelaturaError, WorkError
from controller.core.extras import extra_missing
from controller.core.files import file_error
from controller.core.text import printable
from hal.runtime.caches import state_folder, temporary_folder

if TYPE_CHECKING:
    from hal.errors import DeviceError

DONE, FAILED, WRONG_USE, DEVICE_FAILED, STOPPED = 0, 1, 2, 3, 130
"""Exit codes of the program."""


def report_error(error: BaseException) -> int:
    """Show ``error`` as two sentences and return the exit code. If output was lost, show that instead."""
    if isinstance(error, typer.Exit):
        return error.exit_code
    if isinstance(error, OSError) and console.output_lost(error):
        return FAILED
    try:
        shown = _explained(error)
        if shown is None:
            return _crashed(error)
        console.show_error(shown.code, shown.what, shown.remedy)
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
    """The message for ``error``; None for one that should never happen."""
    from hal.deadline import Cancelled
    from hal.errors import DeviceError

    if isinstance(error, KeyboardInterrupt | typer.Abort | Cancelled) or getattr(error, "code", None) == "cancelled":
        return _Shown(
            "cancelled", "The work was stopped on request.", "Run the same command to continue from here.", STOPPED
        )
    if isinstance(error, typer.TyperException):
        return _Shown("wrong-use", *_wrong_use(error), WRONG_USE)
    known = _as_velatura_error(error)
    if isinstance(known, DeviceError):
        return _Shown(known.code, known.what, known.remedy, DEVICE_FAILED)
    return None if known is None else _Shown(known.code, known.what, known.remedy, known.exit_code)


def _wrong_use(error: typer.TyperException) -> tuple[str, str]:
    """What is wrong in the words that were typed, and the nearest that would be right."""
    context = getattr(error, "ctx", None)
    place = "velatura" if context is None else context.command_path
    remedy = f"`{place} --help` shows what it takes."
    if (option := getattr(error, "option_name", None)) and hasattr(error, "possibilities"):
        nearest = " or ".join(sorted(error.possibilities or ()))
        return (
            f"`{place}` has no option {printable(option)}.",
            f"Did you mean {nearest}? {remedy}" if nearest else remedy,
        )
    message = error.format_message().replace("Value error, ", "")
    return message if message.endswith((".", "?")) else f"{message}.", remedy


def _as_velatura_error(error: BaseException) -> VelaturaError | DeviceError | None:
    from hal.errors import DeviceError

    if isinstance(error, VelaturaError | DeviceError):
        return error
    if isinstance(error, ModuleNotFoundError):
        return extra_missing(error.name or "")
    if isinstance(error, OSError):
        return file_error(error)
    if isinstance(error, MemoryError):
        return WorkError("no-memory", what="This computer has too little memory.",
                         remedy="Close other programs, or use a smaller stage, picture or mesh.")  # fmt: skip
    return None


def _crashed(error: BaseException) -> int:
    """For an unexpected error: write the traceback to a file and show a short message."""
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
        f"An unexpected error occurred ({type(error).__name__}).",
        f"Send {path} to the maintainers. It contains the details."
        if path
        else "The error report could not be written.",
    )
    return FAILED


def _kept(report: str, name: str) -> Path | None:
    for folder in (state_folder, temporary_folder):
        try:
            place = folder()
            place.mkdir(parents=True, exist_ok=True)
            path = place / name
            # Only a new file, readable only for this user: the folder may be shared.
            with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as file:
                file.write(report.encode(errors="backslashreplace"))
        except (OSError, RuntimeError):  # RuntimeError: the user has no home folder
            continue
        return path
    return None
