"""Compiles kernels before they are needed, in parallel: ``python -m hal.runtime.kernels compile``.

numba compiles a kernel at its first call, one after the other: a minute and a half in the middle of the first
calibration. Here the argument types of every kernel stand in tables, so that all can be compiled at once, by several
processes. ``python -m hal.runtime.kernels record`` writes the tables from what a run has left in the kernel folder;
use it when you add a kernel.
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import importlib
import json
import pickle
import subprocess
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from hal.runtime.compute import ROOT, digest_of, kernel_folder, usable_cpus

TABLES: Final = tuple(ROOT / package / "kernels.json" for package in ("controller", "plugins"))
"""Each for the kernels of its package: module -> function -> argument types of each call."""
SECONDS: Final = 100
"""Of processor time, about, to compile them all."""
Types = Any
"""Argument types as JSON has them: a name for a number, a list for an array or a tuple."""


@dataclass(frozen=True, slots=True)
class Module:
    """A module with kernels: (function, argument types) of each."""

    name: str
    calls: tuple[tuple[str, tuple[Types, ...]], ...]


def are_compiled() -> bool:
    """Whether all kernels of the tables were compiled on this machine by this version; takes milliseconds."""
    return not _missing() and _stamp().exists()


class Compilation:
    """All kernels of the tables, compiled by processes of their own from now on, until ``close``.

    Args:
        processes: How many; by default one for each CPU that may be used.
    """

    def __init__(self, processes: int | None = None) -> None:
        self._waiting = sorted(_modules(), key=lambda module: len(module.calls))  # the largest is taken first
        self._total = sum(len(module.calls) for module in self._waiting)
        self._done = 0
        self._failed: list[str] = []
        self._lock = threading.Lock()
        self._closed = False
        self._processes = [_begin() for _ in range(processes or usable_cpus())]
        self._threads = [
            threading.Thread(target=self._feed, args=(process,), daemon=True) for process in self._processes
        ]
        for thread in self._threads:
            thread.start()

    def __enter__(self) -> Compilation:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _feed(self, process: subprocess.Popen[str]) -> None:
        assert process.stdin is not None
        assert process.stdout is not None
        # A process that `close` ended leaves a name in the pipe, which can't be written any more.
        with contextlib.suppress(BrokenPipeError), process:
            while True:
                with self._lock:
                    if self._closed or not self._waiting:
                        return
                    module = self._waiting.pop()
                try:
                    process.stdin.write(f"{module.name}\n")
                    process.stdin.flush()
                    compiled = process.stdout.readline() == "compiled\n"
                except OSError:
                    compiled = False
                with self._lock:
                    self._done += len(module.calls)
                    if not compiled:
                        self._failed.append(module.name)

    @property
    def share(self) -> float:
        """Of the calls that are compiled, 0 to 1; 1 only when every process has ended."""
        if any(thread.is_alive() for thread in self._threads):
            return min(self._done / max(self._total, 1), 0.999)
        return 1.0

    def wait(self, seconds: float) -> bool:
        """Wait at most so long for the end; whether it has come. Raises nothing: see ``failed``."""
        ends_s = time.monotonic() + seconds
        for thread in self._threads:
            thread.join(max(0.0, ends_s - time.monotonic()))
        if self.share < 1:
            return False
        if not self._closed and not self._failed and not _missing():
            _stamp().parent.mkdir(parents=True, exist_ok=True)
            _stamp().touch()
        return True

    @property
    def failed(self) -> Sequence[str]:
        """Modules that could not be compiled ahead; their kernels are compiled, or fail, when they are called."""
        return tuple(self._failed)

    def close(self) -> None:
        """End the processes; what they have compiled is kept."""
        self._closed = True
        for process in self._processes:
            process.kill()
        for thread in self._threads:
            thread.join()


def _begin() -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", "hal.runtime.kernels", "modules"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
        cwd=ROOT,
        start_new_session=True,  # a Ctrl-C of the terminal is for the program that began it
    )


def compile_module(name: str) -> None:
    """Compile the kernels of one module for the calls in the tables, or find them in the kernel folder."""
    module = next(module for module in _modules() if module.name == name)
    imported = importlib.import_module(module.name)
    for function, types in module.calls:
        getattr(imported, function).compile(tuple(map(decode, types)))


def _modules() -> Iterator[Module]:
    for table in TABLES:
        if not table.is_file():
            continue
        for name, functions in json.loads(table.read_text(encoding="utf-8")).items():
            calls = [(function, tuple(types)) for function, rows in functions.items() for types in rows]
            yield Module(name, tuple(calls))


def _stamp() -> Path:
    """Exists when all is compiled: named after the tables and the sources of every module in them."""
    content = hashlib.sha256(f"{sys.version_info[:2]}".encode())
    for module in sorted(_modules(), key=lambda module: module.name):
        content.update(repr(module).encode())
        content.update(digest_of(_source(module.name)).encode())
    return kernel_folder() / f"all-{content.hexdigest()[:16]}"


def _missing() -> Sequence[str]:
    """Modules of the tables whose source does not exist any more."""
    return [module.name for module in _modules() if not _source(module.name).is_file()]


def _source(module: str) -> Path:
    return ROOT.joinpath(*module.split(".")).with_suffix(".py")


# -- argument types


def _numba_types() -> Any:
    from numba import types

    return types


def encode(kind: Any) -> Types | None:
    """A numba type as JSON; None for one that no Python caller has (literals, functions)."""
    types = _numba_types()
    if isinstance(kind, types.Number | types.Boolean | types.NoneType):
        return None if isinstance(kind, types.Literal) else str(kind)
    if isinstance(kind, types.Array):
        return ["array", str(kind.dtype), kind.ndim, kind.layout, kind.mutable, kind.aligned]
    if isinstance(kind, types.BaseTuple):
        parts = [encode(part) for part in kind]
        if None in parts:
            return None
        cls = getattr(kind, "instance_class", None)
        return ["tuple", None if cls is None else f"{cls.__module__}:{cls.__qualname__}", parts]
    return None


def decode(given: Types) -> Any:
    """The numba type. Raises ValueError for what ``encode`` does not write."""
    types = _numba_types()
    match given:
        case str(name):
            return getattr(types, name)
        case ["array", str(dtype), int(ndim), str(layout), bool(mutable), bool(aligned)]:
            return types.Array(getattr(types, dtype), ndim, layout, readonly=not mutable, aligned=aligned)
        case ["tuple", None, list(parts)]:
            return types.Tuple([decode(part) for part in parts])
        case ["tuple", str(cls), list(parts)]:
            module, _, name = cls.partition(":")
            found = getattr(importlib.import_module(module), name)
            return types.BaseTuple.from_types([decode(part) for part in parts], found)
    raise ValueError(f"not a kernel's argument type: {given!r}")


# -- recording


def record(folder: Path) -> Mapping[Path, Mapping[str, Any]]:
    """The tables of what was compiled into the kernel folder ``folder`` from the present sources."""
    tables: dict[Path, dict[str, Any]] = {table: {} for table in TABLES}
    for table in TABLES:
        for source in sorted(table.parent.rglob("*.py")):
            kept = folder / f"{source.stem}-{digest_of(source)}"
            functions: dict[str, set[str]] = {}
            for index in sorted(kept.glob("*.nbi")):
                function = index.name.removeprefix(f"{source.stem}.").partition("-")[0]
                rows = [[encode(kind) for kind in call] for call in _calls(index)]
                functions.setdefault(function, set()).update(json.dumps(row) for row in rows if None not in row)
            module = ".".join(source.relative_to(ROOT).with_suffix("").parts)
            found = {name: [json.loads(row) for row in sorted(rows)] for name, rows in functions.items() if rows}
            if found:
                tables[table][module] = found
    return tables


def _calls(index: Path) -> list[tuple[Any, ...]]:
    """The argument types of each version of a kernel in numba's index file."""
    with index.open("rb") as file:
        pickle.load(file)  # noqa: S301 - numba's version; files in this folder are this user's own
        _, versions = pickle.loads(file.read())  # noqa: S301
    return [key[0] for key in versions]


def main(arguments: Sequence[str] | None = None) -> int:
    """Exit code 0, or 1 where a kernel could not be compiled."""
    parser = argparse.ArgumentParser(
        prog="python -m hal.runtime.kernels", description="Compile kernels before they are needed."
    )
    commands: dict[str, Callable[[], int]] = {
        "compile": _compile_all, "modules": _compile_named, "record": _record,
    }  # fmt: skip
    parser.add_argument("command", choices=commands)
    return commands[parser.parse_args(arguments).command]()


def _compile_named() -> int:
    """Compile the modules whose names come on standard input, one a line, and answer each with a line."""
    code = 0
    for line in sys.stdin:
        try:
            compile_module(line.strip())
        except Exception:  # noqa: BLE001 - one module that fails does not stop those after it
            traceback.print_exc()
            print("failed", flush=True)  # noqa: T201
            code = 1
        else:
            print("compiled", flush=True)  # noqa: T201
    return code


def _compile_all() -> int:
    missing = _missing()
    for name in missing:
        print(  # noqa: T201
            f"velatura: The module {name} in the kernel tables does not exist. "
            "Run `python -m hal.runtime.kernels record`.",
            file=sys.stderr,
        )
    if missing:
        return 1
    if are_compiled():
        return 0
    print(f"Compiling kernels, once. This takes about {max(SECONDS // usable_cpus(), 20)} s ...", flush=True)  # noqa: T201
    with Compilation() as compilation:
        while not compilation.wait(1.0):
            pass
        for name in compilation.failed:
            print(f"velatura: {name} could not be compiled.", file=sys.stderr)  # noqa: T201
        return 1 if compilation.failed else 0


def _record() -> int:
    for table, modules in record(kernel_folder()).items():
        lines = []
        for module, functions in modules.items():
            rows = ",\n".join(f"  {json.dumps(name)}: {json.dumps(calls)}" for name, calls in functions.items())
            lines.append(f"{json.dumps(module)}: {{\n{rows}\n}}")
        table.write_text("{\n" + ",\n".join(lines) + "\n}\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
