"""``velatura`` without the packages of the command line: shows what is installed and what to add."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from typing import Final

from controller.core.extras import EXTRAS, extra_missing, install_command

HELP: Final = {"--help", "-h", "help"}


def run_without_commands(arguments: Sequence[str], missing: str) -> int:
    """Answer ``velatura ARGUMENTS`` where the module ``missing`` is not installed; returns the exit code.

    Help is given; everything else is refused with the error "extra-missing".
    """
    if not arguments or HELP & set(arguments):
        sys.stdout.write(_help())
        return 0
    error = extra_missing(missing)
    assert error is not None
    if "--json" in arguments:
        sys.stdout.write(json.dumps({"error": {"code": error.code, "what": error.what, "remedy": error.remedy}}) + "\n")
    else:
        sys.stderr.write(f"velatura: {error.what}\n{error.remedy}\n")
    return error.exit_code


def _help() -> str:
    width = max(map(len, EXTRAS))
    rows = "".join(f"  {name:<{width}}  {purpose}\n" for name, purpose in EXTRAS.items())
    return (
        "Usage: velatura COMMAND ...\n\n"
        "Gives a physical object a new appearance with light from several superimposed projectors.\n\n"
        "Only the player is installed: python -m controller.play --help\n"
        "These extras add the commands:\n\n"
        f"{rows}\n"
        f"Run {install_command('controller')}, or several: {install_command('controller,panel,bench')}.\n"
    )
