"""What the commands share: their common parameters, and how work is called and its result shown."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Annotated, Any

import typer

from controller import console

StageFolder = Annotated[Path, typer.Argument(metavar="STAGE", help="The stage's folder, which holds stage.toml.")]
Json = Annotated[bool, typer.Option("--json", help="Print one JSON object a line, for machines.")]


def work(target: str, *, as_json: bool, **arguments: Any) -> None:
    """Call ``"package.module:function"`` for a command, and show what it returns (a mapping, a text or None).

    The function gets ``arguments`` and besides ``reporter`` (a ``session.progress.Reporter``) and ``cancel`` (an event
    for its ``Deadline``). It must cool the lamps itself before it returns or raises: while it runs, signals only set
    the event.
    """
    from controller.session.signals import cancelled_by_signals

    module, _, name = target.partition(":")
    with cancelled_by_signals() as cancel, console.reporter(as_json=as_json) as reporter:
        result = getattr(importlib.import_module(module), name)(**arguments, reporter=reporter, cancel=cancel)
    console.show_result(result, as_json=as_json)


def group(name: str, summary: str, commands: Iterable[Callable[..., Any]], *, completion: bool = False) -> typer.Typer:
    """A command line with these commands: a function's name is the command's, its docstring the help.

    ``completion``: with the options that install it in the user's shell.
    """
    app = typer.Typer(
        name=name, help=summary, add_completion=completion, pretty_exceptions_enable=False, rich_markup_mode=None
    )

    def nothing_before_a_command() -> None:
        pass

    # With a callback a single command stays a command, instead of becoming the whole program.
    app.callback(help=summary)(nothing_before_a_command)
    for command in commands:
        app.command(command.__name__.replace("_", "-"))(command)
    return app
