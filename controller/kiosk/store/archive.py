"""Backup and restore of a stage as a tar file without secrets."""

from __future__ import annotations

import contextlib
import dataclasses
import gzip
import io
import json
import os
import platform
import shutil
import sqlite3
import tarfile
import tempfile
import time
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path, PurePosixPath
from typing import Any, Final

from controller.config import load_stage
from controller.config.loader import FILE, LARGEST_BYTES
from controller.core.errors import UsageError, WorkError
from controller.core.files import require_regular
from controller.core.storage import sync_folder
from controller.kiosk.outputs import outputs_of_x
from controller.stage.artefacts.grade import FIGURES
from controller.stage.artefacts.kinds import StepKind
from controller.stage.artefacts.names import json_path
from controller.stage.artefacts.published import BUNDLE_FIGURES
from controller.stage.sessions.calibrations import finished_calibrations
from controller.stage.sessions.run import tapes
from hal.runtime.caches import kept

FOLDER: Final = "kiosk/archives"
MARK: Final = "velatura-backup.json"
RESTORING: Final = ".restoring"
"""An unpacked and checked backup; while it exists, its parts are being moved into the stage."""
REPLACED: Final = "kiosk/replaced"
KEPT: Final = 5
CUT_OFF_S: Final = 3600.0
"""An unfinished backup without changes for this time is abandoned."""
MOST_FILES: Final = 100_000
ROOM_SHARE: Final = 0.9
"""The share of the free space that an unpacked backup may fill; the event log needs some, too."""
_DAMAGED: Final = (tarfile.TarError, zlib.error, OSError, EOFError, ValueError)
"""What reading a file raises that is damaged or is not a backup."""
_SECRET: Final = ("keys", "kiosk", "run")
_BACKED_UP: Final = ("stage.toml", "schedule.toml", "profiles", "appearances", "bundles", "bundles-without")


def backup(stage: Path) -> Path:
    """A new file with settings, the newest calibration, appearances and bundles; without keys, accounts and logs."""
    parts = [stage / name for name in _BACKED_UP if (stage / name).exists()]
    runs = finished_calibrations(stage)
    parts += runs[:1]
    path = new_file(stage, "backup", "tar.gz")
    # On another computer the connectors have other names; the displays have not.
    displays = {one.name: one.serials for one in outputs_of_x()}
    mark = json.dumps(
        {"velatura": 1, "made_unix_s": time.time(), "run": runs[0].name if runs else "", "displays": displays}
    )

    def write(archive: tarfile.TarFile) -> None:
        add(archive, MARK, mark.encode())
        for part in parts:
            archive.add(part, str(part.relative_to(stage)), filter=_harmless)

    return write_tar(path, write)


def restore(stage: Path, file: Path) -> None:
    """Replace settings, calibration and appearances by those of a backup; the old ones are kept in kiosk/replaced.

    The backup is unpacked and checked first. After that nothing stops the restore: after a power cut
    ``finish_restore`` completes it. Raises UsageError("not-a-backup"), WorkError("no-space") and what
    ``load_stage`` raises for the settings in it.
    """
    finish_restore(stage)
    with tempfile.TemporaryDirectory(prefix=".restore-", dir=stage) as name:
        fresh = Path(name) / "fresh"
        fresh.mkdir()
        _unpack(file, fresh)
        load_stage(fresh)
        old = stage / REPLACED
        shutil.rmtree(old, ignore_errors=True)
        old.mkdir(parents=True)
        fresh.rename(stage / RESTORING)
        sync_folder(stage)
    finish_restore(stage)


def check_backup(file: Path) -> None:
    """Read a backup to its end, and the settings in it.

    Raises UsageError("not-a-backup") and what ``load_stage`` raises.
    """
    try:
        with _opened(file) as (archive, finish), tempfile.TemporaryDirectory() as folder:
            names = [_read_through(archive, member, Path(folder)) for member in archive]
            finish()
            if names[:1] != [MARK]:
                raise _not_ours()
            load_stage(Path(folder))
    except _DAMAGED as error:
        raise _not_ours() from error


def displays_of(file: Path) -> dict[str, tuple[str, ...]]:
    """The serial numbers of the displays by connector, as they were when the backup was made; {} if it does not tell.

    Raises UsageError("not-a-backup").
    """
    try:
        with tarfile.open(file, "r:gz") as archive:
            first = archive.next()
            content = None if first is None or first.name != MARK else archive.extractfile(first)
            if content is None:
                raise _not_ours()
            table = json.loads(content.read(LARGEST_BYTES)).get("displays", {})
            return {str(name): tuple(str(serial) for serial in serials) for name, serials in table.items()}
    except (*_DAMAGED, AttributeError, TypeError) as error:
        raise _not_ours() from error


@contextlib.contextmanager
def _opened(file: Path) -> Iterator[tuple[tarfile.TarFile, Callable[[], None]]]:
    """A backup to read, and a function that reads what is left of it and compares its checksum.

    tarfile itself stops at the first header that is not one, so that it takes a damaged header for the end.
    """
    require_regular(file)
    with gzip.open(file, "rb") as stream, tarfile.open(fileobj=stream, mode="r:") as archive:

        def finish() -> None:
            while stream.read(1 << 20):
                pass

        yield archive, finish


def _read_through(archive: tarfile.TarFile, member: tarfile.TarInfo, folder: Path) -> str:
    """Read one member, and put the settings into ``folder``; returns its name."""
    if _harmless(member) is None:
        raise _not_ours()
    content = archive.extractfile(member) if member.isfile() else None
    if content is not None and member.name == FILE:
        (folder / FILE).write_bytes(content.read(LARGEST_BYTES + 1))
    while content is not None and content.read(1 << 20):
        pass
    return member.name


def finish_restore(stage: Path) -> bool:
    """Complete an interrupted restore, so that old and new parts are not mixed; returns whether there was one."""
    fresh, old = stage / RESTORING, stage / REPLACED
    if not fresh.exists():
        return False
    for part in sorted(fresh.iterdir()):
        if part.name in (*_SECRET, MARK):
            continue
        if part.name == "runs":
            _merge_runs(part, stage / "runs")
            continue
        if (stage / part.name).exists():
            (stage / part.name).rename(old / part.name)
        part.rename(stage / part.name)
    sync_folder(stage)
    shutil.rmtree(fresh)
    return True


def clear_cut_off(stage: Path) -> None:
    """Delete the remains of interrupted restores and backups, which may be gigabytes. Needs the stage's lock."""
    for folder in stage.glob(".restore-*"):
        shutil.rmtree(folder, ignore_errors=True)
    for part in (stage / FOLDER).glob(".*.part"):
        with contextlib.suppress(OSError):
            if time.time() - part.stat().st_mtime > CUT_OFF_S:
                part.unlink()


def new_file(stage: Path, what: str, suffix: str) -> Path:
    """The path of a new archive of one kind; the oldest of the others go."""
    folder = stage / FOLDER
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    for old in sorted(folder.glob(f"{what}-*"))[: -KEPT + 1]:
        old.unlink(missing_ok=True)
    return folder / f"{what}-{time.strftime('%Y%m%d-%H%M%S')}-{time.monotonic_ns() % 1_000_000:06d}.{suffix}"


def write_tar(path: Path, write: Callable[[tarfile.TarFile], None]) -> Path:
    """``path``, which is there only when it is whole. Raises WorkError("cannot-write")."""
    part = path.with_name(f".{path.name}.part")
    try:
        with tarfile.open(part, "w:gz", compresslevel=1) as archive:
            write(archive)
        part.chmod(0o600)
        part.replace(path)
    except OSError as error:
        raise WorkError("cannot-write", what=f"{path.name} could not be written: {error.strerror}.",
                        remedy="Check the free space on the disk, and try again.") from error  # fmt: skip
    finally:
        part.unlink(missing_ok=True)
    return path


def add(archive: tarfile.TarFile, name: str, data: bytes) -> None:
    """Put a file of these bytes into ``archive``."""
    info = tarfile.TarInfo(name)
    info.size, info.mtime = len(data), int(time.time())
    archive.addfile(info, io.BytesIO(data))


def _harmless(info: tarfile.TarInfo) -> tarfile.TarInfo | None:
    """Keeps only files, folders, and links to a name in the same folder; no keys, no unfinished files."""
    name = PurePosixPath(info.name)
    if name.suffix == ".key" or name.name.startswith("."):
        return None
    if info.issym():
        return info if "/" not in info.linkname else None
    return info if info.isfile() or info.isdir() else None


def _unpack(file: Path, folder: Path) -> None:
    try:
        with _opened(file) as (archive, finish):
            members = []
            for count, member in enumerate(archive):
                if count >= MOST_FILES or _harmless(member) is None:
                    raise _not_ours()
                members.append(member)
            finish()
            if not members or members[0].name != MARK:
                raise _not_ours()
            _require_room(folder, sum(member.size for member in members))
            for member in members:
                _unpack_one(archive, member, folder)
    except _DAMAGED as error:
        raise _not_ours() from error


def _unpack_one(archive: tarfile.TarFile, member: tarfile.TarInfo, folder: Path) -> None:
    """One file, folder or link. tarfile's own filters came with Python 3.11.4, and Debian 12 has 3.11.2.

    Raises UsageError("not-a-backup") for one that would lie outside ``folder``, and ValueError and OSError.
    """
    place = folder / member.name
    # Also when a link that came before it leads out.
    if not place.parent.resolve().is_relative_to(folder.resolve()) or ".." in PurePosixPath(member.name).parts:
        raise _not_ours()
    place.parent.mkdir(parents=True, exist_ok=True)
    if member.isdir():
        place.mkdir(exist_ok=True)
    elif member.issym():
        if member.linkname in (".", ".."):
            raise _not_ours()
        place.symlink_to(member.linkname)
    else:
        content = archive.extractfile(member)
        assert content is not None
        with content, place.open("xb") as file:
            shutil.copyfileobj(content, file)
        os.utime(place, (member.mtime, member.mtime))


def _require_room(folder: Path, size: int) -> None:
    """Raises WorkError("no-space"), because a small archive may be large when unpacked."""
    free = shutil.disk_usage(folder).free
    if size > ROOM_SHARE * free:
        raise WorkError(
            "no-space",
            what=f"The backup needs {size / 1e9:.1f} GB, but only {free / 1e9:.1f} GB are free.",
            remedy="Free some space on the stage's disk.",
        )


def _not_ours() -> UsageError:
    return UsageError(
        "not-a-backup",
        what="This file is not a backup of a Velatura stage, or it is damaged.",
        remedy="Use a file that was made by `velatura kiosk backup` or the panel.",
    )


def _merge_runs(fresh: Path, runs: Path) -> None:
    """Give a restored run that is older than the existing ones a new name: the newest calibration is used."""
    runs.mkdir(exist_ok=True)
    for run in sorted(fresh.iterdir()):
        newest = max((other.name for other in runs.iterdir()), default="")
        name = run.name
        if newest > name:
            name = f"{time.strftime('%Y%m%d-%H%M%S')}-{name.partition('-')[2].partition('-')[2] or 'calibrate'}"
        if not (runs / name).exists():
            run.rename(runs / name)


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
