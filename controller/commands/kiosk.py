"""What the panel of a running kiosk does, for the command line; what needs no kiosk is done on the folder itself."""

from __future__ import annotations

import base64
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import typer

from controller import console
from controller.commands.running import Json, StageFolder, appearance_names, projector_names, work
from controller.errors import UsageError

Name = Annotated[str, typer.Argument(help="The appearance's name.", autocompletion=appearance_names)]
Projector = Annotated[
    str | None,
    typer.Option(help="Measure this projector anew, and keep the others.", autocompletion=projector_names),
]


def recalibrate(
    stage: StageFolder,
    quick: Annotated[bool, typer.Option("--quick", help="Look what has changed, and repeat only that.")] = False,
    projector: Projector = None,
    no_wait: Annotated[bool, typer.Option("--no-wait", help="Do not follow it to its end.")] = False,
    as_json: Json = False,
) -> None:
    """Let the running kiosk calibrate itself, and follow it to its end."""
    arguments = {"kind": "quick" if quick else "full", "projector": projector}
    _job(stage, "recalibrate", arguments, no_wait=no_wait, as_json=as_json)


def compute(
    stage: StageFolder,
    name: Name,
    picture: Annotated[Path, typer.Argument(metavar="PNG", help="What the object should look like to the camera.")],
    no_wait: Annotated[bool, typer.Option("--no-wait", help="Do not follow it to its end.")] = False,
    as_json: Json = False,
) -> None:
    """Let the running kiosk make an appearance of a picture, install it, and follow that to its end."""
    if not picture.is_file():
        raise UsageError("target-missing", what=f"There is no file {picture}.", remedy="Give a PNG file.")
    _job(stage, "compute", {"name": name, "target": str(picture.resolve())}, no_wait=no_wait, as_json=as_json)


def compare(
    stage: StageFolder,
    name: Annotated[str | None, typer.Argument(help="Only this appearance.", autocompletion=appearance_names)] = None,
    no_wait: Annotated[bool, typer.Option("--no-wait", help="Do not follow it to its end.")] = False,
    as_json: Json = False,
) -> None:
    """Let the running kiosk photograph its appearances and compare them with their targets; followed to its end."""
    _job(stage, "compare", {"name": name}, no_wait=no_wait, as_json=as_json)


def show(stage: StageFolder, name: Name, as_json: Json = False) -> None:
    """Let the running kiosk open, and play this appearance from now on."""
    _done(stage, "play", f"{name} is played.", as_json=as_json, name=name)


def remove(stage: StageFolder, name: Name, as_json: Json = False) -> None:
    """Let the running kiosk remove an appearance; not the one that plays, nor one that the schedule names."""
    _done(stage, "remove-appearance", f"{name} is removed with the next bundle.", as_json=as_json, name=name)


def appearances(stage: StageFolder, as_json: Json = False) -> None:
    """The appearances of the installed bundle."""
    rows = _call(stage, "appearances")
    lines = [f"{row['name']}{'  (on the projectors)' if row['playing'] else ''}" for row in rows]
    console.show_result({"appearances": rows} if as_json else "\n".join(lines) or "There are none yet.",
                        as_json=as_json)  # fmt: skip


def results(
    stage: StageFolder,
    run: Annotated[str | None, typer.Argument(help="A run's name; all runs with results if left out.")] = None,
    as_json: Json = False,
) -> None:
    """Grade and figures of a calibration; or which there are, and what the appearances achieve."""
    if run is None:
        names, compared = _call(stage, "runs"), _call(stage, "comparisons")
        lines = [*names, *(_achieved(one) for one in compared)]
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
    return (f"{one['name']}: colour difference {newest['delta_e']:.2f} (95 %: {newest['delta_e_p95']:.2f}), "
            f"sharpness {newest['sharpness']:.2f}, photographed in {newest['run']}")  # fmt: skip


def lamps(stage: StageFolder, as_json: Json = False) -> None:
    """Hours and strikes of each lamp at the end of its last days."""
    rows = _call(stage, "lamp-history")
    lines = [f"{row['day']} {row['projector']:<12} {row['hours']:9,.1f} h {row['strikes']:6} strikes" for row in rows]
    console.show_result({"days": rows} if as_json else "\n".join(lines) or "No lamp has burnt yet.", as_json=as_json)


def aim(
    stage: StageFolder,
    picture: Annotated[Path | None, typer.Option(help="Write what the camera sees into this JPEG file.")] = None,
    shots: Annotated[bool, typer.Option("--shots", help="Take test shots first, with every lamp lit.")] = False,
    as_json: Json = False,
) -> None:
    """What the running kiosk's projectors cover, and what is too dark, too grazing or out of focus."""
    from controller.serve.direct import aiming_text

    if shots:
        _job(stage, "test-shots", {}, no_wait=False, as_json=as_json)
    if picture is not None:
        data = _call(stage, "camera-picture")
        if data is None:
            raise UsageError("picture-unknown", what="The camera shows no picture now.",
                             remedy="See `velatura status`, or take the aiming page's test shot.")  # fmt: skip
        picture.write_bytes(base64.b64decode(data))
    found = _call(stage, "aiming")
    console.show_result(found if as_json else aiming_text(found), as_json=as_json)


def feasibility(
    stage: StageFolder,
    picture: Annotated[Path, typer.Argument(metavar="PNG", help="What the object should look like to the camera.")],
    as_json: Json = False,
) -> None:
    """A map of where a picture can't be reached, before anything is computed."""
    path = _call(stage, "feasibility", target=str(picture.resolve()))
    console.show_result({"file": path} if as_json else f"Written: {path}", as_json=as_json)


def settings(
    stage: StageFolder,
    check: Annotated[Path | None, typer.Option(help="Check this stage.toml without using it.")] = None,
    save: Annotated[Path | None, typer.Option(help="Check this stage.toml, and take it into use.")] = None,
    as_json: Json = False,
) -> None:
    """Print stage.toml, check another one, or take that into use."""
    if save is None and check is None:
        text = _call(stage, "settings")
        console.show_result({"text": text} if as_json else text, as_json=as_json)
        return
    file = save or check
    assert file is not None
    op, said = ("save-settings", "These settings are in use.") if save else ("validate-settings", "They are right.")
    try:
        text = file.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise UsageError("file-unreadable", what=f"{file} can't be read.", remedy="Give a text file.") from error
    _done(stage, op, said, as_json=as_json, text=text)


def _call(stage: Path, op: str, **arguments: Any) -> Any:
    from controller.serve.direct import call

    return call(stage, op, **arguments)


def _done(stage: Path, op: str, sentence: str, *, as_json: bool, **arguments: Any) -> None:
    _call(stage, op, **arguments)
    console.show_result({"done": op} if as_json else sentence, as_json=as_json)


def _job(stage: Path, op: str, arguments: Mapping[str, Any], *, no_wait: bool, as_json: bool) -> None:
    if no_wait:
        _done(stage, op, "It has begun; `velatura status` tells how far it is.", as_json=as_json, **arguments)
        return
    work("controller.serve.following:ask_and_follow", as_json=as_json, stage=stage, op=op, arguments=arguments)


COMMANDS = (recalibrate, compute, compare, show, remove, appearances, results, lamps, aim, feasibility, settings)
