"""Backup and restore of a stage as a tar file."""

from __future__ import annotations

import contextlib
import dataclasses
import filecmp
import io
import ipaddress
import itertools
import json
import os
import platform
import shutil
import sqlite3
import tarfile
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final
from urllib.parse import urlsplit

from controller.config import load_stage
from controller.config.loader import FILE
from controller.config.table import Holds, texts
from controller.config.writer import KeyChange, edited
from controller.core.errors import UsageError, VelaturaError, WorkError
from controller.core.files import read_text
from controller.core.storage import make_folder, sync_folder
from controller.core.text import printable
from controller.kiosk.outputs import outputs_of_x
from controller.kiosk.store.references import BUILDING, OWN, Reference, building, linked, references
from controller.kiosk.store.runs import began_s
from controller.kiosk.store.settings import checked_settings
from controller.kiosk.store.unpacking import DAMAGED, not_ours, read_first, unpack
from controller.run.journal import Journal
from controller.stage.artefacts.grade import FIGURES
from controller.stage.artefacts.kinds import StepKind
from controller.stage.artefacts.names import CAPTURES, json_path, write_json
from controller.stage.artefacts.published import BUNDLE_FIGURES
from controller.stage.artefacts.views import VIEWS
from controller.stage.sessions.calibrations import finished_calibrations
from controller.stage.sessions.check import PANELS_FILE
from controller.stage.sessions.run import tapes
from hal.runtime.caches import kept
from hal.secret_words import concealed, is_secret

FOLDER: Final = "kiosk/archives"
MARK: Final = "velatura-backup.json"
RESTORING: Final = ".restoring"
"""A checked backup (``fresh``) whose parts are being moved into the stage, and what they replace (``old``)."""
REPLACED: Final = "kiosk/replaced"
OUTSIDE: Final = "backup-files"
"""The place in a backup, and in a restored stage, of files from outside the stage."""
KEPT: Final = 5
CUT_OFF_S: Final = 3600.0
"""An unfinished backup without changes for this time is abandoned."""
_FILES: Final = (FILE, PANELS_FILE, BUILDING)
_FOLDERS: Final = ("profiles", "appearances", "bundles", "bundles-without", OUTSIDE)
_RUNS: Final = "runs"
_PARTS: Final = "parts.json"
"""In ``RESTORING``: the names of all that is moved, in this order."""
_OF_SQLITE: Final = ("-wal", "-shm")
"""The ends of SQLite's own files; what they hold is in the copy of the database."""
_VERSION: Final = 1


def backup(stage: Path, *, photographs: bool = False) -> Path:
    """A new file with the settings, every file that they name, the newest calibration, appearances and bundles.

    It holds the passwords in stage.toml, but no keys, accounts and logs. ``photographs``: also those of the
    calibration. Files from outside the stage are in ``OUTSIDE``, and the settings in the backup name them there, so
    that a restored stage finds them on any computer. Raises UsageError("stage-not-editable"), and
    WorkError("cannot-write").
    """
    runs = finished_calibrations(stage)[:1]
    changed, named, lacks = _named(stage, references(stage))
    # On another computer the connectors have other names; the displays have not.
    displays = {one.name: one.serials for one in outputs_of_x()}
    mark = {"velatura": _VERSION, "made_unix_s": time.time(), "run": runs[0].name if runs else "", "displays": displays,
            "missing": lacks}  # fmt: skip
    parts = [stage / name for name in (*_FILES, *_FOLDERS) if (stage / name).exists() and name not in changed]
    files = {name: path for part in [*parts, *runs] for name, path in _below(part, str(part.relative_to(stage)))}

    def write(archive: tarfile.TarFile) -> None:
        add(archive, MARK, json.dumps(mark).encode())
        for name, text in changed.items():
            add(archive, name, text)
        for name, path in (files | named).items():
            if photographs or not _is_photograph(name.split("/")):
                _add_file(archive, name, path)

    return write_tar(new_file(stage, "backup", "tar.gz"), write)


def _is_photograph(parts: Sequence[str]) -> bool:
    """Whether a path, in its parts, lies among a run's photographs, or those of one of its views."""
    inside = parts[4:5] if parts[2:3] == [VIEWS] else parts[2:3]
    return parts[0] == _RUNS and inside == [CAPTURES]


def missing(stage: Path) -> list[str]:
    """A sentence for each file that the stage reads, and that does not exist or that no backup can hold."""
    return _named(stage, references(stage))[2]


def _named(stage: Path, found: Sequence[Reference]) -> tuple[dict[str, bytes], dict[str, Path], list[str]]:
    """The settings that had to be changed, by file; the named files by their names in the backup; what it lacks."""
    named: dict[str, Path] = {}
    changes = defaultdict[str, list[KeyChange]](list)
    lacks = [one.missing for one in found if one.holds is Holds.FILE and one.missing]
    for one in found:
        if one.holds is not Holds.FILE or one.missing:
            continue
        name = _own_name(stage, one.place)
        if name is None:
            name = next((other for other, path in named.items() if path == one.place), None)
            name = name or _free_name(stage, one.place, named)
            changes[one.file].append(KeyChange(one.path[:-1], str(one.path[-1]), name))
        named[name] = one.place
        for link in linked(one.place):
            inner = _own_name(stage, link) if _own_name(stage, one.place) else _beside(name, one.place, link)
            if inner is None or named.setdefault(inner, link) != link:
                lacks.append(f"The scene {one.text} links to {link}, outside of its folder. Pack it into the scene.")
    return {file: edited(read_text(stage / file), rows).encode() for file, rows in changes.items()}, named, lacks


def _beside(name: str, scene: Path, link: Path) -> str | None:
    """The name of a file below the folder of a scene that is called ``name`` in the backup; None for any other."""
    inner = _own_name(scene.parent, link)
    return None if inner is None else str(Path(name).parent / inner)


def _own_name(stage: Path, place: Path) -> str | None:
    """The name of a file that keeps its place in the stage; None if a restore would not put it back there."""
    stage = stage.absolute()
    if not place.is_relative_to(stage) or not place.resolve().is_relative_to(stage.resolve()):
        return None
    name = place.relative_to(stage)
    hidden = any(part.startswith(".") for part in name.parts) or name.suffix == ".key"
    return None if hidden or (name.parts[0] in OWN and name.parts[0] not in _FOLDERS) else str(name)


def _free_name(stage: Path, place: Path, taken: Collection[str]) -> str:
    plain = place.name.lstrip(".").removesuffix(".key") or "file"
    names = (f"{OUTSIDE}/{plain}" if n == 1 else f"{OUTSIDE}/{n}-{plain}" for n in itertools.count(1))
    return next(name for name in names if name not in taken and not (stage / name).exists())


def _below(path: Path, name: str, around: tuple[Path, ...] = ()) -> Iterator[tuple[str, Path]]:
    """A file, or a folder and all in it, with names for the backup; no keys, no unfinished files."""
    if path.suffix == ".key" or path.name.startswith(".") or path.name.endswith(_OF_SQLITE):
        return
    if path.is_file():
        yield name, path
    elif path.is_dir() and (real := path.resolve()) not in around:
        yield name, path
        for inner in sorted(path.iterdir()):
            yield from _below(inner, f"{name}/{inner.name}", (*around, real))


def _add_file(archive: tarfile.TarFile, name: str, path: Path) -> None:
    """A link to a file of its folder stays one; of any other, what it leads to: it may not be on another computer."""
    link = str(path.readlink()) if path.is_symlink() and path.is_file() else "/"
    if "/" not in link and not link.startswith("."):
        archive.addfile(archive.gettarinfo(path, name))
    elif path.is_dir():
        info = tarfile.TarInfo(name)
        info.type, info.mode = tarfile.DIRTYPE, 0o755
        archive.addfile(info)
    elif path.name == Journal.FILE and (copy := _copy_of(path)):
        add(archive, name, copy)
    else:
        with path.open("rb") as content:
            archive.addfile(archive.gettarinfo(arcname=name, fileobj=content), content)


def restore(stage: Path, file: Path) -> None:
    """Replace settings, calibration and appearances by those of a backup; the old ones are kept in kiosk/replaced.

    The backup is unpacked and checked first, also by the stage's own checks. Then its parts are moved; after a power
    cut ``finish_restore`` completes that. The restored calibration counts, and none is lost.

    Raises UsageError("not-a-backup", "backup-newer", "backup-incomplete", "backup-opens-network"),
    WorkError("no-space", "restore-given-up"), and what ``checked_settings`` raises for the settings in it.
    """
    stage.mkdir(parents=True, exist_ok=True)
    finish_restore(stage)
    for cut_off in stage.glob(".restore-*"):
        shutil.rmtree(cut_off, ignore_errors=True)
    with tempfile.TemporaryDirectory(prefix=".restore-", dir=stage) as name:
        fresh = Path(name).absolute() / "work" / "fresh"
        fresh.mkdir(parents=True)
        _unpack(file, fresh)
        _refuse_opened(fresh, stage)
        _name_runs(fresh / _RUNS, stage)
        write_json(fresh.parent / _PARTS, {"parts": _parts_of(fresh)})
        for folder, _, _ in os.walk(fresh.parent, topdown=False):
            sync_folder(Path(folder))
        fresh.parent.rename(stage / RESTORING)
        sync_folder(stage)
    finish_restore(stage)


def check_backup(file: Path, room: Path | None = None) -> None:
    """Restore a backup into an empty folder, below ``room`` if that is given, and let the stage's own checks run there.

    Raises as ``restore``.
    """
    with tempfile.TemporaryDirectory(prefix=".restore-", dir=room) as folder:
        _unpack(file, Path(folder).absolute())


def _unpack(file: Path, fresh: Path) -> None:
    """Unpack a backup and check that it is whole, and that a stage made of it can start. Raises as ``restore``."""
    unpack(file, fresh, first=MARK)
    lacks = _lacks((fresh / MARK).read_bytes())
    for name in (*_FOLDERS, *_FILES, _RUNS):
        if os.path.lexists(fresh / name) and (name in _FILES) != (fresh / name).is_file():
            raise not_ours(f"{name} is of the wrong kind")
    checked_settings(fresh)
    found = [one for one in references(fresh) if one.holds is Holds.FILE]
    allowed = {fresh / name for name in (MARK, *_FILES)} | {one.place for one in found}
    allowed |= {link for one in found for link in linked(one.place)}
    for top in fresh.iterdir():
        for path in () if top.name in (*_FOLDERS, _RUNS) else (top, *top.rglob("*")):
            if not path.is_dir() and (path not in allowed or (top.name in OWN and top.name not in _FILES)):
                raise not_ours(f"{path.relative_to(fresh)} is no part of a stage")
    lost = [one.missing for one in found if lacks is not None and one.missing and one.missing not in lacks]
    if lost:
        raise UsageError("backup-incomplete", what=f"The backup is not complete: {lost[0]}",
                         remedy="Use another backup.")  # fmt: skip


def _lacks(mark: bytes) -> list[str] | None:
    """What ``missing`` said when the backup was made; None in backups of before. Raises as ``restore``."""
    try:
        content = json.loads(mark)
        version, lacks = int(content.get("velatura", _VERSION)), content.get("missing")
    except (ValueError, AttributeError, TypeError, RecursionError) as error:
        raise not_ours() from error
    if version > _VERSION:
        raise UsageError("backup-newer", what="This backup was made by a newer Velatura.",
                         remedy="Update Velatura first, then restore the backup.")  # fmt: skip
    return lacks if isinstance(lacks, list) else None


def _refuse_opened(fresh: Path, stage: Path) -> None:
    """Raises UsageError("backup-opens-network") where the whole world could command a stage that is there already."""

    def reached(folder: Path) -> set[str]:
        return {text for path, text, _ in texts(building(folder)) if "allow" in path}

    opened = [text for text in reached(fresh) - reached(stage) if _is_wide(text)]
    if opened and (stage / FILE).exists():
        what = f"The backup lets {opened[0]} command the stage, by its {BUILDING}."
        remedy = f"If that is right, write it into {BUILDING} of the stage first."
        raise UsageError("backup-opens-network", what=what, remedy=remedy)


def _is_wide(network: str) -> bool:
    try:
        return not ipaddress.ip_network(network).is_private
    except ValueError:
        return False


def _name_runs(fresh: Path, stage: Path) -> None:
    """Make a restored calibration the newest, unless it is the newest of the stage already, with the same bytes."""
    runs = stage / _RUNS
    for run in sorted(fresh.iterdir()) if fresh.exists() else ():
        newest = max((other.name for other in runs.iterdir()), default="") if runs.is_dir() else ""
        if finished_calibrations(stage)[:1] == [runs / run.name] and _has_all(runs / run.name, run):
            shutil.rmtree(run)
        elif newest >= run.name:
            stamp = time.strftime("%Y%m%d-%H%M%S", time.localtime(max(time.time(), began_s(newest) + 1.0)))
            run.rename(fresh / f"{stamp}-{run.name.partition('-')[2].partition('-')[2] or 'calibrate'}")


def _has_all(there: Path, run: Path) -> bool:
    """Whether the folder ``there`` has all files of ``run``, with the same content."""
    pairs = [(there / path.relative_to(run), path) for path in run.rglob("*") if path.is_file()]
    return all(one.is_file() and _same(one, other) for one, other in pairs)


def _same(one: Path, other: Path) -> bool:
    if one.name == Journal.FILE:
        # Two copies of one database may differ in bytes.
        return (_rows_of(one) or [str(one)]) == (_rows_of(other) or [str(other)])
    return filecmp.cmp(one, other, shallow=False)


def _rows_of(database: Path) -> list[str]:
    """The statements that make such a database; [] for a damaged one."""
    try:
        with contextlib.closing(_read_only(database)) as source:
            return list(source.iterdump())
    except sqlite3.Error:
        return []


def _parts_of(fresh: Path) -> list[str]:
    """What is moved as a whole: files and folders of a stage, each run, each other named file; stage.toml is last."""
    parts = [top for top in fresh.iterdir() if top.name in _FOLDERS or (top.is_file() and top.name != MARK)]
    parts += (fresh / _RUNS).glob("*")
    others = (top for top in fresh.iterdir() if top.is_dir() and top.name not in (*_FOLDERS, _RUNS))
    parts += (path for top in others for path in top.rglob("*") if path.is_file())
    return sorted((str(part.relative_to(fresh)) for part in parts), key=lambda name: (name == FILE, name))


def finish_restore(stage: Path) -> bool:
    """Complete an interrupted restore, so that old and new parts are not mixed; returns whether there was one.

    Raises WorkError("restore-given-up") if that can't be done; the stage is as before then, if its disk allows.
    """
    work = stage / RESTORING
    if not (work / _PARTS).is_file():
        # Nothing was moved yet, or all was.
        _remove(work)
        return False
    parts: list[str] = []
    try:
        parts = list(json.loads(read_text(work / _PARTS))["parts"])
        if (work / "fresh" / FILE).exists():
            load_stage(work / "fresh")
        for part in parts:
            if os.path.lexists(work / "fresh" / part):
                _exchange(stage, work / "fresh" / part, stage / part, work / "old" / part)
        if (work / "old").exists():
            shutil.rmtree(stage / REPLACED, ignore_errors=True)
            _move(stage, work / "old", stage / REPLACED)
    except (OSError, ValueError, LookupError, TypeError, VelaturaError) as error:
        raise _given_up(stage, work, parts, error) from error
    _remove(work)
    return True


def _given_up(stage: Path, work: Path, parts: Sequence[str], error: Exception) -> WorkError:
    """Put everything back, and the error that says so."""
    why = getattr(error, "what", "") or getattr(error, "strerror", "") or "it is damaged"
    state = "The stage is as it was before."
    try:
        for part in reversed(parts):
            if not os.path.lexists(work / "fresh" / part):
                _exchange(stage, work / "old" / part, stage / part, work / "fresh" / part)
            elif os.path.lexists(work / "old" / part):
                _move(stage, work / "old" / part, stage / part)
        _remove(work)
    except OSError:
        state = "It is tried again at the next start."
    return WorkError(
        "restore-given-up",
        what=f"The backup could not be put in place: {printable(why).rstrip('.')}. {state}",
        remedy="Check the permissions of the stage's folder and its disk, and restore it again.",
    )


def _exchange(stage: Path, new: Path, place: Path, old: Path) -> None:
    """Move what is at ``place`` to ``old``, and ``new`` to ``place``; either may be missing."""
    if os.path.lexists(place):
        _move(stage, place, old)
    if os.path.lexists(new):
        _move(stage, new, place)


def _move(stage: Path, source: Path, target: Path) -> None:
    """Rename, durably before anything else happens."""
    target.parent.mkdir(parents=True, exist_ok=True)
    source.rename(target)
    sync_folder(source.parent)
    for folder in target.parents:
        sync_folder(folder)
        if folder == stage:
            break


def _remove(work: Path) -> None:
    """First the list, so that what is left after a cut is only removed."""
    if work.is_dir() and not work.is_symlink():
        (work / _PARTS).unlink(missing_ok=True)
        sync_folder(work)
        shutil.rmtree(work, ignore_errors=True)
    else:
        work.unlink(missing_ok=True)


def displays_of(file: Path) -> dict[str, tuple[str, ...]]:
    """The serial numbers of the displays by connector, as they were when the backup was made; {} if it does not tell.

    Raises UsageError("not-a-backup").
    """
    try:
        name, mark = read_first(file)
        if name != MARK:
            raise not_ours()
        table = json.loads(mark).get("displays", {})
        return {str(name): tuple(str(serial) for serial in serials) for name, serials in table.items()}
    except (*DAMAGED, AttributeError, TypeError) as error:
        raise not_ours() from error


def clear_cut_off(stage: Path) -> None:
    """Delete the remains of interrupted restores and backups, which may be gigabytes. Needs the stage's lock."""
    for place, pattern in ((stage, ".restore-*"), (stage / FOLDER, ".restore-*"), (stage / FOLDER, ".back-*")):
        for folder in place.glob(pattern):
            shutil.rmtree(folder, ignore_errors=True)
    for part in (stage / FOLDER).glob(".*.part"):
        with contextlib.suppress(OSError):
            if time.time() - part.stat().st_mtime > CUT_OFF_S:
                part.unlink()


def new_file(stage: Path, what: str, suffix: str) -> Path:
    """The path of a new archive of one kind; the oldest of the others go."""
    folder = stage / FOLDER
    make_folder(folder, 0o700)
    for old in sorted(folder.glob(f"{what}-*"))[: -KEPT + 1]:
        old.unlink(missing_ok=True)
    return folder / f"{what}-{time.strftime('%Y%m%d-%H%M%S')}-{time.monotonic_ns() % 1_000_000:06d}.{suffix}"


def write_tar(path: Path, write: Callable[[tarfile.TarFile], None]) -> Path:
    """``path``, for its owner alone, which is there only when it is whole. Raises WorkError("cannot-write")."""
    part = path.with_name(f".{path.name}.part")
    try:
        with part.open("wb") as file:
            part.chmod(0o600)
            with tarfile.open(fileobj=file, mode="w:gz", compresslevel=1) as archive:
                write(archive)
            file.flush()
            os.fsync(file.fileno())
        part.replace(path)
        sync_folder(path.parent)
    except OSError as error:
        failed = error.filename or path.name
        raise WorkError("cannot-write", what=f"{failed} could not be read or written: {error.strerror}.",
                        remedy="Check the free space on the disk, and try again.") from error  # fmt: skip
    finally:
        part.unlink(missing_ok=True)
    return path


def add(archive: tarfile.TarFile, name: str, data: bytes) -> None:
    """Put a file of these bytes into ``archive``."""
    info = tarfile.TarInfo(name)
    info.size, info.mtime = len(data), int(time.time())
    archive.addfile(info, io.BytesIO(data))


LARGEST_TAPE: Final = 64 << 20
"""Bytes; a larger one is too large for a mail."""


def diagnostics(stage: Path, facts: Mapping[str, Any]) -> Path:
    """A new file for remote support: ``facts``, events, journals and logs, without secrets and pictures."""
    path = new_file(stage, "diagnostics", "tar.gz")
    secrets = _secrets(stage)
    system = {"system": platform.platform(), "python": platform.python_version(), "disk": _disk(stage),
              "outside_the_stage": [dataclasses.asdict(cache) for cache in kept()]}  # fmt: skip

    def write(archive: tarfile.TarFile) -> None:
        add(archive, "facts.json", concealed(json.dumps({**system, **facts}, indent=1, default=str), secrets).encode())
        for database in sorted([*stage.glob("runs/*/journal.sqlite"), *stage.glob("kiosk/events.sqlite")])[-20:]:
            with contextlib.suppress(sqlite3.Error):
                add(archive, str(database.relative_to(stage)), _without(secrets, _copy_of(database), same_length=True))
        settings = (stage / name for name in (FILE, PANELS_FILE, "lamps.json") if (stage / name).is_file())
        for text in [*settings, *_texts(stage), *_last_tape(stage)]:
            add(archive, str(text.relative_to(stage)), _without(secrets, text.read_bytes()))

    return write_tar(path, write)


def _secrets(stage: Path) -> set[str]:
    """The values of secret settings, which may stand in any text."""
    try:
        found = [(str(path[-1]), text) for path, text, _ in texts(load_stage(stage).tables)]
    except UsageError:
        return set()
    addresses = [urlsplit(text) for key, text in found if "://" in text]
    return {text for key, text in found if is_secret(key)} | {one.password for one in addresses if one.password} | {
        one.path for one in addresses if one.path.strip("/") and one.scheme in ("http", "https")}  # fmt: skip


def _without(secrets: Collection[str], data: bytes, *, same_length: bool = False) -> bytes:
    words = [secret.encode().decode("latin-1") for secret in secrets]
    return concealed(data.decode("latin-1"), words, same_length=same_length).encode("latin-1")


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
    with contextlib.closing(_read_only(database)) as source:
        return source.serialize()


def _read_only(database: Path) -> sqlite3.Connection:
    return sqlite3.connect(f"{database.absolute().as_uri()}?mode=ro", uri=True)


def _disk(stage: Path) -> dict[str, int]:
    usage = shutil.disk_usage(stage)
    return {"total": usage.total, "free": usage.free}
