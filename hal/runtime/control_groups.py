"""The control groups of this process: what limits its CPUs and its memory beside the machine itself."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Final

GROUPS: Final = Path("/sys/fs/cgroup")
"""Where control groups are mounted, version 1 or 2."""
MEMBERSHIP: Final = Path("/proc/self/cgroup")
"""The file that names this process's groups."""


def groups_of(controller: str, groups: Path = GROUPS, membership: Path = MEMBERSHIP) -> Iterator[Path]:
    """The folders of this process's groups, and of each group above, that may limit ``controller`` ("cpu", ...)."""
    try:
        lines = membership.read_text().splitlines()
    except OSError:
        return
    for controllers, name in (line.split(":", 2)[1:] for line in lines if line.count(":") >= 2):
        if controllers and controller not in controllers.split(","):
            continue
        mount = groups if not controllers else groups / controllers
        path = mount / name.lstrip("/")
        for group in (path, *path.parents):
            if not group.is_relative_to(mount):
                break
            yield group
