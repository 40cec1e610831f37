"""Makes commands of functions, and groups of commands; the parameters that commands share, and how they do their work.

Commands of other distributions are found by the entry points ``velatura.commands``.

A function's name is the command's, its docstring the help, its parameters the arguments and options. A parameter whose
type is a dataclass stands for all fields of that class. Every command gets ``--json``.
"""

from __future__ import annotations

import dataclasses
import difflib
import functools
import inspect
import os
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal, get_type_hints

import typer
from typer.core import TyperGroup

from controller.cli import console
from controller.core.errors import UsageError

if TYPE_CHECKING:
    from controller.run.progress import Reporter

PROGRAM: Final = "velatura"
INSTALLED: Final = "Of other distributions"
"""The title of the commands that an installed distribution declares."""
ENTRY_POINTS: Final = "velatura.commands"
"""Each names a function that ``group`` accepts."""
LAB: Final = ("study", "compare", "simulate")
"""Commands of the distribution velatura-lab."""
LONGEST_SENTENCE: Final = 200
"""Characters, far more than any first sentence has."""
NEAR: Final = 0.7
"""How similar a mistyped word is to the one that is suggested, of 1."""

Members = Mapping[str, Sequence["Callable[..., Any] | typer.Typer"]]
"""The commands and groups of a group, by the title under which its help lists them."""


def stage_folders(incomplete: str) -> list[str]:
    """For the shell's completion: folders with a stage.toml, here or up to two folders further down."""
    folder, _, name = incomplete.rpartition("/")
    start = Path(folder or ("/" if incomplete.startswith("/") else "."))
    depths = (f"{name}*/stage.toml", f"{name}*/*/stage.toml", f"{name}*/*/*/stage.toml")
    try:
        files = [file for depth in depths for file in start.glob(depth)]
    except (OSError, ValueError):
        return []  # a shell that completes has nowhere to show an error
    return sorted(str(file.parent) for file in files)


def projector_names(incomplete: str) -> list[str]:
    """As above, the projectors of the stage that was typed before."""
    return _names_in_stage(incomplete, "projectors")


def appearance_names(incomplete: str) -> list[str]:
    """As above, its appearances."""
    return _names_in_stage(incomplete, "appearances")


def _names_in_stage(incomplete: str, tables: str) -> list[str]:
    from controller.core.errors import VelaturaError

    # The line that was typed, as each shell gives it: an option without its value hides the arguments before it.
    typed = os.environ.get("COMP_WORDS") or os.environ.get("_TYPER_COMPLETE_ARGS") or ""
    stages = [Path(word) for word in typed.split() if (Path(word) / "stage.toml").is_file()]
    try:
        from controller.config import load_stage

        rows = getattr(load_stage(stages[0]).tables, tables) if stages else ()
    except (VelaturaError, OSError, ImportError):
        return []
    return [row.name for row in rows if row.name.startswith(incomplete)]


StageFolder = Annotated[
    Path,
    typer.Argument(metavar="STAGE", help="The stage's folder, which holds stage.toml.", autocompletion=stage_folders),
]
BenchSize = Annotated[Literal["small", "medium", "paper"], typer.Option("--size", help="Size of the stage.")]
Seeds = Annotated[
    list[int] | None,
    typer.Option("--seed", help="Random seed of the stages; repeat it for more (default: 1).", min=0, max=2**32 - 1),
]
Json = Annotated[bool, typer.Option("--json", help="Print JSON lines for programs.")]

Work = Callable[["Reporter", "threading.Event"], Mapping[str, Any]]
"""The work of a command, with a reporter and the event that requests a stop; it imports what it needs."""


def work(do: Work, *, stage: Path | None = None) -> None:
    """Do the work of a command, and show what it returns.

    ``do`` must cool the lamps itself before it returns or raises: while it runs, signals only set the event.
    ``stage``: its stage.toml is checked first. What the work of calibrating imports takes seconds, and a mistake in the
    file is to be shown at once.
    """
    from controller.run.signals import cancelled_by_signals

    with cancelled_by_signals() as cancel, console.reporter() as reporter:
        if stage is not None:
            from controller.stage.sessions.check import check_stage

            check_stage(stage)
        result = do(reporter, cancel)
    console.show_result(result)


def show_version(requested: bool) -> None:
    """Print the version and end, if it was requested."""
    if requested:
        # As the package says: the command line shows nothing else that is not a result.
        print(f"{PROGRAM} {metadata.version(PROGRAM)}")  # noqa: T201
        raise typer.Exit


def group(name: str, summary: str, members: Members, *, whole: bool = False) -> typer.Typer:
    """A command line with these commands and groups.

    ``whole``: of the whole program, with its version, and the options that install its completion in the user's shell.
    """
    app = typer.Typer(
        name=name, cls=Program if whole else Commands, help=summary, add_completion=whole,
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
    for title, commands in members.items():
        for member in commands:
            if isinstance(member, typer.Typer):
                app.add_typer(member, rich_help_panel=title)
            else:
                word = member.__name__.strip("_").replace("_", "-")
                app.command(word, rich_help_panel=title, hidden=not title)(with_all_parameters(member))
    return app


def with_all_parameters(command: Callable[..., Any]) -> Callable[..., Any]:
    """The command as typer reads it: fields of its dataclasses are parameters of their own, and ``--json`` is last."""
    hints = get_type_hints(command, include_extras=True)
    parameters: list[inspect.Parameter] = []
    grouped: dict[str, type[Any]] = {}
    for parameter in inspect.signature(command).parameters.values():
        kind = hints[parameter.name]
        if not dataclasses.is_dataclass(kind):
            parameters.append(typed_parameter(parameter.name, kind, parameter.default))
            continue
        assert isinstance(kind, type)
        grouped[parameter.name] = kind
        field_hints = get_type_hints(kind, include_extras=True)
        for field in dataclasses.fields(kind):
            default = inspect.Parameter.empty if field.default is dataclasses.MISSING else field.default
            parameters.append(typed_parameter(field.name, field_hints[field.name], default))
    parameters.append(typed_parameter("json_lines", Json, False))

    @functools.wraps(command)
    def run(json_lines: bool, **values: Any) -> Any:
        for name, kind in grouped.items():
            values[name] = kind(**{field.name: values.pop(field.name) for field in dataclasses.fields(kind)})
        with console.json_lines(json_lines):
            return command(**values)

    return with_signature(run, parameters)


def typed_parameter(name: str, annotation: Any, default: Any = inspect.Parameter.empty) -> inspect.Parameter:
    """A parameter as typer reads it; without a default it is required."""
    return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, annotation=annotation, default=default)


def with_signature(function: Callable[..., Any], parameters: Sequence[inspect.Parameter]) -> Callable[..., Any]:
    """``function``, which then seems to have these parameters."""
    vars(function)["__signature__"] = inspect.Signature(parameters)
    function.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    return function


class Commands(TyperGroup):
    """Lists its commands by titles, with the first sentence of their help; suggests the nearest for a wrong one."""

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        titles: dict[str, list[tuple[str, str]]] = {}
        for name in self.list_commands(ctx):
            command = self.get_command(ctx, name)
            assert command is not None
            if command.hidden:
                continue
            title = str(getattr(command, "rich_help_panel", None) or INSTALLED)
            titles.setdefault(title, []).append((name, command.get_short_help_str(LONGEST_SENTENCE)))
        for title, rows in titles.items():
            with formatter.section(title):
                formatter.write_dl(rows)

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        unknown = not args[0].startswith("-") and self.get_command(ctx, args[0]) is None
        if unknown and not ctx.resilient_parsing:
            here = ctx.command_path
            suggested = nearest(args[0], list(words_of(ctx.find_root().command)), here.removeprefix(PROGRAM).strip())
            meant = f"Did you mean {' or '.join(f'`{PROGRAM} {words}`' for words in suggested)}? " if suggested else ""
            raise UsageError(
                "wrong-use", what=f"There is no command `{here} {args[0]}`.",
                remedy=f"{meant}`{here} --help` lists the commands.",
            )  # fmt: skip
        return super().resolve_command(ctx, args)


class Program(Commands):
    """All commands, also those of other distributions.

    Entry points are looked up only for the help, for completion, and for a command that is not the program's own:
    reading the metadata of every installed distribution takes a tenth of a second.
    """

    def list_commands(self, ctx: Any) -> list[str]:
        return list(dict.fromkeys([*super().list_commands(ctx), *sorted(installed_commands())]))

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        own = super().get_command(ctx, cmd_name)
        if own is not None or cmd_name.startswith("-"):
            return own
        entry = installed_commands().get(cmd_name)
        return None if entry is None else _loaded(entry)

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        if args[0] in LAB and self.get_command(ctx, args[0]) is None:
            raise UsageError(
                "lab-missing",
                what=f"The command {args[0]} is in the distribution velatura-lab, which is not installed.",
                remedy="Run `pip install velatura-lab` in Velatura's environment, "
                "or `pip install --editable lab` in a copy of the source.",
            )
        return super().resolve_command(ctx, args)


def installed_commands() -> dict[str, metadata.EntryPoint]:
    """The commands that installed distributions declare, by name."""
    return {entry.name: entry for entry in metadata.entry_points(group=ENTRY_POINTS)}


def _loaded(entry: metadata.EntryPoint) -> Any:
    """The command of an entry point; one that can't be loaded says so when it is called, and spoils no other's help."""
    try:
        function: Callable[..., Any] = entry.load()
    except Exception as error:  # noqa: BLE001 - code of another distribution
        function = _unloadable(entry, error)
    app = typer.Typer(add_completion=False, pretty_exceptions_enable=False, rich_markup_mode=None)
    app.command(entry.name, rich_help_panel=INSTALLED)(with_all_parameters(function))
    return typer.main.get_command(app)


def _unloadable(entry: metadata.EntryPoint, error: Exception) -> Callable[[], None]:
    source = entry.dist.name if entry.dist is not None else entry.value

    def command() -> None:
        """Can't be loaded."""
        raise UsageError(
            "command-not-loaded",
            what=f"The command {entry.name} of {source} can't be loaded ({type(error).__name__}: {error}).",
            remedy=f"Update {source}, or remove it.",
        )

    return command


def words_of(command: Any, before: tuple[str, ...] = ()) -> Iterator[str]:
    """The words of every command below a group, without the program's name."""
    for name, inner in command.commands.items():
        if hasattr(inner, "commands"):
            yield from words_of(inner, (*before, name))
        else:
            yield " ".join((*before, name))


def nearest(typed: str, existing: Sequence[str], inside: str = "") -> list[str]:
    """The commands (words without the program's name) that the word ``typed`` in the group ``inside`` may have meant.

    An operation's name in the HTTP API finds its command; otherwise the last word of a command counts.
    """
    from controller.kiosk.operations.table import OPERATIONS

    operations = [one.words for one in OPERATIONS if typed == one.name and one.words in existing]
    by_last: dict[str, list[str]] = {}
    for words in existing:
        by_last.setdefault(words.rpartition(" ")[2], []).append(words)
    if operations or typed in by_last:
        return operations or by_last[typed]
    similar = difflib.get_close_matches(typed, by_last, n=3, cutoff=NEAR)
    suggested = [words for last in similar for words in by_last[last]]
    return [words for words in suggested if words.startswith(inside)][:3] or suggested[:3]
