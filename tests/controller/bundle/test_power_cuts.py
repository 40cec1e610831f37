"""Whenever the power goes, a stage has a whole bundle to play, and the next installation works."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from controller.bundle.install import CountedStart, Starts, current, install, previous, rollback
from controller.bundle.reader import Bundle
from tests.controller.bundle.power_cuts import every_cut
from tests.controller.bundle.test_install import made, plays


@pytest.fixture
def disk(monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder in memory where there is one: to wait for a real disk some ten thousand times is slow."""
    memory = Path("/dev/shm")
    monkeypatch.setattr(os, "fsync", lambda handle: None)
    with tempfile.TemporaryDirectory(dir=memory if os.access(memory, os.W_OK) else None) as folder:
        yield Path(folder)


def shows(file: Path | None) -> int:
    assert file is not None
    with Bundle.open(file, allow_unsigned=True) as bundle:
        return int(bundle.decode("a", "P1")[0, 0, 0])


def leftovers(folder: Path) -> list[str]:
    kept = ("current", "previous", "starts.json", ".install.lock")
    return [path.name for path in folder.iterdir() if path.name not in kept and path.suffix != ".vel"]


@pytest.mark.parametrize("first", [False, True])
def test_after_a_cut_of_an_installation_the_old_or_the_new_bundle_plays(disk: Path, first: bool) -> None:
    files = [made(disk / f"{value}.vel", value) for value in (1, 2, 3)]

    def begin(folder: Path) -> None:
        for file in files[: 0 if first else 2]:
            install(file, folder, allow_unsigned=True)

    seen: dict[int | None, int] = {}
    for number, folder in enumerate(
        every_cut(disk, begin, lambda folder: install(files[2], folder, allow_unsigned=True), outcomes=50)
    ):
        value = None if current(folder) is None else plays(folder)
        seen[value] = seen.get(value, 0) + 1
        if number % 4 == 0:
            install(files[2], folder, allow_unsigned=True)
            assert plays(folder) == 3
            assert leftovers(folder) == []
            assert len(list(folder.glob("*.vel"))) <= 2
        shutil.rmtree(folder)
    assert seen.keys() == {None if first else 2, 3}, "neither a third bundle nor none where there was one"
    assert sum(seen.values()) > (400 if first else 1000)


@pytest.mark.parametrize("rolls_back", [False, True])
def test_after_a_cut_at_any_step_both_bundles_of_before_or_both_of_after_are_there(
    disk: Path, rolls_back: bool
) -> None:
    files = [made(disk / f"{value}.vel", value) for value in (1, 2, 3)]

    def begin(folder: Path) -> None:
        for file in files[:2]:
            install(file, folder, allow_unsigned=True)

    def work(folder: Path) -> None:
        _ = rollback(folder) if rolls_back else install(files[2], folder, allow_unsigned=True)

    seen = set()
    for folder in every_cut(disk, begin, work, outcomes=8):
        pair = plays(folder), shows(previous(folder))
        rollback(folder)
        assert (plays(folder), shows(previous(folder))) == pair[::-1]
        seen.add(pair)
        shutil.rmtree(folder)
    assert seen == ({(2, 1), (1, 2)} if rolls_back else {(2, 1), (3, 2)})


def test_the_simulated_disk_punishes_a_forgotten_sync(disk: Path) -> None:
    files = [made(disk / f"{value}.vel", value) for value in (1, 2, 3)]

    def begin(folder: Path) -> None:
        for file in files[:2]:
            install(file, folder, allow_unsigned=True)

    def hasty(folder: Path) -> None:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("controller.bundle.install.sync_folder", lambda _: None)
            install(files[2], folder, allow_unsigned=True)

    assert any(current(folder) is None for folder in every_cut(disk, begin, hasty, outcomes=20))


def test_after_a_cut_of_a_fall_back_one_of_the_two_plays_and_the_count_is_sound(disk: Path) -> None:
    files = [made(disk / f"{value}.vel", value) for value in (1, 2)]

    def begin(folder: Path) -> None:
        for file in files:
            install(file, folder, allow_unsigned=True)
        now = current(folder)
        assert now is not None
        Starts(now.name, 3).write(folder)

    for folder in every_cut(disk, begin, lambda folder: CountedStart(folder, lambda _: None), outcomes=12):
        assert plays(folder) in (1, 2)
        for _ in range(4):
            CountedStart(folder, lambda _: None)
        assert plays(folder) == 1, "at the latest after three starts more"
        assert Starts.read(folder).failed >= 1
        shutil.rmtree(folder)
