"""``velatura serve`` and ``init``, and the kiosk's state, events and opening hours."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from controller.cli import console
from controller.cli.running import Json, StageFolder, work
from controller.core.errors import UsageError
from controller.core.text import printable

if TYPE_CHECKING:
    from controller.run.progress import Reporter


def serve(
    stage: StageFolder,
    panel: Annotated[str, typer.Option(help="HOST:PORT where the panel listens.")] = "127.0.0.1:8377",
    no_panel: Annotated[bool, typer.Option("--no-panel", help="Do not start the panel.")] = False,
    name: Annotated[list[str] | None, typer.Option(help="Another host name for the panel; can be repeated.")] = None,
    certificate: Annotated[Path | None, typer.Option(help="TLS certificate (PEM) of the panel.")] = None,
    key: Annotated[Path | None, typer.Option(help="TLS key (PEM) of the panel.")] = None,
    mqtt: Annotated[str | None, typer.Option(help="HOST[:PORT] of the MQTT broker for building control.")] = None,
    mqtt_topic: Annotated[str, typer.Option(help="First part of all MQTT topics.")] = "velatura",
    mqtt_user: Annotated[str | None, typer.Option(help="User name for the MQTT broker.")] = None,
    mqtt_password_file: Annotated[
        Path | None, typer.Option(help="File that contains only the password for the MQTT broker.")
    ] = None,
    mqtt_certificates: Annotated[
        Path | None, typer.Option(help="CA certificates (PEM) to check the MQTT broker (default: no TLS).")
    ] = None,
    mqtt_discovery: Annotated[
        str, typer.Option(help="Let Home Assistant find the stage: its discovery prefix, usually homeassistant.")
    ] = "",
    leave_lit: Annotated[
        bool, typer.Option("--leave-lit", help="Leave the lamps on at exit, for a service that restarts.")
    ] = False,
    setup: Annotated[
        bool, typer.Option("--setup", help="Start without a valid stage.toml, for set-up in the panel.")
    ] = False,
    as_json: Json = False,
) -> None:
    """Run the stage unattended by its schedule, with the panel for the technician, until Ctrl-C."""
    from controller.cli.serve_command import PanelAddress, parse_address
    from controller.panel.mqtt.options import BrokerOptions

    host, port = parse_address(panel)
    broker = None
    if mqtt is not None:
        if no_panel:
            raise UsageError(
                "mqtt-without-panel",
                what="MQTT needs the panel, but --no-panel is given.",
                remedy="Remove --no-panel; the panel listens only on this machine by default.",
            )
        usual = 1883 if mqtt_certificates is None else 8883
        where = parse_address(mqtt if ":" in mqtt else f"{mqtt}:{usual}")
        broker = BrokerOptions(*where, mqtt_topic, mqtt_user, mqtt_password_file, mqtt_certificates, mqtt_discovery)
    address = None if no_panel else PanelAddress(host, port, certificate, key, tuple(name or ()), broker)

    def do(reporter: Reporter, cancel: threading.Event) -> Mapping[str, Any]:
        from controller.cli.serve_command import serve

        return serve(stage=stage, panel=address, leave_lit=leave_lit, setup=setup, reporter=reporter, cancel=cancel)

    work(do, as_json=as_json)


def init(
    stage: Annotated[Path, typer.Argument(metavar="STAGE", help="The folder to set up; created if missing.")],
    name: Annotated[str | None, typer.Option(help="Name of the object (default: you are asked).")] = None,
    focal_length_px: Annotated[
        float | None, typer.Option(help="Focal length in pixels of the camera picture.", min=1.0)
    ] = None,
    yes: Annotated[bool, typer.Option("--yes", help="Ask no questions; use the devices found.")] = False,
    as_json: Json = False,
) -> None:
    """Set up a stage: find the devices, name the object, and write stage.toml and a signing key."""
    from controller.kiosk.setup import set_up

    def ask(question: str, suggestion: str) -> str:
        return suggestion if yes or as_json else str(typer.prompt(question, default=suggestion))

    done = set_up(stage, name=name, focal_length_px=focal_length_px, ask=ask)
    text = "\n".join([*done["words"], f"Written: {done['file']}", f"Next: velatura doctor {stage}"])
    console.show_result(done if as_json else text, as_json=as_json)


def status(stage: StageFolder, as_json: Json = False) -> None:
    """Show what the stage does now, and its faults."""
    from controller.kiosk.api.offline_dispatch import status_of, status_text

    content = status_of(stage)
    console.show_result(content if as_json else status_text(content), as_json=as_json)


def events(
    stage: StageFolder,
    after: Annotated[int, typer.Option(help="Only events after this number.", min=0)] = 0,
    level: Annotated[str, typer.Option(help="Minimum level: info, warning or error.")] = "info",
    as_json: Json = False,
) -> None:
    """Show the kiosk's event log."""
    from controller.kiosk.api.offline_dispatch import LEVELS, call

    if level not in LEVELS:
        raise UsageError("wrong-use", what=f"There is no level {level}.", remedy=f"Choose one of {', '.join(LEVELS)}.")
    rows = [row for row in call(stage, "events", after=after) if LEVELS.index(row["level"]) >= LEVELS.index(level)]
    lines = [f"{row['number']:>7} {_local(row['unix_s'])} {row['level']:<7} {printable(row['text'])}" for row in rows]
    console.show_result({"events": rows} if as_json else "\n".join(lines), as_json=as_json)


def schedule(
    stage: StageFolder,
    zone: Annotated[str | None, typer.Option(help="Time zone, e.g. Europe/Vienna.")] = None,
    hours: Annotated[
        list[str] | None,
        typer.Option(help="DAY=HH:MM-HH:MM or DAY=closed; replaces all rows. DAY is mon, mon-fri, daily, or a date."),
    ] = None,
    drift_check: Annotated[str | None, typer.Option(help='HH:MM of the nightly check; "" for no check.')] = None,
    as_json: Json = False,
) -> None:
    """Show the opening hours, or change them."""
    from controller.kiosk.api.offline_dispatch import call, changed_schedule, schedule_text

    now = call(stage, "schedule")
    if zone is not None or hours is not None or drift_check is not None:
        now = changed_schedule(now, zone, hours, drift_check)
        call(stage, "set-schedule", **now)
    console.show_result(now if as_json else schedule_text(now), as_json=as_json)


def _local(unix_s: float) -> str:
    return datetime.fromtimestamp(unix_s, tz=datetime.now().astimezone().tzinfo).strftime("%Y-%m-%d %H:%M:%S")


COMMANDS = (serve, init, status, events, schedule)
