"""Names of files in a run's folder, made from kinds and names of projectors and appearances; never read back.

Light on purpose, as what the kiosk asks for while it plays.
"""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any, Final

from controller.core.storage import write_atomically

CAPTURES: Final = "captures"
"""The folder of a run that holds its photographs."""
REPORT_PAGE, REPORT_FIGURES = "report.html", "report.json"
"""A run's report, for people and for machines."""
MOST_BYTES: Final = 200
"""Of a name inside a file's name: kind, number, suffix and what a half-written file has beside fit into 255 bytes."""


def safe_name(name: str) -> str:
    """``name`` as it stands in the names of files: different for different names, and the same for ordinary ones.

    Percent signs and what can't be printed are written as %XX, as are the names "." and "..", which are folders. What
    is longer than ``MOST_BYTES`` is cut, and told apart by its SHA-256.
    """
    if name in (".", ".."):
        return _escaped(name)
    plain = "".join(one if one.isprintable() and one != "%" else _escaped(one) for one in name)
    if len(plain.encode()) <= MOST_BYTES:
        return plain
    digest = hashlib.sha256(name.encode()).hexdigest()[:16]
    return f"{plain.encode()[:150].decode(errors='ignore')}%~{digest}"


def _escaped(one: str) -> str:
    return "".join(f"%{byte:02X}" for byte in one.encode())


def stem(kind: str, name: str | None = None, *, part: int | None = None) -> str:
    """A file's name without its suffix: KIND, KIND-NAME, or KIND.NNN-NAME where a file has numbered parts.

    The name comes last and no kind begins as another one with a dash does, so that no two have the same.
    """
    whole = kind if part is None else f"{kind}.{part:03d}"
    return whole if name is None else f"{whole}-{safe_name(name)}"


def npz_path(run: Path, kind: str, name: str | None = None) -> Path:
    """The arrays of a kind in a run's folder: those of one projector or appearance, or of all."""
    return run / f"{stem(kind, name)}.npz"


def json_path(run: Path, kind: str, name: str | None = None) -> Path:
    """As ``npz_path``, its figures."""
    return run / f"{stem(kind, name)}.json"


def run_kind(run: Path) -> str:
    """What was done in a run, from its folder's name, DATE-TIME-KIND."""
    return run.name.rpartition("-")[2]


def write_json(path: Path, content: object) -> Path:
    """Replace a file by ``content`` as indented JSON; tuples become lists. Returns ``path``."""
    write_atomically(path, json.dumps(content, indent=1, default=list).encode())
    return path


def read_json(path: Path) -> Any:
    """What a JSON file holds. Raises OSError and ValueError for one that can't be read."""
    return json.loads(path.read_text(encoding="utf-8"))
