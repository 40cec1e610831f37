from __future__ import annotations

import contextlib
import io
import os
import shutil
import sqlite3
import tarfile
import threading
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import pytest

from controller.core.errors import UsageError, VelaturaError, WorkError
from controller.kiosk.service import Service
from controller.kiosk.serving import serving
from controller.kiosk.store import archive
from controller.kiosk.store.archive import FOLDER, LARGEST_TAPE, diagnostics
from controller.kiosk.store.event_log import EventLog
from controller.stage.sessions.run import new_tape
from hal.notices import Notice
from tests.controller.kiosk.vase import TEXT, graded_run, vase

OLD, NEW = "20260501-100000-calibrate", "20260601-100000-calibrate"


@pytest.fixture
def stage(tmp_path: Path) -> Path:
    made = vase(tmp_path / "stage")
    for name in (OLD, NEW):
        graded_run(made, name, {"left": 0.01})
    return made


def names(file: Path) -> set[str]:
    with tarfile.open(file) as packed:
        return set(packed.getnames())


def contents(file: Path) -> bytes:
    with tarfile.open(file) as packed:
        members = [packed.extractfile(one) for one in packed if one.isfile()]
        return b"".join(one.read() for one in members if one is not None)


def tarred(path: Path, fill: Callable[[tarfile.TarFile], object], mark: bytes | None = b"{}") -> Path:
    with tarfile.open(path, "w:gz") as packed:
        if mark is not None:
            add(packed, archive.MARK, mark)
        fill(packed)
    return path


def add(
    packed: tarfile.TarFile, name: str, data: bytes = b"x", kind: bytes = tarfile.REGTYPE, to: str = ""
) -> tarfile.TarInfo:
    info = tarfile.TarInfo(name)
    info.size, info.type, info.linkname = len(data), kind, to
    packed.addfile(info, io.BytesIO(data))
    return info


def test_a_backup_holds_settings_pictures_and_the_newest_calibration_and_no_secret(stage: Path) -> None:
    file = archive.backup(stage)
    held = names(file)
    assert {archive.MARK, "stage.toml", "appearances/glass.png", f"runs/{NEW}/journal.sqlite"} <= held
    assert not [name for name in held if OLD in name or "kiosk" in name or "keys" in name or ".part" in name]
    assert b"SECRET" not in contents(file)
    assert file.stat().st_mode & 0o077 == 0


def test_only_the_newest_backups_are_kept(stage: Path) -> None:
    for _ in range(archive.KEPT + 3):
        archive.backup(stage)
    assert len(list((stage / archive.FOLDER).iterdir())) == archive.KEPT


def test_restored_on_another_machine_the_stage_is_as_it_was_and_that_ones_secrets_stay(
    stage: Path, tmp_path: Path
) -> None:
    other = vase(tmp_path / "other")
    (other / "stage.toml").write_text(TEXT.replace("The vase", "Another"))
    (other / "keys/stage.key").write_text("ITS OWN")
    archive.restore(other, archive.backup(stage))
    assert (other / "stage.toml").read_text() == TEXT
    assert (other / "runs" / NEW / "verification.json").exists()
    assert (other / "keys/stage.key").read_text() == "ITS OWN"
    assert "Another" in (other / "kiosk/replaced/stage.toml").read_text()
    assert not list(other.glob(".restore-*"))


def test_a_restored_file_keeps_its_time_however_small_it_is(stage: Path, tmp_path: Path) -> None:
    os.utime(stage / "stage.toml", (1_700_000_000, 1_700_000_000))
    other = vase(tmp_path / "other")
    archive.restore(other, archive.backup(stage))
    assert (other / "stage.toml").stat().st_mtime == 1_700_000_000


def test_a_restored_calibration_counts_though_there_is_a_newer_one(stage: Path) -> None:
    file = archive.backup(stage)
    graded_run(stage, "20260701-100000-calibrate", {"left": 0.2})
    archive.restore(stage, file)
    newest = max((stage / "runs").iterdir(), key=lambda run: run.name)
    assert "0.01" in (newest / "verification.json").read_text()


def add_long_header(packed: tarfile.TarFile) -> None:
    add(packed, "././@LongLink", bytes(2 << 20), tarfile.GNUTYPE_LONGNAME)
    add(packed, "bundles/a")


def add_large(packed: tarfile.TarFile) -> None:
    """A member whose header promises more than follows."""
    info = tarfile.TarInfo("bundles/large")
    info.size = 1 << 20
    packed.fileobj.write(info.tobuf())
    packed.offset += 512


def add_negative(packed: tarfile.TarFile) -> None:
    info = tarfile.TarInfo("bundles/large")
    info.size = -1024
    packed.fileobj.write(info.tobuf(format=tarfile.GNU_FORMAT))
    packed.offset += 512


HOSTILE: dict[str, Callable[[tarfile.TarFile], object]] = {
    "leads out": lambda packed: add(packed, "../stage.toml"),
    "leads out deeper": lambda packed: add(packed, "bundles/../../stage.toml"),
    "link up": lambda packed: add(packed, "bundles/current", b"", tarfile.SYMTYPE, ".."),
    "link out": lambda packed: add(packed, "bundles/current", b"", tarfile.SYMTYPE, "../../etc/passwd"),
    "hard link": lambda packed: add(packed, "stage.toml", b"", tarfile.LNKTYPE, "/etc/passwd"),
    "device": lambda packed: add(packed, "stage.toml", b"", tarfile.CHRTYPE),
    "a key": lambda packed: add(packed, "keys/stage.key"),
    "hidden": lambda packed: add(packed, ".bashrc"),
    "absolute": lambda packed: add(packed, "/tmp/velatura-hostile"),
    "absolute below a part": lambda packed: add(packed, "bundles//tmp/velatura-hostile"),
    "a file that is runs": lambda packed: add(packed, "runs"),
    "a file that is a folder": lambda packed: add(packed, "appearances"),
    "a folder that is settings": lambda packed: add(packed, "building.toml", b"", tarfile.DIRTYPE),
    "a link that is a folder": lambda packed: add(packed, "bundles", b"", tarfile.SYMTYPE, "keys"),
    "through a link": lambda packed: [
        add(packed, "bundles/a", b"", tarfile.SYMTYPE, "b"),
        add(packed, "bundles/a/c"),
    ],
    "through a file": lambda packed: [add(packed, "bundles/a"), add(packed, "bundles/a/c")],
    "twice": lambda packed: [add(packed, "bundles/a"), add(packed, "bundles/a")],
    "twice, a folder, too": lambda packed: [
        add(packed, "bundles/a/c"),
        add(packed, "bundles/a", b"", tarfile.DIRTYPE),
        add(packed, "bundles/a"),
    ],
    "twice but for case": lambda packed: add(packed, "Stage.toml"),
    "a pipe": lambda packed: add(packed, "bundles/a", b"", tarfile.FIFOTYPE),
    "lamp hours": lambda packed: add(packed, "lamps.json", b"{}"),
    "lamp hours as a picture": lambda packed: add(packed, "lamps.json", b"{}"),
    "accounts": lambda packed: add(packed, "kiosk/panel/accounts.json"),
    "a part that nothing names": lambda packed: add(packed, "other/file"),
    "a long header": add_long_header,
    "more than it has": add_large,
    "a size below zero": add_negative,
    "a mark that is none": lambda packed: None,
}
NO_PLAIN_NAME = ("leads out", "leads out deeper", "absolute", "absolute below a part")
"""Refused for their names alone, before anything else is asked."""


@pytest.mark.parametrize("how", HOSTILE)
def test_a_hostile_archive_is_refused_and_nothing_is_touched(stage: Path, tmp_path: Path, how: str) -> None:
    before = sorted(tmp_path.rglob("*"))
    text = TEXT.replace("appearances/glass.png", "lamps.json") if "as a picture" in how else TEXT
    mark = b"[]" if how == "a mark that is none" else b"{}"

    def fill(packed: tarfile.TarFile) -> None:
        if how not in ("hard link", "device"):
            add(packed, "stage.toml", text.encode())
        HOSTILE[how](packed)

    file = tarred(tmp_path / "hostile.tar.gz", fill, mark)
    why = "is no plain name" if how in NO_PLAIN_NAME else "not a backup"
    with pytest.raises(UsageError, match=why):
        archive.restore(stage, file)
    file.unlink()
    assert sorted(tmp_path.rglob("*")) == before
    assert (stage / "stage.toml").read_text() == TEXT


@pytest.mark.parametrize("data", [b"", b"no archive", b"\x1f\x8b\x08\x00" + 40 * b"\xff"])
def test_what_is_no_archive_is_refused(stage: Path, tmp_path: Path, data: bytes) -> None:
    (tmp_path / "file").write_bytes(data)
    with pytest.raises(UsageError, match="not a backup"):
        archive.restore(stage, tmp_path / "file")


def test_a_cut_backup_is_refused(stage: Path, tmp_path: Path) -> None:
    (tmp_path / "cut").write_bytes(archive.backup(stage).read_bytes()[:-200])
    with pytest.raises(UsageError, match="not a backup"):
        archive.restore(stage, tmp_path / "cut")
    assert (stage / "stage.toml").read_text() == TEXT


def test_an_archive_of_something_else_is_refused(stage: Path, tmp_path: Path) -> None:
    file = tarred(tmp_path / "other.tar.gz", lambda packed: add(packed, "stage.toml"), None)
    with pytest.raises(UsageError, match="not a backup"):
        archive.restore(stage, file)


def test_a_backup_with_wrong_settings_replaces_nothing(stage: Path, tmp_path: Path) -> None:
    file = tarred(tmp_path / "wrong.tar.gz", lambda packed: add(packed, "stage.toml", b"[stage]\nname = 5\n"))
    with pytest.raises(VelaturaError):
        archive.restore(stage, file)
    assert (stage / "stage.toml").read_text() == TEXT
    assert not (stage / "kiosk/replaced").exists()


def test_a_backup_of_a_newer_velatura_says_so(stage: Path, tmp_path: Path) -> None:
    file = tarred(tmp_path / "new.tar.gz", lambda packed: add(packed, "stage.toml", TEXT.encode()), b'{"velatura": 2}')
    with pytest.raises(UsageError, match="newer Velatura"):
        archive.restore(stage, file)


@pytest.mark.parametrize(("network", "there", "refused"), [
    ("0.0.0.0/0", "", True), ("::/0", "", True), ("8.0.0.0/8", "", True), ("192.168.0.0/16", "", False),
    ("0.0.0.0/0", "0.0.0.0/0", False), ("0.0.0.0/0", None, False),
])  # fmt: skip
def test_a_backup_that_opens_a_stage_to_the_world_is_refused(
    stage: Path, tmp_path: Path, network: str, there: str | None, refused: bool
) -> None:
    table = '[pjlink]\nhost = "0.0.0.0"\nallow = ["{}"]\n'
    (stage / "building.toml").write_text(table.format(network))
    file = archive.backup(stage).rename(tmp_path / "b.tar.gz")
    (stage / "building.toml").write_text(table.format(there or "10.0.0.0/8"))
    place = tmp_path / "empty" if there is None else stage
    if refused:
        with pytest.raises(UsageError, match="command the stage"):
            archive.restore(place, file)
    else:
        archive.restore(place, file)
    assert (network in (place / "building.toml").read_text()) != refused


@pytest.mark.parametrize("left", ["a file", "a folder of before", "damaged settings", "a damaged list"])
def test_a_start_gives_up_what_can_not_be_finished(stage: Path, left: str) -> None:
    work = stage / archive.RESTORING
    if left == "a file":
        work.write_text("x")
    else:
        (work / "fresh").mkdir(parents=True)
        (work / "runs").write_text("x")
        (work / "fresh/schedule.toml").write_text("new")
        (work / "fresh/stage.toml").write_text(TEXT if left == "a damaged list" else "damaged")
    if left.startswith("damaged") or left == "a damaged list":
        (work / "parts.json").write_text(
            "{" if left == "a damaged list" else '{"parts": ["schedule.toml", "stage.toml"]}'
        )
        with pytest.raises(WorkError, match="as it was before"):
            archive.finish_restore(stage)
    assert not archive.finish_restore(stage)
    assert not work.exists()
    assert (stage / "stage.toml").read_text() == TEXT
    assert not (stage / "schedule.toml").exists()


def test_a_part_that_can_not_be_moved_brings_all_others_back(stage: Path, tmp_path: Path) -> None:
    (stage / "stage.toml").write_text(TEXT.replace("appearances/glass.png", "pictures/glass.png"))
    for name in ("pictures/glass.png", "schedule.toml"):
        (stage / name).parent.mkdir(exist_ok=True)
        (stage / name).write_text("of the backup")
    file = archive.backup(stage).rename(tmp_path / "b.tar.gz")
    (stage / "appearances/glass.png").write_text("of now")
    (stage / "schedule.toml").write_text("of now")
    shutil.rmtree(stage / "pictures")
    (stage / "pictures").write_text("a file where the backup has a folder")
    before = {path: path.read_bytes() for path in stage.rglob("*") if path.is_file()}
    with pytest.raises(WorkError, match="as it was before"):
        archive.restore(stage, file)
    after = {path: path.read_bytes() for path in stage.rglob("*") if path.is_file()}
    assert after == before


def test_a_backup_that_would_fill_the_disk_is_refused(stage: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = archive.backup(stage)
    monkeypatch.setattr("shutil.disk_usage", lambda path: SimpleNamespace(total=9000, free=1000))
    with pytest.raises(WorkError, match="GB are free"):
        archive.restore(stage, file)
    assert not list(stage.glob(".restore-*"))


def test_diagnostics_hold_facts_and_journals_and_no_secret_and_no_picture(stage: Path) -> None:
    (stage / "lamps.json").write_text("{}")
    file = diagnostics(stage, {"state": "playing"})
    held = names(file)
    assert {"facts.json", "stage.toml", "lamps.json", f"runs/{OLD}/journal.sqlite"} <= held
    assert not [name for name in held if name.endswith(".png") or "keys" in name or "accounts" in name]
    assert b"SECRET" not in contents(file)
    assert b'"state": "playing"' in contents(file)


def test_no_secret_of_the_settings_is_in_diagnostics(stage: Path) -> None:
    secrets = ("geheim-1", "/T0/hook-2", "post-3@example.org", "write-4", "anna-5", "pass-6", "tok-7", "kurz")
    text = TEXT.replace(
        'driver = "serial"\nport = "/dev/ttyUSB0"', 'driver = "pjlink"\naddress = "h"\npassword = "geheim-1"'
    )
    text = text.replace('"optoma-later"', '"pjlink"') + (
        '[alerts]\nwebhook = "https://example.org/T0/hook-2"\nmail_user = "post-3@example.org"\n'
        '[[relays]]\nname = "r"\ndriver = "snmp-pdu"\naddress = "h"\nchannels = 1\ncommunity = \'write-4\'\n'
        'mains = [{ channel = 1, feeds = ["left"] }]\n[backup]\nssh = "ssh://anna-5@nas/x"\n'
    )
    (stage / "stage.toml").write_text(text)
    (stage / "run").mkdir()
    (stage / "run/player.log").write_text("rtsp://me:pass-6@host/x?token=tok-7 said geheim-1\n# password = kurz\n")
    with contextlib.closing(EventLog(stage / EventLog.FILE)) as log:
        log.add(Notice("x", "The server took /T0/hook-2 and geheim-1, from anna-5@nas."))
    for settings in (text, text + "damaged"):
        (stage / "stage.toml").write_text(settings)
        file = diagnostics(stage, {"events": [{"password": "kurz"}, "ssh://anna-5@nas"]})
        held = contents(file)
        # Of damaged settings it is not known any more what is secret in other texts.
        other = held if settings == text else held.split(b"SQLite format")[0]
        assert [secret for secret in secrets if secret.encode() in other.replace(b"from anna-5@nas", b"")] == []
        assert b"address" in held
        assert b"snmp-pdu" in held
    with tarfile.open(file) as packed:
        database = packed.extractfile(EventLog.FILE)
        assert database is not None
        (stage / "copy.sqlite").write_bytes(database.read())
    with contextlib.closing(sqlite3.connect(stage / "copy.sqlite")) as copy:
        assert copy.execute("PRAGMA integrity_check").fetchone() == ("ok",)


def test_diagnostics_hold_the_newest_tape_unless_it_is_too_large(stage: Path) -> None:
    for number, name in enumerate(("old", "new")):
        new_tape(stage, name).write_text(f"velatura tape 1\n{'x' * 100}")
        os.utime(stage / "tapes" / f"{name}.tape", (number, number))
    held = names(diagnostics(stage, {}))
    assert [name for name in held if name.startswith("tapes/")] == ["tapes/new.tape"]
    os.truncate(stage / "tapes" / "new.tape", LARGEST_TAPE + 1)  # sparse
    assert not [name for name in names(diagnostics(stage, {})) if name.startswith("tapes/")]


def test_a_disk_that_takes_nothing_is_told_and_leaves_nothing(stage: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("tarfile.open", full)
    with pytest.raises(WorkError, match="No space left"):
        archive.backup(stage)
    assert list((stage / archive.FOLDER).iterdir()) == []


def test_what_a_kill_left_of_restores_and_backups_is_gone_with_the_next_start(
    stage: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def start(service: Service) -> None:
        raise WorkError("far-enough", what="This is all.", remedy="None.")

    (stage / archive.RESTORING / "fresh").mkdir(parents=True)
    (stage / archive.RESTORING / "parts.json").write_text("damaged")
    unpacked, part, going_on = (
        stage / ".restore-abc/fresh",
        stage / FOLDER / ".backup-1.part",
        stage / FOLDER / ".2.part",
    )
    unpacked.mkdir(parents=True)
    (stage / FOLDER).mkdir(parents=True)
    for file in (unpacked / "stage.toml", part, going_on):
        file.write_bytes(b"half of it")
    os.utime(part, (1.0, 1.0))
    monkeypatch.setattr(Service, "start", start)
    with pytest.raises(WorkError, match="This is all"), serving(stage, threading.Event()):
        pass
    assert [file.exists() for file in (unpacked.parent, part, going_on)] == [False, False, True]
    with contextlib.closing(EventLog(stage / EventLog.FILE)) as log:
        assert [row.code for row in log.after(0)] == ["restore-given-up", "service-ended"]
