"""``velatura kiosk install``, ``restore`` and ``uninstall``."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

import typer

from controller.cli import console
from controller.core.errors import UsageError

SUMMARY = "Make this computer a kiosk."
DryRun = Annotated[bool, typer.Option("--dry-run", help="Change nothing; print what would be done.")]


def install(
    dry_run: DryRun = False,
    outputs: Annotated[
        bool, typer.Option("--outputs", help="Look again which projectors are plugged in; all must be switched on.")
    ] = False,
    restart: Annotated[
        bool,
        typer.Option("--restart", help="Start controller and player again, for a new version. Lamps stay lit."),
    ] = False,
) -> None:
    """Set up user, services, X server and panel on Debian 12 or 13, and start the kiosk (as root)."""
    from controller.kiosk.install import steps
    from controller.kiosk.install.system import System

    _require_root(dry_run)
    steps.install(System(_say, dry=dry_run), outputs_again=outputs, restart=restart, say=_say)
    if not dry_run:
        _say("The kiosk runs, and starts with this computer.")


def restore(
    file: Annotated[Path, typer.Argument(help="A backup: velatura-DATE.tar.gz.", exists=True, dir_okay=False)],
    dry_run: DryRun = False,
) -> None:
    """Make this blank computer the kiosk of a backup (as root): installs it, finds the projectors, and plays.

    All projectors must be switched on. Where serial numbers do not tell which is which, they show numbers, and you are
    asked.
    """
    from controller.kiosk.install import restored
    from controller.kiosk.install.system import System

    _require_root(dry_run)
    restored.restore(System(_say, dry=dry_run), file.absolute(), ask=lambda text: str(typer.prompt(text)), say=_say)
    if not dry_run:
        _say("The backup is in place. `velatura changes` and `velatura doctor` tell what is different here.")


def uninstall(
    dry_run: DryRun = False,
    purge: Annotated[bool, typer.Option("--purge", help="Remove the stage, the settings and the user, too.")] = False,
) -> None:
    """Stop the kiosk, and remove what `velatura kiosk install` wrote; the stage stays (as root)."""
    from controller.kiosk.install import steps
    from controller.kiosk.install.system import System

    _require_root(dry_run)
    steps.uninstall(System(_say, dry=dry_run), purge=purge)


def _say(sentence: str) -> None:
    console.show_result(sentence, as_json=False)


def _require_root(dry_run: bool) -> None:
    if os.geteuid() != 0 and not dry_run:
        raise UsageError("needs-root", what="Only root can do this.", remedy="Type it as root, or with sudo.")


COMMANDS = (install, restore, uninstall)
