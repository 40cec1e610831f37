"""A HID device through hidapi, which may hang, and which may lose its device: deadlines, and finding it again.

hidapi's calls run on a thread of their own. A call that outlives its deadline is left behind with its thread; the next
one waits for that thread to end before it opens the device anew, so that at most one is ever left behind.
"""

from __future__ import annotations

import importlib
import queue
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, Generic, Protocol, TypeVar

from hal.deadline import Deadline
from hal.errors import DeviceError, DeviceGone, DeviceRefused, PluginError, ProtocolError
from hal.ptp import printable

Result = TypeVar("Result")

BACKENDS: Final = {"hidraw": "hidraw", "libusb": "hid"}
"""hidapi's modules: ``hidraw`` leaves the kernel's driver in place, ``hid`` goes round it through libusb."""
_SLICE_S: Final = 0.05
_CLOSE_S: Final = 0.7
_LONGEST_NAME: Final = 126


class HidHandle(Protocol):
    """What is used of ``hid.device``. Every call raises OSError or ValueError where it fails."""

    def open_path(self, path: bytes) -> None: ...
    def close(self) -> None: ...
    def get_feature_report(self, number: int, length: int) -> list[int]: ...
    def get_input_report(self, number: int, length: int) -> list[int]: ...
    def send_feature_report(self, data: Sequence[int]) -> int: ...


@dataclass(frozen=True, slots=True)
class HidFound:
    """A device as hidapi lists it; the names come from the device and are made printable."""

    path: bytes
    maker: str
    product: str
    serial: str


@dataclass(frozen=True, slots=True)
class HidKind:
    """What to look for. ``name`` is for sentences, e.g. "relay board".

    ``suits`` sorts out other devices with the same numbers; ``serial_of`` says the serial number of an open one.
    """

    name: str
    vendor: int
    product: int
    suits: Callable[[HidFound], bool] = lambda found: True
    serial_of: Callable[[HidHandle, HidFound], str] = lambda handle, found: found.serial


@dataclass(frozen=True, slots=True)
class OpenHid:
    """The device that is open now."""

    handle: HidHandle
    found: HidFound
    serial: str


@dataclass(slots=True)
class _Job(Generic[Result]):
    work: Callable[[_Worker], Result]
    done: threading.Event = field(default_factory=threading.Event)
    result: list[Result] = field(default_factory=list)
    error: BaseException | None = None


class _Worker:
    """One thread, and the device that it has open. Whatever becomes of it, it closes what it opened."""

    def __init__(self) -> None:
        self.open: OpenHid | None = None
        self._jobs: queue.SimpleQueue[_Job[Any] | None] = queue.SimpleQueue()
        self.thread = threading.Thread(target=self._run, name="hid", daemon=True)
        self.thread.start()

    def start(self, job: _Job[Any]) -> None:
        self._jobs.put(job)

    def end(self) -> None:
        self._jobs.put(None)

    def drop(self) -> None:
        """Close the device. On the worker's thread."""
        was_open, self.open = self.open, None
        if was_open is not None:
            was_open.handle.close()

    def _run(self) -> None:
        while (job := self._jobs.get()) is not None:
            try:
                job.result.append(job.work(self))
            except BaseException as error:  # noqa: BLE001 - it is raised again by whoever waits for the job
                job.error = error
            job.done.set()
        self.drop()


class HidLink:
    """The way to one HID device; opens it when needed, and again after it was unplugged. For one thread at a time.

    ``serial``: it must have this serial number; "" takes the only one there is, and stays with it.
    """

    def __init__(self, kind: HidKind, *, serial: str = "", backend: str = "hidraw") -> None:
        self._kind = kind
        self._serial = serial
        self._module = _hidapi(backend)
        self._worker: _Worker | None = None
        self._left_behind: _Worker | None = None
        self._closed = False

    def call(self, work: Callable[[OpenHid], Result], *, deadline: Deadline) -> Result:
        """Do ``work`` with the open device; once more where the connection had broken, so it must bear repetition.

        Raises DeviceGone, DeviceTimeout, DeviceRefused (several of them, or no permission), ProtocolError where the
        device is there and fails the transfer, or Cancelled.
        """
        self._still_time(deadline)
        if self._closed:
            raise DeviceGone(
                "hid-closed", what=f"The {self._kind.name} was closed.", remedy=f"Open the {self._kind.name} again."
            )

        def done(worker: _Worker) -> Result:
            for again in (False, True):
                if worker.open is None:
                    worker.open = self._find()
                try:
                    return work(worker.open)
                except (OSError, ValueError) as error:
                    worker.drop()
                    if again:
                        raise self._failed(error) from error
                except ProtocolError:
                    worker.drop()
                    raise
            raise AssertionError

        return self._on_worker(done, deadline)

    def close(self) -> None:
        """Close the device; a call that hangs is left behind after 0.7 s."""
        self._closed = True
        worker, self._worker = self._worker, None
        if worker is not None:
            worker.end()
            worker.thread.join(_CLOSE_S)

    def _on_worker(self, work: Callable[[_Worker], Result], deadline: Deadline) -> Result:
        if self._left_behind is not None:
            self._wait(lambda seconds: self._left_behind is None or _ended(self._left_behind, seconds), deadline)
            self._left_behind = None
        worker = self._worker = self._worker or _Worker()
        job: _Job[Result] = _Job(work)
        worker.start(job)
        try:
            self._wait(job.done.wait, deadline)
        except DeviceError:
            if not job.done.is_set():
                worker.end()
                self._left_behind, self._worker = worker, None
            raise
        if job.error is not None:
            raise job.error
        return job.result[0]

    def _wait(self, ready: Callable[[float], bool], deadline: Deadline) -> None:
        while not ready(min(_SLICE_S, deadline.left_s())):
            self._still_time(deadline)

    def _still_time(self, deadline: Deadline) -> None:
        deadline.check(
            "hid-no-answer",
            what=f"The {self._kind.name} did not answer in time.",
            remedy="Unplug it and plug it in again; use another cable or hub if it happens often.",
        )

    def _find(self) -> OpenHid:
        """Find and open the device. On the worker's thread."""
        matching = self._matching()
        if len(matching) == 1:
            self._serial = matching[0].serial
            return matching[0]
        for one in matching:
            one.handle.close()
        if matching:
            raise DeviceRefused(
                "hid-several",
                what=f"There are {len(matching)} devices that could be the {self._kind.name}"
                f" ({', '.join(one.serial or 'no serial number' for one in matching)}).",
                remedy="Write the serial number of the right one into stage.toml, or unplug the others.",
            )
        which = f" with serial number {self._serial}" if self._serial else ""
        raise DeviceGone(
            "hid-unplugged",
            what=f"No {self._kind.name}{which} is plugged in ({self._kind.vendor:04x}:{self._kind.product:04x}).",
            remedy="Check its cable and its hub; it is used again as soon as it is there.",
        )

    def _matching(self) -> list[OpenHid]:
        opened: list[OpenHid] = []
        for found in self._listed():
            handle: HidHandle = self._module.device()
            try:
                handle.open_path(found.path)
                serial = self._kind.serial_of(handle, found)
            except (OSError, ValueError) as error:
                handle.close()
                if not any(other.path == found.path for other in self._listed()):
                    continue  # it has just left
                raise self._not_opened(error) from error
            except BaseException:
                handle.close()
                raise
            if self._serial and serial != self._serial:
                handle.close()
                continue
            opened.append(OpenHid(handle, found, serial))
        return opened

    def _listed(self) -> list[HidFound]:
        """Each device once, though hidapi lists one for every usage."""
        entries = self._module.enumerate(self._kind.vendor, self._kind.product)
        by_path = {entry["path"]: entry for entry in entries}
        found = [
            HidFound(path, *(_name(entry[key]) for key in ("manufacturer_string", "product_string", "serial_number")))
            for path, entry in by_path.items()
        ]
        return [one for one in found if self._kind.suits(one)]

    def _not_opened(self, error: Exception) -> DeviceRefused:
        return DeviceRefused(
            "hid-not-opened",
            what=f"The {self._kind.name} is plugged in, but cannot be opened ({error}).",
            remedy="End other programs that use it, and install firmware_configs/udev/70-velatura-hid.rules.",
        )

    def _failed(self, error: Exception) -> ProtocolError:
        return ProtocolError(
            "hid-transfer",
            what=f"The {self._kind.name} is plugged in, but refuses what it is asked ({error}).",
            remedy="Unplug it and plug it in again; if it happens again, replace it.",
        )


def _ended(worker: _Worker, seconds: float) -> bool:
    worker.thread.join(seconds)
    return not worker.thread.is_alive()


def _name(text: object) -> str:
    return printable(str(text or "")[:_LONGEST_NAME])


def _hidapi(backend: str) -> Any:
    if backend not in BACKENDS:
        raise PluginError(
            "setting-wrong",
            what=f"The setting 'backend' is {backend!r}.",
            remedy=f"Write one of these for backend in stage.toml: {', '.join(BACKENDS)}.",
        )
    try:
        return importlib.import_module(BACKENDS[backend])
    except ImportError as error:
        raise PluginError(
            "hidapi-missing",
            what=f"The library for HID devices could not be loaded: {error}.",
            remedy="Install the Python package hidapi (it comes with velatura[controller]).",
        ) from error
