"""Starts of the player are counted also where the disk takes nothing."""

from __future__ import annotations

import errno
import os
import tempfile
from pathlib import Path
from typing import Any

import pytest

from controller.bundle.install import (
    CURRENT,
    NAME,
    CountedStart,
    Starts,
    chosen,
    current,
    install,
    of_other_format,
    previous,
    rollback,
)
from controller.bundle.signing import Trust
from controller.core.storage import runtime_folder
from controller.kiosk.store.bundle_store import BundleStore
from tests.controller.bundle.test_install import made


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Of a stage that somebody serves."""
    runtime_folder(tmp_path)
    for value in (1, 2):
        install(made(tmp_path / "b.vel", value, value), tmp_path / "bundles", allow_unsigned=True)
    return tmp_path / "bundles"


def takes_nothing(folder: Path, patch: pytest.MonkeyPatch) -> None:
    """No file and no link can be made in ``folder``; elsewhere they can. What is there can be removed."""
    make_file, make_link = tempfile.mkstemp, Path.symlink_to
    refusal = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    def mkstemp(*words: Any, **named: Any) -> tuple[int, str]:
        if named.get("dir") == folder:
            raise refusal
        return make_file(*words, **named)

    def symlink_to(path: Path, *words: Any) -> None:
        if path.parent == folder:
            raise refusal
        make_link(path, *words)

    patch.setattr("controller.core.storage.tempfile.mkstemp", mkstemp)
    patch.setattr(Path, "symlink_to", symlink_to)


def test_on_a_full_disk_three_starts_without_a_picture_bring_the_bundle_before_and_it_stays(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bad, good = current(folder), previous(folder)
    assert bad is not None
    store = BundleStore(folder.parent, Trust((), allow_unsigned=True))
    with monkeypatch.context() as patch:
        takes_nothing(folder, patch)
        said: list[str] = []
        for failed in (1, 2, 3):
            assert CountedStart(folder, said.append).file == bad
            assert Starts.read(folder) == Starts(bad.name, failed)
        assert (said, store.bundle(), store.given_up()) == ([], bad, "")
        fourth = CountedStart(folder, said.append)
        assert fourth.file == good
        assert "3 starts" in said[0]
        fourth.shown()
        fourth.ended()
        assert current(folder) == bad, "the links could not be changed"
        for _ in range(6):
            assert CountedStart(folder, said.append).file == good
        assert (store.bundle(), store.given_up()) == (good, bad.name)
    CountedStart(folder, said.append)
    assert (current(folder), previous(folder)) == (good, bad), "now that there is room"
    assert (store.bundle(), store.given_up()) == (good, bad.name)
    assert Starts.read(folder).failed == 7
    assert not (runtime_folder(folder.parent) / NAME).exists()


@pytest.mark.parametrize("how", ["install", "rollback"])
def test_what_was_counted_in_memory_is_forgotten_when_somebody_installs_or_goes_back(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, how: str
) -> None:
    bad = current(folder)
    with monkeypatch.context() as patch:
        takes_nothing(folder, patch)
        for _ in range(4):
            CountedStart(folder, lambda _: None)
        assert chosen(folder) == previous(folder)
    if how == "install":
        install(tmp_path / "b.vel", folder, allow_unsigned=True)
        assert current(folder) == bad
    else:
        rollback(folder)
        assert previous(folder) == bad
    assert chosen(folder) == current(folder)
    assert Starts.read(folder) == Starts()


def test_a_picture_on_a_full_disk_ends_the_count_that_was_kept_before(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    CountedStart(folder, lambda _: None)
    CountedStart(folder, lambda _: None)
    with monkeypatch.context() as patch:
        takes_nothing(folder, patch)
        third = CountedStart(folder, lambda _: None)
        third.shown()
        third.ended()
        for _ in range(2):
            CountedStart(folder, lambda _: None)
        assert chosen(folder) == current(folder)
        assert Starts.read(folder).failed == 2


def newer(folder: Path, link: str = "current") -> Path:
    """Make the bundle behind ``link`` one of a later format, as a newer release would have installed it."""
    file = folder / (folder / link).readlink()
    data = bytearray(file.read_bytes())
    data[8:12] = (99).to_bytes(4, "little")
    name = f"{'9' * 63}{len(link)}.vel"
    (folder / name).write_bytes(data)
    file.unlink()
    (folder / link).unlink()
    (folder / link).symlink_to(name)
    return folder / name


def test_after_the_way_back_from_a_newer_format_the_bundle_before_plays_at_the_first_start(folder: Path) -> None:
    before, said = previous(folder), list[str]()
    file = newer(folder)
    assert of_other_format(folder) == [file]
    assert current(folder) is None
    start = CountedStart(folder, said.append)
    assert start.file == before
    assert "another format" in said[0]
    start.shown()
    start.ended()
    install(made(folder.parent / "b.vel", 3, 3), folder, allow_unsigned=True)
    assert of_other_format(folder) == []
    assert previous(folder) == before


def test_a_damaged_file_has_no_other_format(folder: Path) -> None:
    for n, data in enumerate((b"", b"VELBUNDL", b"nothing" * 100)):
        (folder / f"{'8' * 63}{n}.vel").write_bytes(data)
    assert of_other_format(folder) == []


def test_a_player_without_a_bundle_waits_for_the_first_one_and_counts_nothing(tmp_path: Path) -> None:
    folder, told = tmp_path / "bundles", list[str]()
    folder.mkdir()
    start = CountedStart(folder, told.append)
    assert (start.file, list(folder.iterdir()), told) == (folder / CURRENT, [], [])
    installed = install(made(tmp_path / "b.vel", 1, 1), folder, allow_unsigned=True)
    assert start.file.resolve() == installed.resolve()
