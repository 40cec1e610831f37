"""Solves on many machines with Dask: the workers' tasks, and the connection to the scheduler.

Tasks are plain functions of plain values, sent by name. A worker is a process with this release installed. It runs one
task at a time, because the compiled kernels use all of its cores. A task whose worker fails is started again.

Dask's protocol unpickles the data of its peers: a scheduler and its workers can run any code here, and the other way
round. So they need their own network, or TLS with certificates on both sides (address ``tls://``): those of a house
(``controller.stage.link.peers``), or the files in Dask's configuration, ``distributed.comm.tls``.
"""

from __future__ import annotations

import contextlib
import hashlib
import secrets
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Final, Generic, TypeVar
from weakref import WeakKeyDictionary

import numpy as np

from controller.core.arrays import FloatImage
from controller.core.errors import UsageError, WorkError
from controller.core.extras import extra_missing
from controller.optics.solve.appearance import StageLight
from controller.optics.solve.bounded.engine import SolveContext
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


@dataclass(frozen=True, slots=True, eq=False, weakref_slot=True)
class StageData:
    """Data for all appearances of a stage; a worker gets it once.

    ``black``: K; ``indirect``: G, where there is one
    """

    transport: LightTransport
    black: FloatImage
    indirect: ReflectedLight | None = None


_kept: Final[WeakKeyDictionary[StageData, DriveLevels]] = WeakKeyDictionary()


def make_there(stage: StageData, asked: Target, options: SolveOptions) -> AppearanceResult:
    """An appearance from ``solve.request.solve_appearance``."""
    with _RUNNING:
        if stage not in _kept:
            _kept.clear()  # keep one stage only: it fills a worker's memory
            _kept[stage] = DriveLevels.of_transport(stage.transport)
        light = StageLight(stage.transport, stage.black, stage.indirect, _kept[stage])
        engine = choose_engine("cpu", lambda note: None)
        return solve_appearance(light, asked, options, SolveContext(engine))


@cache
def code_digest() -> str:
    """A hash of this process's code that affects results; it must be the same on all machines."""
    hashed = hashlib.sha256(np.__version__.encode())
    folder = Path(__file__).resolve().parents[2]
    for name in _CODE:
        path = folder / name
        for file in sorted(path.rglob("*.py")) if path.is_dir() else [path]:
            hashed.update(file.relative_to(folder).as_posix().encode() + file.read_bytes())
    return hashed.hexdigest()


code_digest()  # the files may be replaced later

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
        self.client = client
        self._address = address

    @property
    def workers(self) -> int:
        """Number of workers now."""
        info: dict[str, Any] = self.client.scheduler_info(n_workers=-1)
        return len(info["workers"])

    def submit(self, function: Callable[..., Value], *arguments: Any) -> Task[Value]:
        """Start ``function(*arguments)`` on a worker; ``Shared`` arguments arrive there as their values."""
        return Task(self, lambda: self.client.submit(function, *map(self._placed, arguments), pure=False, retries=0))

    def _placed(self, shared: Any) -> Any:
        """The data in the cluster; sent again if its worker is gone."""
        if not isinstance(shared, Shared):
            return shared
        if shared.future is None or shared.future.status != "finished":
            self.wait_for_workers(lambda: None)
            # Never twice under one name: a worker that still asks a lost worker for the data would drop the new copy,
            # the scheduler would believe that the worker has it, and its tasks would wait for ever.
            name = f"velatura-stage-{secrets.token_hex(8)}"
            (shared.future,) = self.client.scatter({name: shared.value}, hash=False).values()
        return shared.future

    def wait_for_workers(self, check: Callable[[], None], within_s: float | None = None) -> None:
        """Return once there is a worker.

        Raises WorkError("no-workers") after ``WORKERS_S``, or ``within_s``, without one, and what ``check`` raises.
        """
        most_s = WORKERS_S if within_s is None else within_s
        began_s = time.monotonic()
        while self.workers == 0:
            check()
            if time.monotonic() - began_s >= most_s:
                raise WorkError(
                    "no-workers",
                    what=f"The scheduler at {self._address} has had no worker for {most_s:g} seconds.",
                    remedy="Start workers (docs/how-to/cluster.md), or solve without --scheduler.",
                )
            time.sleep(POLL_S)

    def check_code(self, within_s: float | None = None) -> None:
        """Raise UsageError("workers-differ") unless every worker has the same code as this process, and WorkError
        as ``wait_for_workers``.
        """
        ours = code_digest()
        self.wait_for_workers(lambda: None, within_s)
        theirs = self.client.run(code_digest, on_error="return")
        other = [address for address, digest in theirs.items() if digest != ours]
        if other:
            raise UsageError(
                "workers-differ",
                what=f"{len(other)} of {len(theirs)} workers have another release of Velatura, or none: {other[0]}.",
                remedy="Install this release on every machine, and start its workers again.",
            )


class Shared:
    """Data for many tasks of one ``Cluster``; each worker gets it once, at its first use."""

    def __init__(self, value: Any) -> None:
        self.value = value
        self.future: Any = None


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
                with contextlib.suppress(*lost()):
                    value: Value = self._future.result(timeout=WORKERS_S)
                    return value
            elif self._future.status == "error" and not isinstance(self._future.exception(), lost()):
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


def lost() -> tuple[type[BaseException], ...]:
    """Dask's errors for a lost worker or its lost data."""
    from concurrent.futures import CancelledError

    from distributed import KilledWorker
    from distributed.client import FutureCancelledError, FuturesCancelledError

    return CancelledError, KilledWorker, FutureCancelledError, FuturesCancelledError, TimeoutError


@contextlib.contextmanager
def connected(
    address: str, *, timeout_s: float = CONNECT_S, workers_s: float | None = None, tls: Sequence[Path] = ()
) -> Iterator[Cluster]:
    """A connection to the scheduler at ``address``, such as tcp://host:8786 or tls://host:8786.

    ``workers_s``: how long to wait for a first worker; ``tls``: authority, certificate and key; none: as Dask is set

    Raises UsageError "extra-missing" (the package distributed is not installed), "scheduler-address" or
    "workers-differ"; WorkError "scheduler-unreachable" or "no-workers".
    """
    try:
        from distributed import Client
        from distributed.security import Security
    except ModuleNotFoundError as error:
        raise extra_missing(error.name or "") or error from error
    if not address.startswith(("tcp://", "tls://")):
        raise UsageError(
            "scheduler-address",
            what=f"{address!r} is not a scheduler's address.",
            remedy="Write it as tcp://host:8786 or tls://host:8786.",
        )
    files = dict(zip(("tls_ca_file", "tls_client_cert", "tls_client_key"), map(str, tls), strict=False))
    given = {"security": Security(require_encryption=True, **files)} if files else {}  # type: ignore[no-untyped-call]
    try:
        client: Any = Client(address, timeout=timeout_s, set_as_default=False, name="velatura", **given)  # type: ignore[no-untyped-call]
    except (OSError, ValueError, TypeError, TimeoutError) as error:
        raise WorkError(
            "scheduler-unreachable",
            what=f"No scheduler answers at {address} ({str(error).splitlines()[0] if str(error) else 'no answer'}).",
            remedy="Start it with `dask scheduler`, correct the address, or check Dask's TLS settings.",
        ) from error
    try:
        cluster = Cluster(client, address)
        cluster.check_code(workers_s)
        yield cluster
    finally:
        client.close()
