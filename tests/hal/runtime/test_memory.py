"""Free memory: of the machine and of control groups, both versions."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import pytest

from hal.runtime.compute import free_bytes

MEMINFO = "MemTotal: 9000 kB\nMemAvailable:    8000 kB\n"
STAT = "anon 1\ninactive_file 300\nactive_file 100\n"
V1 = "total_inactive_file 50\ntotal_active_file 0\n"


@pytest.mark.parametrize(
    ("files", "membership", "free"),
    [
        ({"memory.max": "max"}, "0::/\n", 8_192_000),
        ({"k/memory.max": "5000", "k/memory.current": "4500", "k/memory.stat": STAT}, "0::/k\n", 900),
        ({"k/memory.max": "5000", "k/memory.current": "4500", "k/memory.stat": STAT}, "0::/k/below\n", 900),
        ({"k/memory.max": "5000", "k/memory.current": "6000", "k/memory.stat": ""}, "0::/k\n", 0),
        ({"k/memory.max": "nonsense"}, "0::/k\n", 8_192_000),
        (
            {
                "memory/k/memory.limit_in_bytes": "1000",
                "memory/k/memory.usage_in_bytes": "700",
                "memory/k/memory.stat": V1,
            },
            "7:memory:/k\n3:cpu:/k\n",
            350,
        ),
    ],
)
def test_the_tightest_limit_counts_and_cached_files_do_not(
    tmp_path: Path, files: Mapping[str, str], membership: str, free: int
) -> None:
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    (tmp_path / "membership").write_text(membership)
    (tmp_path / "meminfo").write_text(MEMINFO)
    assert free_bytes(tmp_path, tmp_path / "membership", tmp_path / "meminfo") == free


def test_nothing_is_said_where_the_system_says_nothing(tmp_path: Path) -> None:
    nowhere = tmp_path / "nowhere"
    assert free_bytes(nowhere, nowhere, nowhere) is None


def test_this_machine_has_some() -> None:
    assert (free_bytes() or 0) > 0
