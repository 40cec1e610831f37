"""Shared by all commands: common parameters, running the work, showing the result."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from controller.cli import console
from controller.cli.sections import Commands, Sections, show_version

if TYPE_CHECKING:
    from controller.run.progress import Reporter

StageFolder = Annotated[Path, typer.Argument(metavar="STAGE", help="The stage's folder, which holds stage.toml.")]
BenchSize = Annotated[str, typer.Option("--size", help="small, medium or paper.")]
Seeds = Annotated[
    list[int] | None,
    typer.Option("--seed", help="Random seed of the stages; repeat it for more (default: 1).", min=0, max=2**32 - 1),
]
Json = Annotated[bool, typer.Option("--json", help="Print JSON lines for programs.")]


def projector_names(incomplete: str) -> list[str]:
    """For the shell's completion: the projectors of the stage that was typed before."""
    return _completed(incomplete, "projectors")


def appearance_names(incomplete: str) -> list[str]:
    """As above, its appearances."""
    return _completed(incomplete, "appearances")


def _completed(incomplete: str, tables: str) -> list[str]:
    from controller.core.errors import VelaturaError

    # The line that was typed, as each shell gives it: an option without its value hides the arguments before it.
    typed = os.environ.get("COMP_WORDS") or os.environ.get("_TYPER_COMPLETE_ARGS") or ""
    stages = [Path(word) for word in typed.split() if (Path(word) / "stage.toml").is_file()]
    try:
        from controller.config import load_stage

        rows = getattr(load_stage(stages[0]).tables, tables) if stages else ()
    except (VelaturaError, OSError, ImportError):
        return []  # a shell that completes has nowhere to show an error
    return [row.name for row in rows if row.name.startswith(incomplete)]


Work = Callable[["Reporter", "threading.Event"], Mapping[str, Any] | str | None]
"""The work of a command, with a reporter and the event that requests a stop; it imports what it needs."""


def work(do: Work, *, as_json: bool, stage: Path | None = None) -> None:
    """Do the work of a command, and show what it returns.

    ``do`` must cool the lamps itself before it returns or raises: while it runs, signals only set the event.
    ``stage``: its stage.toml is checked first. What the work of calibrating imports takes seconds, and who made a
    mistake shall read of it at once.
    """
    from controller.run.signals import cancelled_by_signals

    with cancelled_by_signals() as cancel, console.reporter(as_json=as_json) as reporter:
        if stage is not None:
            from controller.stage.sessions.check import check_stage

            check_stage(stage)
        result = do(reporter, cancel)
    console.show_result(result, as_json=as_json)


def group(name: str, summary: str, commands: Iterable[Callable[..., Any]], *, whole: bool = False) -> typer.Typer:
    """A command line with these commands: a function's name is the command's, its docstring the help.

    ``whole``: of the whole program, with its commands in sections, its version, and the options that install its
    completion in the user's shell.
    """
    app = typer.Typer(
        name=name, cls=Sections if whole else Commands, help=summary, add_completion=whole,
        pretty_exceptions_enable=False, rich_markup_mode=None,
    )  # fmt: skip

    def nothing_before_a_command() -> None:
        pass

    def of_the_program(
        version: Annotated[
            bool, typer.Option("--version", callback=show_version, is_eager=True, help="Show the version and exit.")
        ] = False,
    ) -> None:
        pass

    # With a callback a single command stays a command, instead of becoming the whole program.
    app.callback(help=summary)(of_the_program if whole else nothing_before_a_command)
    for command in commands:
        app.command(command.__name__.replace("_", "-"))(command)
    return app
