"""Finds who may open a device file, and which programs have it open, from its mode and from /proc."""

from __future__ import annotations

import contextlib
import grp
import os
import pwd
from importlib import resources
from pathlib import Path
from typing import Final

from hal.escapes import escaped
from hal.notices import Notice

_PROC: Final = Path("/proc")


def rule_text(name: str, needle: str) -> str:
    """The lines of the shipped udev rules ``name`` with ``needle``, to show them to a person."""
    rules = (resources.files("firmware_configs") / "udev" / name).read_text(encoding="utf-8")
    return "\n".join(line for line in rules.splitlines() if needle in line and not line.startswith("#"))


def forbidden(node: Path, device: str, rules: str, needle: str) -> Notice | None:
    """The problem of a device file that this user may not read and write; None if there is none."""
    if os.access(node, os.R_OK | os.W_OK):
        return None
    try:
        status = node.stat()
    except OSError:
        return None  # it has just left
    owner, group = _user(status.st_uid), _group(status.st_gid)
    path = resources.files("firmware_configs") / "udev" / rules
    return Notice.warning(
        "device-forbidden",
        what=f"This user ({_user(os.geteuid())}) may not open the {device} at {node}: it belongs to {owner}:{group}, "
        f"mode {status.st_mode & 0o777:04o}.",
        remedy=f"Install the rule {rule_text(rules, needle)} with: sudo cp {path} /etc/udev/rules.d/ && "
        "sudo udevadm control --reload && sudo udevadm trigger; then plug the device in again, or log in again if "
        f"this user is not yet in the rule's group.",
    )


def holders(node: Path) -> tuple[str, ...]:
    """Other programs that have ``node`` open, as ``name (process number)``, as far as this user may see."""
    target = os.path.realpath(node)
    found = []
    for process in _PROC.iterdir():
        if not process.name.isdigit() or int(process.name) == os.getpid():
            continue
        with contextlib.suppress(OSError):
            if any(_leads_to(link, target) for link in (process / "fd").iterdir()):
                found.append(f"{_name(process)} ({process.name})")
    return tuple(found)


def running(*names: str) -> tuple[str, ...]:
    """Processes whose command has one of these names, as ``name (process number)``."""
    found = []
    for process in _PROC.iterdir():
        if process.name.isdigit():
            with contextlib.suppress(OSError):
                command = (process / "cmdline").read_bytes().split(b"\0")[0].rpartition(b"/")[2].decode("latin-1")
                if command in names:
                    found.append(f"{_name(process)} ({process.name})")
    return tuple(found)


def _leads_to(link: Path, target: str) -> bool:
    try:
        return str(link.readlink()) == target
    except OSError:
        return False


def _name(process: Path) -> str:
    return escaped((process / "comm").read_bytes().strip()[:40])


def _user(number: int) -> str:
    try:
        return pwd.getpwuid(number).pw_name
    except KeyError:
        return str(number)


def _group(number: int) -> str:
    try:
        return grp.getgrgid(number).gr_name
    except KeyError:
        return str(number)
