"""``velatura kiosk serve``, ``install`` and ``uninstall``."""

from __future__ import annotations

import contextlib
import dataclasses
import os
import shutil
import tempfile
import threading
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from controller.cli import console
from controller.cli.groups import StageFolder, work
from controller.core.errors import UsageError

if TYPE_CHECKING:
    from controller.cli.kiosk_process import PanelAddress
    from controller.panel.mqtt.options import BrokerOptions
    from controller.run.progress import Reporter

DryRun = Annotated[bool, typer.Option("--dry-run", help="Change nothing; print what would be done.")]


@dataclass(frozen=True, slots=True)
class Panel:
    """Where the panel listens, and how browsers reach it."""

    panel: Annotated[str, typer.Option(help="HOST:PORT where the panel listens.")] = "127.0.0.1:8377"
    no_panel: Annotated[bool, typer.Option("--no-panel", help="Do not start the panel.")] = False
    name: Annotated[list[str] | None, typer.Option(help="Another host name for the panel; can be repeated.")] = None
    certificate: Annotated[Path | None, typer.Option(help="TLS certificate (PEM) of the panel.")] = None
    key: Annotated[Path | None, typer.Option(help="TLS key (PEM) of the panel.")] = None

    def address(self, broker: BrokerOptions | None) -> PanelAddress | None:
        """None without a panel. Raises UsageError("address-wrong", "mqtt-without-panel")."""
        from controller.cli.kiosk_process import PanelAddress, parse_address

        if not self.no_panel:
            host, port = parse_address(self.panel)
            return PanelAddress(host, port, self.certificate, self.key, tuple(self.name or ()), broker)
        if broker is not None:
            raise UsageError(
                "mqtt-without-panel",
                what="MQTT needs the panel, but --no-panel is given.",
                remedy="Remove --no-panel; the panel listens only on this machine by default.",
            )
        return None


@dataclass(frozen=True, slots=True)
class Broker:
    """The MQTT broker of the building's control."""

    mqtt: Annotated[
        str | None, typer.Option(help="HOST[:PORT] of the MQTT broker for building control, or mqtts://HOST for TLS.")
    ] = None
    mqtt_topic: Annotated[str, typer.Option(help="First part of all MQTT topics.")] = "velatura"
    mqtt_user: Annotated[str | None, typer.Option(help="User name for the MQTT broker.")] = None
    mqtt_password_file: Annotated[
        Path | None, typer.Option(help="File that contains only the password for the MQTT broker.")
    ] = None
    mqtt_certificates: Annotated[
        Path | None, typer.Option(help="CA certificates (PEM) to check the MQTT broker; TLS then.")
    ] = None
    mqtt_discovery: Annotated[
        str, typer.Option(help="Let Home Assistant find the stage: its discovery prefix, usually homeassistant.")
    ] = ""

    def options(self) -> BrokerOptions | None:
        """None without a broker. Raises UsageError("address-wrong", "mqtt-address-wrong")."""
        from controller.cli.kiosk_process import parse_address
        from controller.panel.mqtt.options import BrokerOptions

        if self.mqtt is None:
            return None
        scheme, there, place = self.mqtt.rpartition("://")
        user, _, place = place.rstrip("/").rpartition("@")
        if (there and scheme not in ("mqtt", "mqtts")) or ":" in user or "/" in place:
            raise UsageError(
                "mqtt-address-wrong",
                what="The address of the MQTT broker is not HOST[:PORT], mqtt://HOST[:PORT] or mqtts://HOST[:PORT].",
                remedy="Correct --mqtt. A password stands in a file: --mqtt-password-file.",
            )
        tls = scheme == "mqtts" or self.mqtt_certificates is not None
        host, port = parse_address(place, 8883 if tls else 1883)
        return BrokerOptions(
            host, port, self.mqtt_topic, self.mqtt_user or user or None, self.mqtt_password_file,
            self.mqtt_certificates, self.mqtt_discovery, tls,
        )  # fmt: skip


def serve(
    stage: StageFolder,
    panel: Panel,
    broker: Broker,
    leave_lit: Annotated[
        bool, typer.Option("--leave-lit", help="Leave the lamps on at exit, for a service that restarts.")
    ] = False,
    setup: Annotated[
        bool, typer.Option("--setup", help="Start without a valid stage.toml, for set-up in the panel.")
    ] = False,
) -> None:
    """Run the stage by its opening hours, with its panel, until Ctrl-C."""
    address = panel.address(broker.options())

    def do(reporter: Reporter, cancel: threading.Event) -> Mapping[str, Any]:
        from controller.cli.kiosk_process import serve

        return serve(stage=stage, panel=address, leave_lit=leave_lit, setup=setup, reporter=reporter, cancel=cancel)

    work(do)


def agent(
    keys: Annotated[Path, typer.Option(help="Folder of this computer's certificate.")] = Path("keys"),
    name: Annotated[str | None, typer.Option(help="Name of this computer (default: its host name).")] = None,
    admit: Annotated[str, typer.Option(help="At the stage instead: admit the computer at this address.")] = "",
    code: Annotated[str, typer.Option(help="The code that the computer to admit shows.")] = "",
    stage: Annotated[Path, typer.Option(help="The stage's folder, with --admit.")] = Path(),
) -> None:
    """Keep players of this computer in step with a stage on another computer. It joins by a code that it shows."""

    def do(reporter: Reporter, cancel: threading.Event) -> Mapping[str, Any]:
        from controller.kiosk.install.steps import only_plays
        from controller.kiosk.install.system import System
        from controller.kiosk.install.update import Packages
        from controller.stage.hosts.agent import admitted, keep
        from controller.stage.rig.elsewhere import DevicesHere

        if admit:
            return admitted(stage, admit, code)
        system = System(reporter.say)
        updates = partial(Packages, system) if only_plays(system) else None
        return keep(keys, name, partial(_on_screen, reporter.say), cancel, DevicesHere, updates)

    work(do)


def worker(
    folder: Annotated[Path, typer.Argument(help="What the kiosk tells its workers in; the service has it.")],
) -> None:
    """Solve for the stages of the house while this one is closed; on the house, share the work out."""

    def do(reporter: Reporter, cancel: threading.Event) -> Mapping[str, Any]:
        from controller.kiosk.house.workers import work as run

        run(folder, cancel)
        return {}

    work(do)


@contextlib.contextmanager
def _on_screen(say: Callable[[str], object], code: str) -> Iterator[None]:
    """The code of a computer that joins, on its first projector; here in any case."""
    from controller.kiosk.outputs import outputs_of_x, placed, player_outputs
    from controller.kiosk.supervisors.on_screen_text import notice, outputs_of, put
    from controller.play.control.launch import PlayerSettings, start_player
    from hal.deadline import in_seconds
    from hal.player import PlayerClient

    say(code)
    with contextlib.ExitStack() as stack:
        if found := player_outputs(placed(outputs_of_x())):
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
            player = stack.enter_context(start_player(folder, PlayerSettings(found, None)))
            hello = player.wait_until_ready()
            sequence = put(Path(hello["inbox"]), outputs_of(hello), notice(outputs_of(hello), [code], 0))
            PlayerClient().request(player.socket, {"op": "show", "sequence": sequence}, in_seconds(5))
        yield


def install(
    backup: Annotated[
        Path | None,
        typer.Option(
            help="Make this blank computer the kiosk of this backup (velatura-DATE.tar.gz). All projectors must be "
            "switched on. Where serial numbers do not tell which is which, they show numbers, and you are asked.",
            exists=True,
            dir_okay=False,
        ),
    ] = None,
    dry_run: DryRun = False,
    outputs: Annotated[
        bool, typer.Option("--outputs", help="Look again which projectors are plugged in; all must be switched on.")
    ] = False,
    restart: Annotated[
        bool, typer.Option("--restart", help="Start controller and player again, for a new version. Lamps stay lit.")
    ] = False,
    player: Annotated[
        bool, typer.Option("--player", help="Only outputs of a stage that another computer runs.")
    ] = False,
    worker: Annotated[
        bool, typer.Option("--worker", help="Solve for the stages of the house while this one is closed.")
    ] = False,
    trust: Annotated[
        list[Path] | None, typer.Option(help="Take updates signed by this public key (.pub); can be repeated.")
    ] = None,
) -> None:
    """Make this computer a kiosk, and start it. As root, on Debian 12 or 13: user, services, X server and panel."""
    from controller.kiosk.install import restored, steps
    from controller.kiosk.install.system import System

    _require_root(dry_run)
    system = System(console.say, dry=dry_run)
    for key in trust or ():
        steps.trust(system, key)
    if backup is not None:
        restored.restore(system, backup.absolute(), ask=lambda text: str(typer.prompt(text)), say=console.say)
    elif player:
        steps.install_player(system, say=console.say, restart=restart)
    else:
        steps.install(system, outputs_again=outputs, restart=restart, say=console.say)
        if worker:
            steps.install_worker(system)
    text = "The kiosk runs, and starts with this computer."
    if backup is not None:
        text = "The backup is in place. `velatura kiosk changes` and `velatura doctor` tell what is different here."
    console.show_result({"installed": not dry_run}, "Nothing was changed." if dry_run else text)


def update(
    package: Annotated[
        Path | None, typer.Argument(help="A signed package; without one, the last update is shown.", dir_okay=False)
    ] = None,
    dry_run: DryRun = False,
    carry_out: Annotated[bool, typer.Option(hidden=True)] = False,
    sign: Annotated[
        Path | None, typer.Option(help="Only sign this package, with a key made by `velatura bundle key`.")
    ] = None,
) -> None:
    """Replace this version by that of a package, as root. It comes back if the kiosk is not as well as before."""
    from controller.bundle.signing import load_signing_key
    from controller.core.kiosk_places import STAGE
    from controller.core.storage import stream_atomically
    from controller.kiosk.api.control import call_kiosk
    from controller.kiosk.install import steps, update
    from controller.kiosk.install.system import System

    system = System(console.say)
    if package is not None and sign is not None:
        update.sign_package(package, load_signing_key(sign), package)
        console.show_result({"signed": package})
        return
    _require_root(dry_run)
    if package is not None:
        update.check_package(package, system.at(steps.TRUSTED))
    if package is None:
        if carry_out:
            plays, asked = steps.only_plays(system), lambda: dict(call_kiosk(STAGE, "status"))
            update.Updates(system, status=(lambda: update.status_of_player(system)) if plays else asked).run()
        console.show_result(dataclasses.asdict(update.outcome(system)))
    elif dry_run:
        console.show_result(update.changes(system, package))
    else:
        update.needs(system, package)
        with package.open("rb") as content:
            stream_atomically(update.OFFERED, lambda file: shutil.copyfileobj(content, file))
        console.show_result({"offered": package}, "`journalctl -fu velatura-update` tells what becomes of it.")


def uninstall(
    dry_run: DryRun = False,
    purge: Annotated[bool, typer.Option("--purge", help="Remove the stage, the settings and the user, too.")] = False,
) -> None:
    """Stop the kiosk, and remove what `velatura kiosk install` wrote. The stage stays. As root."""
    from controller.kiosk.install import steps
    from controller.kiosk.install.system import System

    _require_root(dry_run)
    steps.uninstall(System(console.say, dry=dry_run), purge=purge)
    console.show_result({"removed": not dry_run}, "Nothing was changed." if dry_run else "The kiosk is removed.")


def _require_root(dry_run: bool) -> None:
    if os.geteuid() != 0 and not dry_run:
        raise UsageError("needs-root", what="Only root can do this.", remedy="Type it as root, or with sudo.")
