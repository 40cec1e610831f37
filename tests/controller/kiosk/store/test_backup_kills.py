"""Killed before any operation on files, a backup and a restore leave one whole state, and nothing large."""

from __future__ import annotations

import contextlib
import itertools
import os
import shutil
import tarfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from controller.kiosk.backup import copied
from controller.kiosk.store import archive
from hal.registry import load_drivers
from tests.controller.kiosk.vase import TEXT, graded_run, vase

RUN = "20260501-100000-calibrate"
OPERATIONS = ("rename", "replace", "mkdir", "unlink", "rmdir", "fsync", "symlink", "chmod", "utime")


class Killed(BaseException):
    """Nothing may catch it and continue."""


class Operations:
    """Counts operations on files, and from ``most`` on does none: what would clean up does not run after a kill."""

    def __init__(self, patch: pytest.MonkeyPatch, most: int | None = None) -> None:
        self.done: list[tuple[str, str]] = []
        self._most = most
        for name in OPERATIONS:
            patch.setattr(os, name, self._counted(name, getattr(os, name)))

    def _counted(self, name: str, real: Callable[..., Any]) -> Callable[..., Any]:
        def operation(*given: Any, **more: Any) -> Any:
            if self._most is not None and len(self.done) >= self._most:
                raise Killed
            what = str(Path(f"/proc/self/fd/{given[0]}").readlink()) if isinstance(given[0], int) else str(given[0])
            self.done.append((name, f"{what} {given[1]}" if name in ("rename", "replace") else what))
            return None if name == "fsync" else real(*given, **more)

        return operation


def files(folder: Path) -> dict[str, bytes]:
    found = (path for path in folder.rglob("*") if path.is_file() and not path.name.endswith(("-shm", "-wal")))
    return {str(path.relative_to(folder)): path.read_bytes() for path in found}


def stage_with(folder: Path, word: str) -> Path:
    """A stage all of whose parts say ``word``."""
    stage = vase(folder)
    (stage / "stage.toml").write_text(
        TEXT.replace("The vase", word).replace("appearances/glass.png", "deep/er/glass.png")
    )
    for name in ("appearances/glass.png", "deep/er/glass.png", "bundles/1.vel", "schedule.toml"):
        (stage / name).parent.mkdir(parents=True, exist_ok=True)
        (stage / name).write_text(word)
    graded_run(stage, RUN, {word: 0.01})
    return stage


def words_of(stage: Path) -> set[str]:
    """Which words the stage's parts say, and the calibration that counts."""
    newest = max((stage / "runs").iterdir(), key=lambda run: run.name)
    texts = [(stage / name).read_text() for name in ("appearances/glass.png", "deep/er/glass.png", "bundles/1.vel")]
    texts += [(stage / "schedule.toml").read_text(), (stage / "stage.toml").read_text()]
    texts.append((newest / "verification.json").read_text())
    return {word for word in ("ancient", "fresh") for text in texts if word in text}


def test_a_restore_that_is_killed_anywhere_leaves_one_whole_state(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = archive.backup(stage_with(tmp_path / "first", "fresh")).rename(tmp_path / "b.tar.gz")
    before = stage_with(tmp_path / "before", "ancient")
    old, drivers, outcomes = files(before), load_drivers(benches=False), []
    monkeypatch.setattr("controller.stage.sessions.check.load_drivers", lambda **_: drivers)
    shutil.copytree(before, tmp_path / "counted")
    with pytest.MonkeyPatch.context() as patch:
        done = Operations(patch).done
        archive.restore(tmp_path / "counted", file)
    moved_from = next(n for n, (name, what) in enumerate(done) if name == "rename" and what.endswith(archive.RESTORING))
    # Before that, only files of its own are written.
    for moment in [*range(0, moved_from - 2, 9), *range(moved_from - 2, len(done) + 20)]:
        stage = tmp_path / "stage"
        shutil.rmtree(stage, ignore_errors=True)
        shutil.copytree(before, stage)
        with pytest.MonkeyPatch.context() as patch:
            Operations(patch, moment)
            try:
                archive.restore(stage, file)
                ended = True
            except Killed:
                ended = False
        if moment % 7 == 3:  # the start that follows may be killed, too
            with pytest.MonkeyPatch.context() as patch:
                Operations(patch, moment // 7)
                with contextlib.suppress(Killed):
                    archive.finish_restore(stage)
        archive.finish_restore(stage)
        archive.clear_cut_off(stage)
        (word,) = words_of(stage)
        outcomes.append(word)
        assert not list(stage.glob(".rest*"))
        now = files(stage)
        if word == "ancient":
            assert now == old
        else:
            lost = [
                name for name, data in old.items() if data not in (now.get(f"kiosk/replaced/{name}"), now.get(name))
            ]
            assert lost == []
        if ended:
            break
    assert ended
    assert sorted(outcomes) == outcomes, "first the old state, then the new one"
    assert outcomes.count("ancient") > 8
    assert outcomes.count("fresh") > 20


def test_a_restore_syncs_each_file_and_each_new_name_before_it_goes_on(tmp_path: Path) -> None:
    file = archive.backup(stage_with(tmp_path / "first", "fresh")).rename(tmp_path / "b.tar.gz")
    stage = stage_with(tmp_path / "stage", "ancient")
    with pytest.MonkeyPatch.context() as patch:
        operations = Operations(patch)
        archive.restore(stage, file)
    done = operations.done
    renames = [n for n, (name, _) in enumerate(done) if name == "rename"]
    commit = next(n for n in renames if done[n][1].endswith(archive.RESTORING))
    synced = {what for name, what in done[:commit] if name == "fsync"}
    fresh = Path(done[commit][1].split()[0]) / "fresh"
    parts = "stage.toml", "appearances/glass.png", "bundles/1.vel", "bundles", "deep/er", "deep", "runs", "", ".."
    for part in parts:
        assert os.path.normpath(fresh / part) in synced, part
    for first, following in zip(renames, [*renames[1:], len(done)], strict=True):
        source, target = map(Path, done[first][1].split())
        after = {what for name, what in done[first:following] if name == "fsync"}
        assert str(target.parent) in after, done[first]
        assert first == commit or str(source.parent) in after, done[first]
        assert first < commit or str(stage) in after, done[first]


def test_a_backup_that_is_killed_anywhere_leaves_only_whole_ones(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    drivers = load_drivers(benches=False)
    monkeypatch.setattr("controller.stage.sessions.check.load_drivers", lambda **_: drivers)
    stage = stage_with(tmp_path / "stage", "ancient")
    place = tmp_path / "disk/velatura-20260504.tar.gz"
    place.parent.mkdir()
    place.write_bytes(whole := archive.backup(stage).read_bytes())
    for moment in itertools.count(0, 2):
        with pytest.MonkeyPatch.context() as patch:
            Operations(patch, moment)
            try:
                copied(archive.backup(stage), place)
                ended = True
            except Killed:
                ended = False
        assert place.read_bytes() == whole or ended or moment > 5
        for made in (place, *(stage / archive.FOLDER).glob("backup-*")):
            with tarfile.open(made) as packed:
                assert "stage.toml" in packed.getnames()
        if ended:
            break
    assert ended
    assert place.stat().st_mode & 0o777 == 0o600
    archive.clear_cut_off(stage)
    assert not [path for path in (stage / archive.FOLDER).iterdir() if path.is_dir()]
