"""The tape of this process, if `velatura record` asked for one: all devices that it opens write on it."""

from __future__ import annotations

import functools
import os
from pathlib import Path
from typing import Final

from controller.core.errors import WorkError
from hal.registry import OpenContext
from hal.tape import Tape

VARIABLE: Final = "VELATURA_TAPE"
"""Environment variable with the file of the tape."""
FOLDER: Final = "tapes"


def open_context(stage: Path, *, runtime: Path | None = None) -> OpenContext:
    """What drivers get to open the devices of ``stage``. Raises WorkError("tape-not-made")."""
    return OpenContext(stage=stage, runtime=runtime, tape=_tape())


def new_tape(stage: Path, name: str) -> Path:
    """A file for a new tape of ``stage``; its folder is made. Raises WorkError("tape-not-made")."""
    try:
        (stage / FOLDER).mkdir(exist_ok=True)
    except OSError as error:
        raise _not_made(stage / FOLDER, error) from error
    return stage / FOLDER / f"{name}.tape"


def tapes(stage: Path) -> list[Path]:
    """The tapes of ``stage``, oldest first."""
    return sorted((stage / FOLDER).glob("*.tape"), key=lambda path: path.stat().st_mtime)


@functools.cache
def _tape() -> Tape | None:
    # Taken out of the environment: a process that this one starts must not write into the same file.
    path = os.environ.pop(VARIABLE, "")
    if not path:
        return None
    try:
        return Tape(Path(path))
    except OSError as error:
        raise _not_made(Path(path), error) from error


def _not_made(path: Path, error: OSError) -> WorkError:
    return WorkError(
        "tape-not-made",
        what=f"The tape {path} can't be written: {error.strerror}.",
        remedy="Give another file with --out, or check the permissions of its folder.",
    )
