"""A kernel folder that holds what the tables name and nothing else, so that a further compilation shows."""

from __future__ import annotations

import json
import os
import pickle
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from hal.runtime.compute import ROOT, digest_of, kernel_folder
from hal.runtime.kernels import TABLES, encode, main


def kernels_of_the_tables(to: Path, copy_file: Callable[[str, str], object] = os.link) -> None:
    """Make ``to`` a kernel folder with all kernels of the tables, compiled; their machine code is linked by default.

    The user's kernel folder may hold more, which other tests compiled: those are left out.
    """
    assert main(["compile"]) == 0
    for source, folder in _folders(kernel_folder()):
        copy = Path(shutil.copytree(folder, to / folder.name, copy_function=copy_file))
        for index in copy.glob("*.nbi"):
            _keep(index, _calls_in_tables(source, _function(source, index)))
    for stamp in kernel_folder().glob("all-*"):
        shutil.copy2(stamp, to)


def compiled_calls(kernels: Path) -> set[str]:
    """All that the kernel folder has machine code for, from the present sources: ``folder/function: types``."""
    return {
        f"{folder.name}/{_function(source, index)}: {key[0]}"
        for source, folder in _folders(kernels)
        for index in folder.glob("*.nbi")
        for key in _read(index)[2]
    }


def _folders(kernels: Path) -> Iterator[tuple[Path, Path]]:
    for table in TABLES:
        for source in sorted(table.parent.rglob("*.py")):
            folder = kernels / f"{source.stem}-{digest_of(source)}"
            if folder.is_dir():
                yield source, folder


def _function(source: Path, index: Path) -> str:
    return index.name.removeprefix(f"{source.stem}.").partition("-")[0]


def _calls_in_tables(source: Path, function: str) -> list[Any]:
    module = ".".join(source.relative_to(ROOT).with_suffix("").parts)
    return [call for table in TABLES for call in json.loads(table.read_text()).get(module, {}).get(function, [])]


def _keep(index: Path, calls: list[Any]) -> None:
    """Of numba's index file only ``calls``; it is replaced, because another folder has it too."""
    version, stamp, overloads = _read(index)
    kept = {key: file for key, file in overloads.items() if [encode(kind) for kind in key[0]] in calls}
    index.unlink()
    with index.open("wb") as file:
        pickle.dump(version, file)
        file.write(pickle.dumps((stamp, kept)))


def _read(index: Path) -> tuple[Any, Any, dict[Any, str]]:
    """numba's version, the sources' stamp, and the file of each call."""
    with index.open("rb") as file:
        version = pickle.load(file)
        stamp, overloads = pickle.loads(file.read())
    return version, stamp, overloads
