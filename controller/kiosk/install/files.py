"""What the installation writes: units, rules and X settings as they are shipped, and small files of its own."""

from __future__ import annotations

from importlib import resources
from pathlib import Path
from typing import Final

import firmware_configs
from controller.core.kiosk_places import RUNTIME, USER

CONFIGURATION: Final = Path("/etc/velatura")
CERTIFICATE: Final = CONFIGURATION / "panel.crt"
KEY: Final = CONFIGURATION / "panel.key"
CONTROLLER_OPTIONS: Final = CONFIGURATION / "controller.env"
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
        Path("/etc/tmpfiles.d/velatura.conf"): f"d {RUNTIME} 0700 {USER} {USER} -\n",
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
