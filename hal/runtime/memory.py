"""How much memory this process may still use. Loads only the standard library."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from hal.runtime.control_groups import GROUPS, MEMBERSHIP, groups_of

MEMINFO: Final = Path("/proc/meminfo")
_LIMITS: Final = (
    ("memory.max", "memory.current", ("inactive_file", "active_file")),
    ("memory.limit_in_bytes", "memory.usage_in_bytes", ("total_inactive_file", "total_active_file")),
)
"""Of version 2 and 1: the limit, what is used, and what of it the system can take back."""


def free_bytes(groups: Path = GROUPS, membership: Path = MEMBERSHIP, meminfo: Path = MEMINFO) -> int | None:
    """Bytes that can be had without swapping: of the machine, or of the tightest control group; None: not known."""
    found = [_of_group(group) for group in groups_of("memory", groups, membership)]
    known = [value for value in (_of_machine(meminfo), *found) if value is not None]
    return max(min(known), 0) if known else None


def _of_machine(meminfo: Path) -> int | None:
    try:
        rows = dict(line.split(":", 1) for line in meminfo.read_text().splitlines() if ":" in line)
        return int(rows["MemAvailable"].split()[0]) * 1024
    except (OSError, ValueError, KeyError, IndexError):
        return None


def _of_group(group: Path) -> int | None:
    """Its limit less what is used; files in the system's cache do not count, since they make room."""
    for limit, used, reclaimable in _LIMITS:
        try:
            most = (group / limit).read_text().strip()
            if most == "max":
                return None
            rows = dict(line.split(" ", 1) for line in (group / "memory.stat").read_text().splitlines())
            cached = sum(int(rows.get(name, 0)) for name in reclaimable)
            return int(most) - int((group / used).read_text()) + cached
        except (OSError, ValueError):
            continue
    return None
