"""Three starts without a picture: the bundle before plays again."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

from controller.bundle.install import NAME, CountedStart, Starts, install, rollback
from tests.controller.bundle.test_install import made, plays


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for value in (1, 2):
        install(made(tmp_path / "b.vel", value, value), tmp_path / "bundles", allow_unsigned=True)
    return tmp_path / "bundles"


def start(folder: Path) -> CountedStart:
    return CountedStart(folder, lambda _: None)


def test_the_fourth_start_plays_the_bundle_before_and_says_so(folder: Path) -> None:
    said: list[str] = []
    for _ in range(3):
        assert CountedStart(folder, said.append).file == folder / (folder / "current").readlink()
        assert plays(folder) == 2
        assert said == []
    fourth = CountedStart(folder, said.append)
    assert plays(folder) == 1
    assert fourth.file == folder / (folder / "current").readlink()
    assert "3 starts" in said[0]


def test_a_picture_ends_the_count(folder: Path) -> None:
    for _ in range(3):
        for _ in range(2):
            start(folder)
        third = start(folder)
        third.shown()
        third.ended()
    assert plays(folder) == 2
    assert Starts.read(folder).failed == 0


def test_an_orderly_end_without_a_picture_is_not_counted(folder: Path) -> None:
    for _ in range(10):
        start(folder).ended()
    assert plays(folder) == 2


def test_a_start_that_waits_is_not_counted_and_one_that_is_asked_in_vain_is(folder: Path) -> None:
    for _ in range(10):
        start(folder).ready()
    assert (plays(folder), Starts.read(folder).failed) == (2, 0)
    for _ in range(3):
        waits = start(folder)
        waits.ready()
        waits.asked()
        waits.asked()
    assert Starts.read(folder).failed == 3
    start(folder)
    assert plays(folder) == 1


def test_an_orderly_end_of_one_that_waits_changes_nothing(folder: Path) -> None:
    start(folder)
    waits = start(folder)
    waits.ready()
    waits.ended()
    assert Starts.read(folder).failed == 1
    waits.asked()
    waits.ended()
    assert Starts.read(folder).failed == 1


def test_one_that_was_asked_before_it_was_ready_counts(folder: Path) -> None:
    resumed = start(folder)
    resumed.asked()
    resumed.ready()
    assert Starts.read(folder).failed == 1


def test_two_bad_bundles_do_not_take_turns(folder: Path) -> None:
    for _ in range(12):
        start(folder)
    assert plays(folder) == 1


def test_a_damaged_bundle_is_not_gone_back_to(folder: Path) -> None:
    before = folder / (folder / "previous").readlink()
    before.write_bytes(before.read_bytes()[:-40])
    for _ in range(8):
        start(folder)
    assert plays(folder) == 2


def test_without_another_bundle_the_current_one_is_tried_for_ever(tmp_path: Path) -> None:
    install(made(tmp_path / "b.vel", 5), tmp_path / "bundles", allow_unsigned=True)
    for _ in range(8):
        assert start(tmp_path / "bundles").file.suffix == ".vel"
    assert plays(tmp_path / "bundles") == 5


def test_a_bundle_that_is_gone_is_replaced_at_once(folder: Path) -> None:
    (folder / (folder / "current").readlink()).unlink()
    start(folder)
    assert plays(folder) == 1


@pytest.mark.parametrize("again", ["install", "rollback"])
def test_who_installs_a_bundle_or_goes_back_to_it_gives_it_its_starts_again(
    folder: Path, tmp_path: Path, again: str
) -> None:
    for _ in range(4):
        start(folder)
    assert plays(folder) == 1
    if again == "install":
        install(tmp_path / "b.vel", folder, allow_unsigned=True)
    else:
        rollback(folder)
    for _ in range(3):
        start(folder)
        assert plays(folder) == 2
    start(folder)
    assert plays(folder) == 1


@pytest.mark.parametrize(
    "content",
    [b"", b"{", b"[1]", b"[" * 5000, b'{"bundle": 3, "failed": 9, "given_up": null}', json.dumps({
        "bundle": "x", "failed": True, "given_up": None}).encode(), b"\xff" * 9000,
     b'{"bundle": "x", "failed": -1, "given_up": null}'],
)  # fmt: skip
def test_a_foreign_count_counts_nothing(folder: Path, content: bytes) -> None:
    (folder / NAME).write_bytes(content)
    start(folder)
    assert plays(folder) == 2
    assert Starts.read(folder).failed == 1


def test_a_folder_that_can_not_be_written_plays_on_and_says_so(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def read_only(*_: object, **__: object) -> None:
        raise OSError(30, os.strerror(30))

    start(folder)
    start(folder)
    start(folder)
    monkeypatch.setattr(Path, "replace", read_only)
    said: list[str] = []
    fourth = CountedStart(folder, said.append)
    fourth.shown()
    fourth.ended()
    assert fourth.file == folder / (folder / "previous").readlink(), "it falls back, though it can not keep that"
    assert plays(folder) == 2
    assert sum("could not be saved" in sentence for sentence in said) >= 2
