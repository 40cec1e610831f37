"""What workers do: plain functions of plain values, sent by name.

A worker is a process with this release installed. One task of ours runs at a time in it, because the compiled kernels
use all of its cores by themselves. Errors come back as values: what a worker raises would not survive the way.
"""

from __future__ import annotations

import hashlib
import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Generic, TypeVar

import numpy as np
import xxhash

from controller.core.arrays import FloatImage
from controller.core.errors import VelaturaError
from controller.solve.appearance import Base, prepare_base
from controller.solve.bounded.solver import Solution
from controller.solve.drive_levels import DriveLevels
from controller.solve.request import AppearanceResult, SolveOptions, solve_appearance
from controller.solve.targets.values import Target
from controller.transport import LightTransport
from controller.transport.indirect import IndirectLight

Value = TypeVar("Value")
_RUNNING: Final = threading.Lock()
_CODE: Final = ("core/arrays.py", "core/jit.py", "solve", "transport")


@dataclass(frozen=True, slots=True)
class StageData:
    """What every appearance of a stage needs; a worker gets it once.

    ``image``: the base image C_b, ``solution`` its frames; ``black``: K; ``indirect``: G, where there is one
    """

    transport: LightTransport
    image: FloatImage
    solution: Solution
    black: FloatImage
    indirect: IndirectLight | None = None

    def digest(self) -> str:
        """A hash of the contents: equal stages are sent once, however often they are asked for."""
        hashed = xxhash.xxh3_128()
        for name, array in sorted(self.transport.arrays().items()):
            _update(hashed, name, array)
        for number, array in enumerate((self.image, *self.solution.frames, self.black)):
            _update(hashed, str(number), array)
        for name, array in sorted(({} if self.indirect is None else self.indirect.arrays()).items()):
            _update(hashed, f"indirect {name}", array)
        return hashed.hexdigest()


def _update(hashed: xxhash.xxh3_128, name: str, array: np.ndarray[tuple[int, ...], np.dtype[np.generic]]) -> None:
    hashed.update(f"{name} {array.dtype} {array.shape}".encode())
    if array.size:
        hashed.update(np.ascontiguousarray(array).data.cast("B"))


@dataclass(frozen=True, slots=True)
class Outcome(Generic[Value]):
    """What a task came to: a value, or the code and the sentences of the error that stopped it."""

    value: Value | None
    error: tuple[type[VelaturaError], str, str, str] | None

    def unwrapped(self) -> Value:
        """The value. Raises the error here that was raised there."""
        if self.error is not None:
            kind, code, what, remedy = self.error
            raise kind(code, what=what, remedy=remedy)
        assert self.value is not None
        return self.value


def _told(work: Callable[[], Value]) -> Outcome[Value]:
    try:
        with _RUNNING:
            return Outcome(work(), None)
    except VelaturaError as error:
        return Outcome(None, (type(error), error.code, error.what, error.remedy))


_kept: dict[str, tuple[Base, DriveLevels]] = {}


def make_there(stage: StageData, key: str, asked: Target, options: SolveOptions) -> Outcome[AppearanceResult]:
    """An appearance, as ``solve.request.solve_appearance`` makes it; ``key`` names the stage's contents."""

    def work() -> AppearanceResult:
        if key not in _kept:
            _kept.clear()  # a stage fills a worker's memory: not two of them
            base = prepare_base(stage.transport, stage.image, stage.black, stage.solution)
            _kept[key] = base, DriveLevels(stage.transport)
        base, drive = _kept[key]
        return solve_appearance(
            stage.transport, base, stage.black, asked, options, drive=drive, indirect=stage.indirect
        )

    return _told(work)


def code_digest() -> str:
    """A hash of the code that this process runs with and results depend on; machines must not differ in it."""
    return _CODE_DIGEST


def _digest_of_code() -> str:
    hashed = hashlib.sha256(np.__version__.encode())
    folder = Path(__file__).resolve().parent.parent
    for name in _CODE:
        path = folder / name
        for file in sorted(path.rglob("*.py")) if path.is_dir() else [path]:
            hashed.update(file.relative_to(folder).as_posix().encode() + file.read_bytes())
    return hashed.hexdigest()


# as of now: the files may be replaced while we run
_CODE_DIGEST: Final = _digest_of_code()
