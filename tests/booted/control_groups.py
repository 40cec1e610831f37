"""A control group for each machine: the systemd of one that shares another's fails to signal its services."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path
from typing import Final

_MOUNTED: Final = Path("/sys/fs/cgroup")


class ControlGroups:
    """Of one machine, in each hierarchy that systemd uses here."""

    def __init__(self, name: str) -> None:
        self._folders = [folder / name for folder in _ours()]

    def entered(self, command: list[str]) -> list[str]:
        """The words that run ``command`` in these groups, which are made where they are not there."""
        entering = "".join(f"echo $$ > {folder}/cgroup.procs; " for folder in self._folders)
        for folder in self._folders:
            folder.mkdir(exist_ok=True)
        return ["sh", "-ec", f'{entering}exec "$@"', "sh", *command]

    def remove(self) -> None:
        """Once all of their processes have ended."""
        for folder in self._folders:
            for path, _, _ in os.walk(folder, topdown=False):
                with contextlib.suppress(OSError):  # a process that is just ending
                    Path(path).rmdir()


def _ours() -> list[Path]:
    """The folders of this process's own groups."""
    found = []
    for line in Path("/proc/self/cgroup").read_text().splitlines():
        number, controllers, path = line.split(":", 2)
        unified = _MOUNTED / "unified" if (_MOUNTED / "unified").is_dir() else _MOUNTED
        if controllers == "name=systemd":
            found.append(_MOUNTED / "systemd" / path.lstrip("/"))
        elif number == "0":
            found.append(unified / path.lstrip("/"))
    return [folder for folder in found if folder.is_dir()]
