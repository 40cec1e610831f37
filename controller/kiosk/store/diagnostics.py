"""What remote support needs to know of a stage, as a tar file without secrets and pictures."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import platform
import shutil
import sqlite3
import tarfile
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Final

from controller.kiosk.store.archive import add, new_file, write_tar
from controller.stage.artefacts.grade import FIGURES
from controller.stage.artefacts.kinds import StepKind
from controller.stage.artefacts.names import json_path
from controller.stage.artefacts.published import BUNDLE_FIGURES
from controller.stage.sessions.run import tapes
from hal.runtime.caches import kept

LARGEST_TAPE: Final = 64 << 20
"""Bytes; a larger one is too large for a mail."""


def diagnostics(stage: Path, facts: Mapping[str, Any]) -> Path:
    """A new file for remote support: ``facts``, events, journals and logs, without secrets and pictures."""
    path = new_file(stage, "diagnostics", "tar.gz")
    system = {"system": platform.platform(), "python": platform.python_version(), "disk": _disk(stage),
              "outside_the_stage": [dataclasses.asdict(cache) for cache in kept()]}  # fmt: skip

    def write(archive: tarfile.TarFile) -> None:
        add(archive, "facts.json", json.dumps({**system, **facts}, indent=1, default=str).encode())
        for name in ("stage.toml", "schedule.toml", "lamps.json"):
            if (stage / name).is_file():
                archive.add(stage / name, name)
        for database in sorted([*stage.glob("runs/*/journal.sqlite"), *stage.glob("kiosk/events.sqlite")])[-20:]:
            with contextlib.suppress(sqlite3.Error):
                add(archive, str(database.relative_to(stage)), _copy_of(database))
        for text in [*_texts(stage), *_last_tape(stage)]:
            archive.add(text, str(text.relative_to(stage)))

    return write_tar(path, write)


def _last_tape(stage: Path) -> list[Path]:
    """The newest tape, unless its pictures make it too large for a mail."""
    return [path for path in tapes(stage)[-1:] if path.stat().st_size <= LARGEST_TAPE]


def _texts(stage: Path) -> Iterable[Path]:
    runs = Path("runs/*")
    patterns = (runs / FIGURES, json_path(runs, StepKind.DRIFT), json_path(runs, BUNDLE_FIGURES), Path("run/*.log"))
    for pattern in patterns:
        yield from sorted(stage.glob(str(pattern)))[-20:]


def _copy_of(database: Path) -> bytes:
    """A consistent copy, even while the database is written."""
    with contextlib.closing(sqlite3.connect(f"file:{database}?mode=ro", uri=True)) as source:
        return source.serialize()


def _disk(stage: Path) -> dict[str, int]:
    usage = shutil.disk_usage(stage)
    return {"total": usage.total, "free": usage.free}
