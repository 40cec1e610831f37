"""Names of files in a run's folder, made from kinds and names of projectors and appearances; never parsed.

It imports little, because the kiosk uses it while it plays.
"""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any, Final

from controller.core.storage import write_atomically

CAPTURES: Final = "captures"
"""The folder with a run's photographs."""
REPORT_PAGE, REPORT_FIGURES = "report.html", "report.json"
"""A run's report, for people and for machines."""
MOST_BYTES: Final = 200
"""Maximum bytes of a name in a file's name: with kind, number and suffixes it must fit into 255 bytes."""


def safe_name(name: str) -> str:
    """``name`` for use in file names: different for different names, unchanged for ordinary ones.

    Percent signs, unprintable characters, and the names "." and ".." are written as %XX. A name
    longer than ``MOST_BYTES`` is cut and gets its SHA-256 as a suffix.
    """
    if name in (".", ".."):
        return _escaped(name)
    plain = "".join(one if one.isprintable() and one != "%" else _escaped(one) for one in name)
    if len(plain.encode()) <= MOST_BYTES:
        return plain
    digest = hashlib.sha256(name.encode(errors="surrogateescape")).hexdigest()[:16]
    return f"{plain.encode()[:150].decode(errors='ignore')}%~{digest}"


def _escaped(one: str) -> str:
    return "".join(f"%{byte:02X}" for byte in one.encode(errors="surrogateescape"))


def stem(kind: str, name: str | None = None, *, part: int | None = None) -> str:
    """A file's name without its suffix: KIND, KIND-NAME, or KIND.NNN-NAME for numbered parts.

    The name comes last, and no kind is the beginning of another kind with a dash, so all names differ.
    """
    whole = kind if part is None else f"{kind}.{part:03d}"
    return whole if name is None else f"{whole}-{safe_name(name)}"


def npz_path(run: Path, kind: str, name: str | None = None) -> Path:
    """The file with a kind's arrays in a run's folder: for one projector or appearance, or for all."""
    return run / f"{stem(kind, name)}.npz"


def json_path(run: Path, kind: str, name: str | None = None) -> Path:
    """As ``npz_path``, for the figures."""
    return run / f"{stem(kind, name)}.json"


def run_kind(run: Path) -> str:
    """The kind of a run, from its folder's name, DATE-TIME-KIND."""
    return run.name.rpartition("-")[2]


def write_json(path: Path, content: object) -> Path:
    """Replace a file by ``content`` as indented JSON; tuples become lists. Returns ``path``."""
    write_atomically(path, json.dumps(content, indent=1, default=list).encode())
    return path


def read_json(path: Path) -> Any:
    """The content of a JSON file. Raises OSError and ValueError if it can't be read."""
    return json.loads(path.read_text(encoding="utf-8"))
