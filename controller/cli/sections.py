"""The commands of `velatura --help` in groups, and `velatura --version`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib import metadata
from typing import Any, Final

import typer
from typer.core import TyperGroup

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
    "Develop and study": ("emulate", "record", "study", "benchmark", "simulate", "states"),
}  # fmt: skip
OTHERS: Final = "More"
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
    """Lists its commands by ``SECTIONS``; what is in none of them comes last."""

    def sections(self, ctx: Any) -> Mapping[str, Sequence[str]]:
        listed = {name for section in SECTIONS.values() for name in section}
        return {**SECTIONS, OTHERS: [name for name in self.list_commands(ctx) if name not in listed]}


def show_version(asked: bool) -> None:
    """Print the version and end, if it was asked for."""
    if asked:
        # As the package says: the command line shows nothing else that is not a result.
        print(f"velatura {metadata.version('velatura')}")  # noqa: T201
        raise typer.Exit
