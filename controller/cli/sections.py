"""The commands of `velatura --help` in groups, those of other distributions, and `velatura --version`."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from importlib import metadata
from typing import Any, Final

import typer
from typer.core import TyperGroup

from controller.core.errors import UsageError

SECTIONS: Final[Mapping[str, tuple[str, ...]]] = {
    "Set up a stage": ("demo", "plan", "init", "doctor", "aim", "identify", "camera", "keys", "settings", "account"),
    "Calibrate": ("calibrate", "recalibrate", "drift", "results", "report", "export"),
    "Make appearances": (
        "appearance", "compute", "reach", "reach-picture", "computed-preview", "computed-picture", "feasibility",
        "photograph", "compare", "appearances", "remove", "view", "bundle",
    ),
    "Show them": (
        "play", "live", "show", "rotate", "next", "black", "pause", "brightness", "start", "stop", "schedule",
    ),
    "Run and keep a kiosk": (
        "kiosk", "serve", "status", "events", "cancel", "seen", "lamps", "changes", "backup", "restore", "test-backup",
        "test-alerts", "diagnostics",
    ),
    "Develop": ("emulate", "record", "states"),
}  # fmt: skip
OTHERS: Final = "More"
INSTALLED: Final = "Of other distributions"
"""The section of the commands that an installed distribution declares."""
GROUP: Final = "velatura.commands"
"""Entry points of commands: each names a function that ``running.group`` accepts."""
LAB: Final = ("study", "benchmark", "simulate")
"""Commands of the distribution velatura-lab."""
LONGEST_SENTENCE: Final = 200
"""Characters, far more than any first sentence has."""


class Commands(TyperGroup):
    """Lists its commands with the first sentence of their help, whole: half a sentence tells nothing."""

    def sections(self, ctx: Any) -> Mapping[str, Sequence[str]]:
        """The names of its commands by the title under which they stand."""
        return {"Commands": self.list_commands(ctx)}

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        for title, names in self.sections(ctx).items():
            rows = [
                (name, command.get_short_help_str(LONGEST_SENTENCE))
                for name in names
                if (command := self.get_command(ctx, name)) is not None
            ]
            if rows:
                with formatter.section(title):
                    formatter.write_dl(rows)


class Sections(Commands):
    """The whole program: lists its commands by ``SECTIONS``, those that are in none of them, and the installed ones.

    Entry points are looked up only for the help, for completion, and for a command that is not the program's own:
    reading the metadata of every installed distribution takes a tenth of a second.
    """

    def sections(self, ctx: Any) -> Mapping[str, Sequence[str]]:
        listed = {name for section in SECTIONS.values() for name in section}
        others = [name for name in self.commands if name not in listed]
        return {**SECTIONS, OTHERS: others, INSTALLED: sorted(installed_commands().keys() - self.commands.keys())}

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
    return {entry.name: entry for entry in metadata.entry_points(group=GROUP)}


def _loaded(entry: metadata.EntryPoint) -> Any:
    """The command of an entry point; one that can't be loaded says so when it is called, not in everybody's help."""
    try:
        function: Callable[..., Any] = entry.load()
    except Exception as error:  # noqa: BLE001 - code of another distribution
        function = _unloadable(entry, error)
    app = typer.Typer(add_completion=False, pretty_exceptions_enable=False, rich_markup_mode=None)
    app.command(entry.name)(function)
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


def show_version(asked: bool) -> None:
    """Print the version and end, if it was asked for."""
    if asked:
        # As the package says: the command line shows nothing else that is not a result.
        print(f"velatura {metadata.version('velatura')}")  # noqa: T201
        raise typer.Exit
