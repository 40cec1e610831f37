"""The installation, step by step. Each step looks first, so that it can be repeated."""

from __future__ import annotations

import os
import re
import sys
import time
from collections.abc import Callable, Sequence
from importlib import resources
from pathlib import Path
from typing import Final

import firmware_configs
from controller.bundle.signing import load_public_key
from controller.core.errors import UsageError
from controller.core.kiosk_places import PLAYER_OPTIONS, RUNTIME, STAGE, STATE, USER
from controller.kiosk.install.system import System
from controller.kiosk.outputs import Connected, Placed, connected, placed, player_outputs, x_configuration
from controller.kiosk.panel_address import FIRST_LOGIN, addresses
from controller.play.control.launch import PlayerSettings

CONFIGURATION: Final = Path("/etc/velatura")
TRUSTED: Final = CONFIGURATION / "update-keys"
"""Public keys (*.pub) of those whose updates this computer takes."""
CERTIFICATE: Final = CONFIGURATION / "panel.crt"
KEY: Final = CONFIGURATION / "panel.key"
CONTROLLER_OPTIONS: Final = CONFIGURATION / "controller.env"
UNFINISHED: Final = CONFIGURATION / ".installing"
"""There from the first change to the last: an installation that was cut off is done again, with all that follows."""
X_OUTPUTS: Final = Path("/etc/X11/xorg.conf.d/20-velatura-outputs.conf")
COMMAND: Final = Path("/usr/local/bin/velatura")
SHIPPED_PREFIX: Final = "/opt/velatura"
"""Where the shipped units expect the program."""
_FOLDERS: Final = {
    "systemd": Path("/etc/systemd/system"),
    "udev": Path("/etc/udev/rules.d"),
    "x11": Path("/etc/X11/xorg.conf.d"),
}


def shipped(prefix: Path) -> dict[Path, str]:
    """Files that are the same on every kiosk, whose program is installed in ``prefix``."""
    found = {
        Path("/etc/tmpfiles.d/velatura.conf"): (
            f"d {RUNTIME} 0700 {USER} {USER} -\nd {RUNTIME}/cluster 0750 {USER} {USER} -\n"
        ),
        Path("/etc/systemd/journald.conf.d/velatura.conf"): "[Journal]\nSystemMaxUse=200M\n",
    }
    for name, folder in _FOLDERS.items():
        for file in sorted((resources.files(firmware_configs) / name).iterdir(), key=lambda one: one.name):
            found[folder / file.name] = file.read_text().replace(SHIPPED_PREFIX, str(prefix))
    return found


def controller_options(host: str) -> str:
    """The panel in the local network, with TLS; to be changed by people."""
    return (
        "# Options of `velatura kiosk serve` for this kiosk; `velatura kiosk serve --help` explains them.\n"
        f"OPTIONS=--panel 0.0.0.0:8377 --certificate {CERTIFICATE} --key {KEY} --name {host} --name {host}.local\n"
    )


PACKAGES: Final = (
    "xserver-xorg-core", "xauth", "x11-xserver-utils", "libgl1-mesa-dri", "libgl1", "libxrandr2", "libxext6",
    "libusb-1.0-0", "libhidapi-libusb0", "libgomp1", "openssl", "openssh-client",
)  # fmt: skip
AMD: Final = "xserver-xorg-video-amdgpu"
GROUPS: Final = ("dialout", "plugdev", "video", "render")
SERVICES: Final = ("velatura-x11", "velatura-player", "velatura-controller")
AGENT: Final = "velatura-agent"
WORKER: Final = "velatura-worker"
NETWORK: Final = Path("/etc/systemd/system/velatura-player.service.d/network.conf")
TARGET: Final = "velatura.target"
UPDATES: Final = "velatura-update.path"
DEBIAN: Final = {"bookworm": "12", "trixie": "13"}
PYTHON: Final = {"bookworm": "3.11", "trixie": "3.13"}
"""Of each Debian."""
NO_OUTPUTS: Final = [("projector", 1024, 768)]
"""For the player, while nothing is plugged in."""
READY_S: Final = 60.0
_X: Final = {"DISPLAY": ":0", "XAUTHORITY": "/run/velatura-x11/cookie"}


def only_plays(system: System) -> bool:
    """Whether this computer is one of ``install_player``."""
    return os.path.lexists(system.at(Path(f"/etc/systemd/system/{TARGET}.wants/{AGENT}.service")))


def install_player(
    system: System, *, say: Callable[[str], None], restart: bool = False, prefix: Path = Path(sys.prefix)
) -> None:
    """Make this computer one with outputs of another one's stage: X server and agent. ``restart``: the program is
    another version; the outputs stay. Raises as ``install``.
    """
    check(system, prefix)
    system.folder(CONFIGURATION)
    _packages(system, "chrony")
    _user(system)
    system.run("systemctl", "stop", "--quiet", *SERVICES[1:], may_fail=True)
    for path, text in shipped(prefix).items():
        if path.stem in SERVICES[1:]:
            system.remove(path)
        else:
            system.write(path, text)
    _folders(system)
    system.run("systemctl", "daemon-reload")
    system.run("systemctl", "enable", "--quiet", TARGET, AGENT, UPDATES)
    system.run("systemctl", "start", "velatura-x11", UPDATES)
    _outputs(system, again=not restart, say=say)
    system.run("systemctl", "restart", AGENT)


def install_worker(system: System) -> None:
    """Let an installed kiosk solve for its house. Raises WorkError("kiosk-step-failed")."""
    system.run("systemctl", "enable", "--quiet", "--now", WORKER)


def _conducts(system: System) -> bool:
    """Let the player of a stage with outputs on other computers use the network; whether that is new."""
    if not re.search(r"^host *=", system.read(STAGE / "stage.toml") or "", re.MULTILINE):
        return False
    _packages(system, "chrony")
    return system.write(NETWORK, "[Service]\nRestrictAddressFamilies=AF_INET AF_INET6 AF_NETLINK\nIPAddressDeny=\n")


def install(
    system: System, *, outputs_again: bool, restart: bool, say: Callable[[str], None], prefix: Path = Path(sys.prefix)
) -> None:
    """Make this computer a kiosk, and start it. ``outputs_again``: look which projectors are plugged in, also where
    that was done before. ``restart``: the program is another version; controller and player start again.

    Raises UsageError("kiosk-system-unknown", "kiosk-has-desktop" or "kiosk-place-hidden"), and
    WorkError("kiosk-step-failed").
    """
    check(system, prefix)
    system.folder(CONFIGURATION)
    mark = system.at(UNFINISHED)
    cut_off = mark.exists()
    if not system.dry:
        mark.touch()
    _packages(system)
    _user(system)
    changed = [cut_off, _conducts(system), *(system.write(path, text) for path, text in shipped(prefix).items())]
    _folders(system)
    if not os.path.lexists(system.at(COMMAND)):
        system.run("ln", "--symbolic", str(prefix / "bin" / "velatura"), str(COMMAND))
    _panel(system, cut_off=cut_off)
    if any(changed):
        system.run("systemctl", "daemon-reload")
        system.run("udevadm", "control", "--reload", may_fail=True)
        system.run("udevadm", "trigger", may_fail=True)
    system.run("systemctl", "enable", "--quiet", TARGET, UPDATES)
    system.run("systemctl", "restart" if cut_off else "start", "velatura-x11")
    _outputs(system, again=outputs_again, say=say)
    if restart or any(changed):
        # In this order the player stops only once the controller has, and starts at once, before the controller. In the
        # other order there is no player for as long as the controller takes to stop.
        # A service that does not start tells why; the package must not stay half installed for it.
        system.run("systemctl", "restart", *reversed(SERVICES[1:]), may_fail=restart)
        system.run("systemctl", "try-restart", WORKER, may_fail=True)
    system.run("systemctl", "start", TARGET, may_fail=restart)
    if not system.dry:
        _first_login(system, say)
        mark.unlink()


def trust(system: System, key: Path) -> None:
    """Take updates that this public key has signed. Raises UsageError("key-unreadable")."""
    load_public_key(key)
    system.folder(TRUSTED)
    system.write(TRUSTED / key.name, key.read_text())


def uninstall(system: System, *, purge: bool, prefix: Path = Path(sys.prefix)) -> None:
    """Take everything back but the stage and the packages. ``purge``: the stage, the settings and the user, too."""
    for unit in (TARGET, AGENT, UPDATES, WORKER, *SERVICES):
        system.run("systemctl", "disable", "--now", "--quiet", unit, may_fail=True)
    for path in (*shipped(prefix), NETWORK, X_OUTPUTS, PLAYER_OPTIONS):
        system.remove(path)
    if system.at(COMMAND).is_symlink():
        system.remove(COMMAND)
    system.remove(RUNTIME)
    system.run("systemctl", "daemon-reload", may_fail=True)
    system.run("udevadm", "control", "--reload", may_fail=True)
    if purge:
        system.remove(STATE)
        system.remove(CONFIGURATION)
        if system.look("getent", "passwd", USER) is not None:
            system.run("userdel", USER)


def check(system: System, prefix: Path) -> None:
    """Refuse a computer on which the kiosk would not work."""
    here = dict(
        re.findall(r'^(ID|VERSION_ID)="?([^"\n]*)"?$', system.read(Path("/etc/os-release")) or "", re.MULTILINE)
    )
    if here.get("ID") != "debian" or here.get("VERSION_ID") not in DEBIAN.values():
        raise UsageError(
            "kiosk-system-unknown",
            what=f"This is {here.get('ID', 'an unknown system')} {here.get('VERSION_ID', '')}, not Debian 12 or 13.",
            remedy="Install Debian 12 or 13 on this computer.",
        )
    if (system.look("systemctl", "is-active", "display-manager") or "").strip() == "active":
        raise UsageError(
            "kiosk-has-desktop",
            what="A desktop runs on this computer, and it uses the projectors' outputs.",
            remedy="Switch it off: systemctl disable --now display-manager",
        )
    if prefix.is_relative_to("/home") or prefix.is_relative_to("/root"):
        raise UsageError(
            "kiosk-place-hidden",
            what=f"Velatura is installed in {prefix}, which the services can't see.",
            remedy="Install it into /opt/velatura.",
        )


def _packages(system: System, *more: str) -> None:
    cards = system.look("sh", "-c", "cat /sys/class/drm/card*/device/vendor") or ""
    wanted = (*PACKAGES, *more, *((AMD,) if "0x1002" in cards else ()))
    listed = system.look("dpkg-query", "--show", "--showformat", "${Package} ${db:Status-Status}\n") or ""
    there = {line.split()[0] for line in listed.splitlines() if line.endswith(" installed")}
    # Debian 13 calls some libraries with 64-bit times by another name, and provides the old one.
    missing = [name for name in wanted if name not in there and f"{name}t64" not in there]
    if missing:
        system.run("dpkg", "--configure", "--pending")
        system.run("apt-get", "update", "--quiet")
        system.run("apt-get", "install", "--yes", "--no-install-recommends", *missing)


def _user(system: System) -> None:
    if system.look("getent", "passwd", USER) is None:
        system.run("useradd", "--system", "--home-dir", str(STATE), "--shell", "/usr/sbin/nologin", USER)
    there = (system.look("id", "--name", "--groups", USER) or "").split()
    missing = [name for name in GROUPS if name not in there]
    for name in missing:
        if system.look("getent", "group", name) is None:
            system.run("groupadd", "--system", name)
    if missing:
        system.run("usermod", "--append", "--groups", ",".join(missing), USER)


def _folders(system: System) -> None:
    owner = f"{USER}:{USER}"
    system.folder(STATE, mode=0o750, owner=owner)
    system.folder(STAGE, mode=0o750, owner=owner)
    # The example of docs/how-to/run-a-kiosk.md.
    system.folder(STATE / "backups", mode=0o750, owner=owner)
    if not system.at(RUNTIME / "cluster").is_dir():
        system.run("systemd-tmpfiles", "--create", "/etc/tmpfiles.d/velatura.conf")


def _panel(system: System, *, cut_off: bool) -> None:
    host = (system.look("hostname") or system.read(Path("/etc/hostname")) or "velatura").strip()
    fresh = system.read(KEY) is None or (cut_off and system.read(CERTIFICATE) is None)
    if fresh:
        names = f"subjectAltName=DNS:{host},DNS:{host}.local"
        system.run(
            "openssl", "req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes",
            "-days", "7300", "-subj", f"/CN={host}", "-addext", names,
            "-keyout", str(KEY), "-out", str(CERTIFICATE),
        )  # fmt: skip
    if fresh or cut_off:
        system.run("chown", f"root:{USER}", str(KEY))
        system.run("chmod", "0640", str(KEY))
    if system.read(CONTROLLER_OPTIONS) is None:
        system.write(CONTROLLER_OPTIONS, controller_options(host))


def outputs(system: System) -> list[Connected]:
    """What the kiosk's X server has now."""
    return connected(system.look("xrandr", "--verbose", more=_X) or "")


def write_outputs(system: System, found: Sequence[Placed]) -> None:
    """The X server's settings for these; it is restarted if they differ."""
    if system.write(X_OUTPUTS, x_configuration(found)):
        system.run("systemctl", "restart", "velatura-x11")


def _outputs(system: System, *, again: bool, say: Callable[[str], None]) -> None:
    """X settings and the player's outputs, from what is plugged in; only once, because a projector that is off later
    looks like one that is gone.
    """
    if not again and system.read(X_OUTPUTS) is not None:
        return
    if system.dry:
        say("Then the X server is asked what is plugged in, and its settings and the player's outputs are written.")
        return
    found = placed(outputs(system))
    if not found:
        say("No projector is plugged in and switched on. Type `velatura kiosk install --outputs` once they are.")
    else:
        say("Projectors: " + ", ".join(f"{one.name} with {one.mode.name}" for one in found) + ".")
    # A stage has outputs of its own, which the service writes there.
    if system.read(STAGE / "stage.toml") is None:
        settings = PlayerSettings(player_outputs(found) or NO_OUTPUTS, None, bundle=STAGE / "bundles" / "current")
        text = "".join(f"{word}\n" for word in settings.arguments())
        if system.write(PLAYER_OPTIONS, text, mode=0o600, owner=f"{USER}:{USER}"):
            system.run("systemctl", "try-restart", "velatura-player", may_fail=True)
    if found:
        # Last: where they are, all this was done.
        write_outputs(system, found)


def _first_login(system: System, say: Callable[[str], None]) -> None:
    """Say where the panel is, and, once, the one-time password of a new kiosk."""
    until_s = time.monotonic() + READY_S
    while system.look("systemctl", "is-active", "--quiet", "velatura-controller") is None:
        if time.monotonic() > until_s:
            say("The controller is not ready yet. `systemctl status velatura-controller` tells why.")
            return
        time.sleep(0.5)
    listens = re.search(r"--panel[= ](\S+)", system.read(CONTROLLER_OPTIONS) or "")
    for address in addresses(f"https://{listens[1]}") if listens else ():
        say(f"Panel: {address}")
    first_login = system.read(RUNTIME / FIRST_LOGIN)
    if first_login is not None:
        account, password = first_login.split()
        say(f"First login: {account}, password {password} (once).")
        system.at(RUNTIME / FIRST_LOGIN).unlink()
