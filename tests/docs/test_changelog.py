"""The changelog is for users: short entries, and each only once."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import Final

ROOT: Final = Path(__file__).parents[2]
PAGE: Final = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
LONGEST: Final = 40
"""Words in an entry."""


def entries() -> list[str]:
    return [" ".join(entry.split()) for entry in re.findall(r"^- (.*(?:\n  .*)*)", PAGE, re.MULTILINE)]


def test_entries_are_short() -> None:
    assert [entry for entry in entries() if len(entry.split()) > LONGEST] == []


def test_no_entry_and_no_group_is_there_twice() -> None:
    release = PAGE.split("\n## ")[1]
    lines = [*entries(), *re.findall(r"^### .*", release, re.MULTILINE)]
    assert [line for line in sorted(set(lines)) if lines.count(line) > 1] == []


def test_the_version_of_this_tree_has_its_date() -> None:
    version = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["version"]
    assert re.search(rf"^## {re.escape(version)} \(\d{{4}}-\d\d-\d\d\)$", PAGE, re.MULTILINE)
