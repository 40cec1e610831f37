"""Commands that use several operations of a kiosk. Commands of one operation are in ``controller.cli.derived``."""

from __future__ import annotations

import base64
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import typer

from controller.cli import console
from controller.cli.derived import job
from controller.cli.running import Json, StageFolder
from controller.core.errors import UsageError


def results(
    stage: StageFolder,
    run: Annotated[str | None, typer.Argument(help="A run's name (default: all runs with results).")] = None,
    as_json: Json = False,
) -> None:
    """Show grade and figures of one calibration, or list all calibrations and the quality of the appearances."""
    if run is None:
        names, compared = _call(stage, "runs"), _call(stage, "comparisons")
        lines = [*names, *(_achieved(result) for result in compared)]
        found = {"runs": names, "comparisons": compared}
        console.show_result(found if as_json else "\n".join(lines) or "There are none yet.", as_json=as_json)
        return
    found = _call(stage, "results", run=run)
    grade = found["grade"]
    lines = [] if grade is None else [f"Grade {grade['grade']}: {grade['note']}"]
    lines += [f"{label}: {value}" for label, value in found["figures"]]
    lines += [f"{name}: {path}" for name, path in found["pictures"].items()]
    console.show_result(found if as_json else "\n".join(lines), as_json=as_json)


def _achieved(one: Mapping[str, Any]) -> str:
    newest = one["history"][0]
    inside = newest.get("in_reach")
    part = "" if inside is None else f", {inside:.2f} on the {newest['in_reach_share']:.0%} in reach"
    return (f"{one['name']}: colour difference {newest['delta_e']:.2f} (95 %: {newest['delta_e_p95']:.2f}){part}, "
            f"sharpness {newest['sharpness']:.2f}, photographed in {newest['run']}")  # fmt: skip


def aim(
    stage: StageFolder,
    picture: Annotated[Path | None, typer.Option(help="Write the camera picture to this JPEG file.")] = None,
    shots: Annotated[bool, typer.Option("--shots", help="First take test shots with all lamps on.")] = False,
    as_json: Json = False,
) -> None:
    """Show what the projectors cover, and what is too dark, too oblique or out of focus. Needs a running kiosk."""
    from controller.kiosk.api.offline_dispatch import aiming_text

    if shots:
        job(stage, "test-shots", {}, as_json=as_json)
    if picture is not None:
        data = _call(stage, "camera-picture")
        if data is None:
            raise UsageError("picture-unknown", what="The camera shows no picture now.",
                             remedy="Check `velatura status`, or take a test shot on the aiming page.")  # fmt: skip
        picture.write_bytes(base64.b64decode(data))
    found = _call(stage, "aiming")
    console.show_result(found if as_json else aiming_text(found), as_json=as_json)


def settings(
    stage: StageFolder,
    check: Annotated[Path | None, typer.Option(help="Check this stage.toml only.")] = None,
    save: Annotated[Path | None, typer.Option(help="Check this stage.toml and use it.")] = None,
    yes: Annotated[bool, typer.Option("--yes", help="Do not ask. Scripts are never asked.")] = False,
    as_json: Json = False,
) -> None:
    """Print stage.toml, check another one, or replace it."""
    if save is None and check is None:
        text = _call(stage, "settings")
        console.show_result({"text": text} if as_json else text, as_json=as_json)
        return
    from controller.core.files import read_text

    file = save or check
    assert file is not None
    op, said = (
        ("save-settings", "The new settings are in use.") if save else ("validate-settings", "The settings are valid.")
    )
    try:
        text = read_text(file)
    except (OSError, UnicodeDecodeError) as error:
        raise UsageError("file-unreadable", what=f"{file} can't be read.", remedy="Give a text file.") from error
    if (
        save is not None
        and not yes
        and sys.stdin.isatty()
        and (effect := _call(stage, "effect-of-settings", text=text))
    ):
        typer.confirm(f"{effect} Save?", abort=True)
    _done(stage, op, said, as_json=as_json, text=text)


def _call(stage: Path, op: str, **arguments: Any) -> Any:
    from controller.kiosk.api.offline_dispatch import call

    return call(stage, op, **arguments)


def _done(stage: Path, op: str, sentence: str, *, as_json: bool, **arguments: Any) -> None:
    _call(stage, op, **arguments)
    console.show_result({"done": op} if as_json else sentence, as_json=as_json)


COMMANDS = (results, aim, settings)
