"""The workers' tasks: plain functions of plain values, sent by name.

A worker is a process with this release installed. It runs one task at a time, because the compiled kernels use all of
its cores. Errors are returned as values, because Dask can't transfer our exceptions.
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
from controller.optics.solve.appearance import Base, StageLight, prepare_base
from controller.optics.solve.bounded.equations import Solution
from controller.optics.solve.reach.drive_levels import DriveLevels
from controller.optics.solve.request import AppearanceResult, SolveOptions, solve_appearance
from controller.optics.solve.targets.values import Target
from controller.optics.transport import LightTransport
from controller.optics.transport.indirect.indirect_light import IndirectLight

Value = TypeVar("Value")
_RUNNING: Final = threading.Lock()
_CODE: Final = (
    "controller/core/arrays.py",
    "hal/runtime/jit.py",
    "controller/optics/solve",
    "controller/optics/transport",
)


@dataclass(frozen=True, slots=True)
class StageData:
    """Data for all appearances of a stage; a worker gets it once.

    ``image``: the base image C_b, ``solution`` its frames; ``black``: K; ``indirect``: G, where there is one
    """

    transport: LightTransport
    image: FloatImage
    solution: Solution
    black: FloatImage
    indirect: IndirectLight | None = None

    def digest(self) -> str:
        """A hash of the contents, so that equal stages are sent only once."""
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
    """The result of a task: a value, or the code and the sentences of its error."""

    value: Value | None
    error: tuple[type[VelaturaError], str, str, str] | None

    def unwrapped(self) -> Value:
        """The value. Raises the error of the worker."""
        if self.error is not None:
            kind, code, what, remedy = self.error
            raise kind(code, what=what, remedy=remedy)
        assert self.value is not None
        return self.value


def _outcome_of(work: Callable[[], Value]) -> Outcome[Value]:
    try:
        with _RUNNING:
            return Outcome(work(), None)
    except VelaturaError as error:
        return Outcome(None, (type(error), error.code, error.what, error.remedy))


_kept: dict[str, tuple[Base, DriveLevels]] = {}


def make_there(stage: StageData, key: str, asked: Target, options: SolveOptions) -> Outcome[AppearanceResult]:
    """An appearance from ``solve.request.solve_appearance``; ``key`` identifies the stage's contents."""

    def work() -> AppearanceResult:
        if key not in _kept:
            _kept.clear()  # keep one stage only: it fills a worker's memory
            base = prepare_base(stage.transport, stage.image, stage.black, stage.solution)
            _kept[key] = base, DriveLevels(stage.transport)
        base, drive = _kept[key]
        light = StageLight(stage.transport, stage.black, stage.indirect, drive)
        return solve_appearance(light, base, asked, options)

    return _outcome_of(work)


def code_digest() -> str:
    """A hash of this process's code that affects results; it must be the same on all machines."""
    return _CODE_DIGEST


def _digest_of_code() -> str:
    hashed = hashlib.sha256(np.__version__.encode())
    folder = Path(__file__).resolve().parents[3]
    for name in _CODE:
        path = folder / name
        for file in sorted(path.rglob("*.py")) if path.is_dir() else [path]:
            hashed.update(file.relative_to(folder).as_posix().encode() + file.read_bytes())
    return hashed.hexdigest()


# read at import: the files may be replaced later
_CODE_DIGEST: Final = _digest_of_code()
