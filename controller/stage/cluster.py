"""Solves on many machines with Dask: the workers' tasks, and the connection to the scheduler.

Tasks are plain functions of plain values, sent by name. A worker is a process with this release installed. It runs one
task at a time, because the compiled kernels use all of its cores. Errors are returned as values, because Dask can't
transfer our exceptions. A task whose worker fails is started again.

Dask's protocol unpickles the data of its peers: a scheduler and its workers can run any code here, and the other way
round. So they need their own network, or TLS with certificates on both sides (address ``tls://``; the files as in
Dask's configuration, ``distributed.comm.tls``).
"""

from __future__ import annotations

import contextlib
import hashlib
import secrets
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Generic, TypeVar

import numpy as np
import xxhash

from controller.core.arrays import FloatImage
from controller.core.errors import UsageError, VelaturaError, WorkError
from controller.core.extras import extra_missing
from controller.optics.solve.appearance import Base, StageLight, prepare_base
from controller.optics.solve.bounded.engine import SolveContext
from controller.optics.solve.bounded.equations import Solution
from controller.optics.solve.engines import choose_engine
from controller.optics.solve.reach.drive_levels import DriveLevels
from controller.optics.solve.request import AppearanceResult, SolveOptions, solve_appearance
from controller.optics.solve.targets.values import Target
from controller.optics.transport import LightTransport
from controller.optics.transport.indirect.indirect_light import ReflectedLight

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
    indirect: ReflectedLight | None = None

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
            _kept[key] = base, DriveLevels.of_transport(stage.transport)
        base, drive = _kept[key]
        light = StageLight(stage.transport, stage.black, stage.indirect, drive)
        engine = choose_engine("cpu", lambda note: None)
        return solve_appearance(light, base, asked, options, SolveContext(engine))

    return _outcome_of(work)


def code_digest() -> str:
    """A hash of this process's code that affects results; it must be the same on all machines."""
    return _CODE_DIGEST


def _digest_of_code() -> str:
    hashed = hashlib.sha256(np.__version__.encode())
    folder = Path(__file__).resolve().parents[2]
    for name in _CODE:
        path = folder / name
        for file in sorted(path.rglob("*.py")) if path.is_dir() else [path]:
            hashed.update(file.relative_to(folder).as_posix().encode() + file.read_bytes())
    return hashed.hexdigest()


# read at import: the files may be replaced later
_CODE_DIGEST: Final = _digest_of_code()


CONNECT_S: Final = 10.0
WORKERS_S: Final = 60.0
"""How long to wait while the scheduler has no worker at all."""
POLL_S: Final = 0.02
ASK_S: Final = 1.0
"""Interval of asking the scheduler for its workers during a task."""
TRIES: Final = 4
"""Maximum starts of a task whose worker was lost."""


class Cluster:
    """Workers of a scheduler. For calls from one thread."""

    def __init__(self, client: Any, address: str) -> None:
        self._client = client
        self._address = address
        self._shared: dict[str, Any] = {}

    @property
    def workers(self) -> int:
        """Number of workers now."""
        info: dict[str, Any] = self._client.scheduler_info(n_workers=-1)
        return len(info["workers"])

    def submit(self, function: Callable[..., Outcome[Value]], *arguments: Any) -> Task[Value]:
        """Start ``function(*arguments)`` on a worker; ``Shared`` arguments arrive there as their values."""
        return Task(self, lambda: self._begin(function, arguments))

    def share(self, key: str, value: Any) -> Shared:
        """Data for many tasks. ``key`` identifies the content; each worker gets it once, at its first use."""
        return Shared(key, value)

    def _begin(self, function: Callable[..., Any], arguments: tuple[Any, ...]) -> Any:
        given = [self._placed(part) if isinstance(part, Shared) else part for part in arguments]
        return self._client.submit(function, *given, pure=False, retries=0)

    def _placed(self, shared: Shared) -> Any:
        """The data in the cluster; sent again if its worker is gone."""
        future = self._shared.get(shared.key)
        if future is None or future.status != "finished":
            self.wait_for_workers(lambda: None)
            # Never twice under one name: a worker that still asks a lost worker for the data would drop the new copy,
            # the scheduler would believe that the worker has it, and its tasks would wait for ever.
            name = f"{shared.key}-{secrets.token_hex(8)}"
            (future,) = self._client.scatter({name: shared.value}, hash=False).values()
            self._shared[shared.key] = future
        return future

    def wait_for_workers(self, check: Callable[[], None]) -> None:
        """Return once there is a worker.

        Raises WorkError("no-workers") after ``WORKERS_S`` without one, and what ``check`` raises.
        """
        began_s = time.monotonic()
        while self.workers == 0:
            check()
            if time.monotonic() - began_s > WORKERS_S:
                raise WorkError(
                    "no-workers",
                    what=f"The scheduler at {self._address} has had no worker for {WORKERS_S:g} seconds.",
                    remedy="Start workers (docs/how-to/cluster.md), or solve without --scheduler.",
                )
            time.sleep(POLL_S)

    def check_code(self) -> None:
        """Raise UsageError("workers-differ") unless every worker has the same code as this process."""
        ours = code_digest()
        self.wait_for_workers(lambda: None)
        theirs = self._client.run(code_digest, on_error="return")
        other = [address for address, digest in theirs.items() if digest != ours]
        if other:
            raise UsageError(
                "workers-differ",
                what=f"{len(other)} of {len(theirs)} workers have another release of Velatura, or none: {other[0]}.",
                remedy="Install this release on every machine, and start its workers again.",
            )


class Shared:
    """Data named by its content; see ``Cluster.share``."""

    def __init__(self, key: str, value: Any) -> None:
        self.key = key
        self.value = value


class Task(Generic[Value]):
    """Work that was started elsewhere."""

    def __init__(self, cluster: Cluster, begin: Callable[[], Any]) -> None:
        self._cluster = cluster
        self._begin = begin
        self._future = begin()

    def result(self, check: Callable[[], None] = lambda: None) -> Value:
        """Wait and return the value. ``check`` is called often; if it raises, the task is cancelled.

        Raises what the work raised; WorkError "workers-lost" or "no-workers".
        """
        for _ in range(TRIES):
            try:
                asked_s = time.monotonic()
                while not self._future.done():
                    check()
                    if time.monotonic() - asked_s > ASK_S:
                        self._cluster.wait_for_workers(check)
                        asked_s = time.monotonic()
                    time.sleep(POLL_S)
            except BaseException:
                self.cancel()
                raise
            if self._future.status == "finished":
                with contextlib.suppress(*_lost()):
                    outcome: Outcome[Value] = self._future.result(timeout=WORKERS_S)
                    return outcome.unwrapped()
            elif self._future.status == "error" and not isinstance(self._future.exception(), _lost()):
                raise self._future.exception()
            self._cluster.wait_for_workers(check)
            self._future = self._begin()
        raise WorkError(
            "workers-lost",
            what=f"{TRIES} workers failed on the same task, one after the other.",
            remedy="Check their memory (see docs/how-to/cluster.md). Then start again.",
        )

    def cancel(self) -> None:
        """Cancel the work, started or not."""
        self._future.cancel()


def _lost() -> tuple[type[BaseException], ...]:
    """Dask's errors for a lost worker or its lost data."""
    from concurrent.futures import CancelledError

    from distributed import KilledWorker
    from distributed.client import FutureCancelledError, FuturesCancelledError

    return CancelledError, KilledWorker, FutureCancelledError, FuturesCancelledError, TimeoutError


@contextlib.contextmanager
def connected(address: str, *, timeout_s: float = CONNECT_S) -> Iterator[Cluster]:
    """A connection to the scheduler at ``address``, such as tcp://host:8786 or tls://host:8786.

    Raises UsageError "extra-missing" (the package distributed is not installed), "scheduler-address" or
    "workers-differ"; WorkError "scheduler-unreachable" or "no-workers".
    """
    try:
        from distributed import Client
    except ModuleNotFoundError as error:
        raise extra_missing(error.name or "") or error from error
    if not address.startswith(("tcp://", "tls://")):
        raise UsageError(
            "scheduler-address",
            what=f"{address!r} is not a scheduler's address.",
            remedy="Write it as tcp://host:8786 or tls://host:8786.",
        )
    try:
        client: Any = Client(address, timeout=timeout_s, set_as_default=False, name="velatura")  # type: ignore[no-untyped-call]
    except (OSError, ValueError, TypeError, TimeoutError) as error:
        raise WorkError(
            "scheduler-unreachable",
            what=f"No scheduler answers at {address} ({str(error).splitlines()[0] if str(error) else 'no answer'}).",
            remedy="Start it with `dask scheduler`, correct the address, or check Dask's TLS settings.",
        ) from error
    try:
        cluster = Cluster(client, address)
        cluster.check_code()
        yield cluster
    finally:
        client.close()
