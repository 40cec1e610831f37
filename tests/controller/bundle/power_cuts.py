"""A disk that forgets: what a folder may hold after a power cut, given what was synced before it.

Names (creations, renames, links, removals) are durable once the folder was synced, a file's bytes once the file was.
What was not synced may be there or not, each change by itself, so later changes may survive earlier ones; the bytes of
a file that was not synced are cut off or zeros.
"""

from __future__ import annotations

import os
import stat
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, BinaryIO, Self

import numpy as np
import pytest


class PowerCut(BaseException):
    """Not an Exception: nothing may catch it and continue."""


class Disk:
    """Watches one folder while ``run`` works in it, and cuts the power before the step number ``cut_before``."""

    def __init__(self, folder: Path, cut_before: int) -> None:
        self.folder = folder
        self._left = cut_before
        self._contents: dict[int, bytes | str | None] = {}
        """By number of a file: its durable bytes, the target of a link, or None while nothing is synced."""
        self._live: dict[int, Path] = {}
        self._by_inode: dict[int, int] = {}
        self.durable: dict[str, int] = {}
        self._pending: list[dict[str, int | None]] = []
        for path in folder.iterdir():
            self.durable[path.name] = self._new(path, path.is_symlink() or path.read_bytes())
        self._names = dict(self.durable)

    def _new(self, path: Path, content: bytes | bool | None) -> int:
        number = len(self._contents)
        self._contents[number] = str(path.readlink()) if content is True else content or b"" if content else None
        self._live[number] = path
        self._by_inode[path.lstat().st_ino] = number
        return number

    def step(self) -> None:
        if self._left <= 0:
            raise PowerCut
        self._left -= 1

    def change(self, **names: int | None) -> None:
        """A change of names that happens as a whole: number of a file, or None where a name goes."""
        self._pending.append(names)
        for name, number in names.items():
            if number is None:
                self._names.pop(name, None)
            else:
                self._names[name] = number

    def run(self, work: Callable[[], object], patch: pytest.MonkeyPatch) -> bool:
        """Whether the power was cut before ``work`` ended."""
        self._watch(patch)
        try:
            work()
        except PowerCut:
            return True
        finally:
            patch.undo()
        return False

    def _watch(self, patch: pytest.MonkeyPatch) -> None:
        real: dict[str, Any] = {
            "fsync": os.fsync, "fdopen": os.fdopen, "mkstemp": tempfile.mkstemp,
            "replace": Path.replace, "symlink_to": Path.symlink_to, "unlink": Path.unlink,
        }  # fmt: skip

        def fsync(handle: int) -> None:
            self.step()
            real["fsync"](handle)
            status = os.fstat(handle)
            if stat.S_ISDIR(status.st_mode):
                self._pending, self.durable = [], dict(self._names)
            else:
                number = self._by_inode[status.st_ino]
                self._contents[number] = self._live[number].read_bytes()

        def mkstemp(**options: Any) -> tuple[int, str]:
            self.step()
            handle, name = real["mkstemp"](**options)
            self.change(**{Path(name).name: self._new(Path(name), None)})
            return handle, name

        def replace(source: Path, target: Path) -> Path:
            self.step()
            number = self._names[source.name]
            real["replace"](source, target)
            self._live[number] = target
            self.change(**{source.name: None, target.name: number})
            return target

        def symlink_to(path: Path, target: str) -> None:
            self.step()
            real["symlink_to"](path, target)
            self.change(**{path.name: self._new(path, True)})

        def unlink(path: Path, missing_ok: bool = False) -> None:
            self.step()
            real["unlink"](path, missing_ok=missing_ok)
            self.change(**{path.name: None})

        patch.setattr(os, "fsync", fsync)
        patch.setattr(os, "fdopen", lambda handle, mode: _Writes(real["fdopen"](handle, mode), self))
        patch.setattr(tempfile, "mkstemp", mkstemp)
        for name, function in (("replace", replace), ("symlink_to", symlink_to), ("unlink", unlink)):
            patch.setattr(Path, name, function)

    def after_the_cut(self, folder: Path, random: np.random.Generator, *, kept: float) -> Path:
        """Write into the new ``folder`` what the disk may hold; ``kept``: how likely each unsynced change is there."""
        names = dict(self.durable)
        for change in self._pending:
            if random.random() < kept:
                for name, number in change.items():
                    names.pop(name, None)
                    names |= {} if number is None else {name: number}
        folder.mkdir()
        for name, number in names.items():
            content = self._contents[number]
            if isinstance(content, str):
                (folder / name).symlink_to(content)
            else:
                (folder / name).write_bytes(self._torn(number, random) if content is None else content)
        return folder

    def _torn(self, number: int, random: np.random.Generator) -> bytes:
        data = self._live[number].read_bytes() if self._live[number].is_file() else b""
        length = int(random.integers(0, len(data) + 1))
        return data[:length] + bytes(int(random.integers(0, 2)) * (len(data) - length))


class _Writes:
    """A file whose every write is a step."""

    def __init__(self, file: BinaryIO, disk: Disk) -> None:
        self._file, self._disk = file, disk

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def write(self, data: bytes) -> int:
        self._disk.step()
        return self._file.write(data)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._file, name)


def every_cut(
    tmp_path: Path, begin: Callable[[Path], None], work: Callable[[Path], object], *, outcomes: int
) -> Iterator[Path]:
    """The folder after each possible cut of ``work``, in ``outcomes`` versions: all lost, all kept, and random ones."""
    random = np.random.default_rng(11)
    for moment in range(1000):
        folder = tmp_path / f"at-{moment}"
        folder.mkdir()
        begin(folder)
        disk = Disk(folder, moment)
        cut = disk.run(lambda: work(folder), pytest.MonkeyPatch())  # noqa: B023 - called at once
        for number in range(outcomes):
            kept = (0.0, 1.0)[number] if number < 2 else random.random()
            yield disk.after_the_cut(tmp_path / f"after-{moment}-{number}", random, kept=kept)
        if not cut:
            return
    raise AssertionError("the work never ended")
