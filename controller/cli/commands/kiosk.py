"""``velatura kiosk``: everything that the running kiosk does.

Most of its commands are made from the table of operations (`controller.cli.derived`). Those here use several.
"""

from __future__ import annotations

import base64
import sys
from collections.abc import Mapping
from datetime import datetime
from pathlib import Path
from typing import Annotated, Any, Final, Literal

import typer

from controller.cli import console
from controller.cli.commands.service import agent, install, serve, uninstall, update, worker
from controller.cli.derived import call, commands, job
from controller.cli.groups import Members, StageFolder, group
from controller.core.errors import UsageError
from controller.core.text import printable

NONE_YET: Final = "There are none yet."


def status(stage: StageFolder) -> None:
    """What the stage does now, and its faults."""
    from controller.kiosk.api.offline_dispatch import status_of, status_text

    content = status_of(stage)
    console.show_result(content, status_text(content))


def events(
    stage: StageFolder,
    after: Annotated[int, typer.Option(help="Only events after this number.", min=0)] = 0,
    level: Annotated[Literal["info", "warning", "error"], typer.Option(help="Minimum level.")] = "info",
) -> None:
    """The kiosk's event log."""
    from controller.kiosk.api.offline_dispatch import LEVELS

    rows = [row for row in call(stage, "events", after=after) if LEVELS.index(row["level"]) >= LEVELS.index(level)]
    lines = [f"{row['number']:>7} {_local(row['unix_s'])} {row['level']:<7} {printable(row['text'])}" for row in rows]
    console.show_result({"events": rows}, "\n".join(lines))


def schedule(
    stage: StageFolder,
    zone: Annotated[str | None, typer.Option(help="Time zone, e.g. Europe/Vienna.")] = None,
    hours: Annotated[
        list[str] | None,
        typer.Option(help="DAY=HH:MM-HH:MM or DAY=closed; replaces all rows. DAY is mon, mon-fri, daily, or a date."),
    ] = None,
    drift_check: Annotated[str | None, typer.Option(help='HH:MM of the nightly check; "" for no check.')] = None,
) -> None:
    """Show the opening hours, or change them."""
    from controller.kiosk.api.offline_dispatch import changed_schedule, schedule_text

    now = call(stage, "schedule")
    if zone is not None or hours is not None or drift_check is not None:
        now = changed_schedule(now, zone, hours, drift_check)
        call(stage, "set-schedule", **now)
    console.show_result(now, schedule_text(now))


def _local(unix_s: float) -> str:
    return datetime.fromtimestamp(unix_s, tz=datetime.now().astimezone().tzinfo).strftime("%Y-%m-%d %H:%M:%S")


def results(
    stage: StageFolder,
    run: Annotated[str | None, typer.Argument(help="A run's name (default: all runs with results).")] = None,
) -> None:
    """Grade and figures of a calibration, or all calibrations and the quality of the appearances."""
    if run is None:
        names, compared = call(stage, "runs"), call(stage, "comparisons")
        lines = [*names, *map(_achieved, compared)]
        console.show_result({"runs": names, "comparisons": compared}, "\n".join(lines) or NONE_YET)
        return
    content = call(stage, "results", run=run)
    grade = content["grade"]
    lines = [] if grade is None else [f"Grade {grade['grade']}: {grade['note']}"]
    lines += [f"{label}: {value}" for label, value in content["figures"]]
    lines += [f"{name}: {path}" for name, path in content["pictures"].items()]
    console.show_result(content, "\n".join(lines))


def _achieved(comparison: Mapping[str, Any]) -> str:
    newest = comparison["history"][0]
    inside = newest.get("in_reach")
    part = "" if inside is None else f", {inside:.2f} on the {newest['in_reach_share']:.0%} in reach"
    difference = f"colour difference {newest['delta_e']:.2f} (95 %: {newest['delta_e_p95']:.2f}){part}"
    return f"{comparison['name']}: {difference}, sharpness {newest['sharpness']:.2f}, photographed in {newest['run']}"


def aim(
    stage: StageFolder,
    picture: Annotated[Path | None, typer.Option(help="Write the camera picture to this JPEG file.")] = None,
    shots: Annotated[bool, typer.Option("--shots", help="First take test shots with all lamps on.")] = False,
) -> None:
    """Show what the projectors cover, and what is too dark, too oblique or out of focus. The kiosk must be running."""
    from controller.kiosk.api.offline_dispatch import aiming_text

    if shots:
        job(stage, "test-shots", {})
    if picture is not None:
        data = call(stage, "camera-picture")
        if data is None:
            raise UsageError(
                "picture-unknown",
                what="The camera shows no picture now.",
                remedy="Check `velatura kiosk status`, or take a test shot on the aiming page.",
            )
        picture.write_bytes(base64.b64decode(data))
    content = call(stage, "aiming")
    console.show_result(content, aiming_text(content))


def settings(
    stage: StageFolder,
    check: Annotated[Path | None, typer.Option(help="Check this stage.toml only.")] = None,
    save: Annotated[Path | None, typer.Option(help="Check this stage.toml and use it.")] = None,
    yes: Annotated[bool, typer.Option("--yes", help="Do not ask. Scripts are never asked.")] = False,
) -> None:
    """Print stage.toml, check another one, or replace it."""
    from controller.core.files import read_text

    file = save or check
    if file is None:
        text = call(stage, "settings")
        console.show_result({"text": text}, text)
        return
    try:
        text = read_text(file)
    except (OSError, UnicodeDecodeError) as error:
        raise UsageError("file-unreadable", what=f"{file} can't be read.", remedy="Give a text file.") from error
    if save is None:
        call(stage, "validate-settings", text=text)
        console.show_result({"done": "validate-settings"}, "The settings are valid.")
        return
    if not yes and sys.stdin.isatty() and (effect := call(stage, "effect-of-settings", text=text)):
        typer.confirm(f"{effect} Save?", abort=True)
    call(stage, "save-settings", text=text)
    console.show_result({"done": "save-settings"}, "The new settings are in use.")


def list_(stage: StageFolder) -> None:
    """List all accounts and tokens."""
    accounts, tokens = call(stage, "accounts"), call(stage, "tokens")
    lines = [
        f"{account['name']:<32} {account['role']}{', one-time password' if account['one_time'] else ''}"
        for account in accounts
    ]
    lines += [f"{token['name']:<32} {token['role']}, token" for token in tokens]
    console.show_result({"accounts": accounts, "tokens": tokens}, "\n".join(lines) or NONE_YET)


ACCOUNT: Final = group(
    "account",
    "People who may log in at the stage's panel, and tokens for programs.",
    {"Commands": (list_, *commands("kiosk account").values())},
)
HOUSE: Final = group(
    "house",
    "A house of many stages on one page, and this stage's place in one.",
    {"Commands": tuple(commands("kiosk house").values())},
)
_SHOWN: Final = ("start", "stop", "show", "rotate", "next", "black", "pause", "brightness", "identify")
_WORK: Final = ("calibrate", "photograph", "cancel", "appearances", "add", "remove", "canvas", "reach")


def _members() -> Members:
    derived = commands("kiosk")
    shown, work = ([derived.pop(name) for name in names] for names in (_SHOWN, _WORK))
    return {
        "Run it": (serve, agent, worker, install, update, uninstall, status, events),
        "What it shows": shown,
        "Calibration and appearances": (*work, results, aim),
        "Look after it": (schedule, settings, ACCOUNT, HOUSE, *derived.values()),
    }


KIOSK: Final = group("kiosk", "Run the stage by itself, and tell the running kiosk what to do.", _members())
