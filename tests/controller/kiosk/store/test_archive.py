from __future__ import annotations

import io
import os
import shutil
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
from controller.stage.sessions.run import new_tape
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


def tarred(path: Path, fill: Callable[[tarfile.TarFile], None], *, mark: bool = True) -> Path:
    with tarfile.open(path, "w:gz") as packed:
        if mark:
            add(packed, archive.MARK, b"{}")
        fill(packed)
    return path


def add(packed: tarfile.TarFile, name: str, data: bytes = b"x", kind: bytes = tarfile.REGTYPE, to: str = "") -> None:
    info = tarfile.TarInfo(name)
    info.size, info.type, info.linkname = len(data), kind, to
    packed.addfile(info, io.BytesIO(data))


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


def test_a_restored_calibration_counts_though_there_is_a_newer_one(stage: Path) -> None:
    file = archive.backup(stage)
    graded_run(stage, "20260701-100000-calibrate", {"left": 0.2})
    archive.restore(stage, file)
    newest = max((stage / "runs").iterdir(), key=lambda run: run.name)
    assert "0.01" in (newest / "verification.json").read_text()


HOSTILE: dict[str, Callable[[tarfile.TarFile], None]] = {
    "leads out": lambda packed: add(packed, "../stage.toml"),
    "leads out deeper": lambda packed: add(packed, "bundles/../../stage.toml"),
    "link up": lambda packed: add(packed, "bundles/current", b"", tarfile.SYMTYPE, ".."),
    "link out": lambda packed: add(packed, "bundles/current", b"", tarfile.SYMTYPE, "../../etc/passwd"),
    "hard link": lambda packed: add(packed, "stage.toml", b"", tarfile.LNKTYPE, "/etc/passwd"),
    "device": lambda packed: add(packed, "stage.toml", b"", tarfile.CHRTYPE),
    "a key": lambda packed: add(packed, "keys/stage.key"),
    "hidden": lambda packed: add(packed, ".bashrc"),
}


@pytest.mark.parametrize("how", HOSTILE)
def test_a_hostile_archive_is_refused_and_nothing_is_touched(stage: Path, tmp_path: Path, how: str) -> None:
    before = sorted(tmp_path.rglob("*"))
    file = tarred(tmp_path / "hostile.tar.gz", HOSTILE[how])
    with pytest.raises(UsageError, match="not a backup"):
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
    file = tarred(tmp_path / "other.tar.gz", lambda packed: add(packed, "stage.toml"), mark=False)
    with pytest.raises(UsageError, match="not a backup"):
        archive.restore(stage, file)


def test_a_backup_with_wrong_settings_replaces_nothing(stage: Path, tmp_path: Path) -> None:
    file = tarred(tmp_path / "wrong.tar.gz", lambda packed: add(packed, "stage.toml", b"[stage]\nname = 5\n"))
    with pytest.raises(VelaturaError):
        archive.restore(stage, file)
    assert (stage / "stage.toml").read_text() == TEXT
    assert not (stage / "kiosk/replaced").exists()


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


class Cut(Exception):
    """The power went."""


def test_a_restore_that_is_cut_off_anywhere_leaves_the_old_stage_or_becomes_the_new_one(
    stage: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    before = tmp_path / "before"
    file = tmp_path / "backup.tar.gz"
    archive.backup(stage).rename(file)
    (stage / "stage.toml").write_text(TEXT.replace("The vase", "Another vase"))
    (stage / "appearances" / "glass.png").write_bytes(b"later")
    shutil.copytree(stage, before, symlinks=True)
    rename, outcomes = Path.rename, set()
    for cut_at in range(1, 30):
        shutil.rmtree(stage)
        shutil.copytree(before, stage, symlinks=True)
        done = 0

        def cut(self: Path, target: Path, cut_at: int = cut_at) -> Path:
            nonlocal done
            done += 1
            if done == cut_at:
                raise Cut
            return rename(self, target)

        with monkeypatch.context() as patched:
            patched.setattr(Path, "rename", cut)
            try:
                archive.restore(stage, file)
                whole = True
            except Cut:
                whole = False
        finished = archive.finish_restore(stage)
        settings = (stage / "stage.toml").read_text()
        picture = (stage / "appearances" / "glass.png").read_bytes()
        outcomes.add(("Another" in settings, picture == b"later"))
        assert finished == (not whole and "Another" not in settings)
        assert not (stage / archive.RESTORING).exists()
        if whole:
            break
    assert outcomes == {(True, True), (False, False)}
    assert cut_at > 3


def test_what_a_kill_left_of_restores_and_backups_is_gone_with_the_next_start(
    stage: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def start(service: Service) -> None:
        raise WorkError("far-enough", what="This is all.", remedy="None.")

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
