"""Libraries in C that may crash or hang, in a process of their own: the camera on the controller's side, and the
process' loop with a worker that keeps one device open.

A request is (name of a method of the worker, its arguments). The answer is ``Failed``, or (result, the device's serial
number, seconds that the library took).
"""

from __future__ import annotations

import contextlib
import signal
import socket
import subprocess
import sys
import threading
import time
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Final, Generic, Protocol, Self, TypeVar

import hal.errors
from hal.deadline import SLICE_S, Deadline, turn
from hal.errors import DeviceError, DeviceGone, DeviceTimeout
from hal.notices import Notice
from hal.values import CameraCapabilities, CameraStatus, CapturedFile, DeviceIdentity, ExposureSettings

_END_S: Final = 0.7
CRASHED: Final = "camera-library-ended"


@dataclass(frozen=True, slots=True)
class Failed:
    """An error of the worker: its class in ``hal.errors``, and its texts. ``lost``: opening again may help."""

    kind: str
    code: str
    what: str
    remedy: str
    lost: bool

    @classmethod
    def of(cls, error: DeviceError, *, lost: bool = False) -> Self:
        return cls(type(error).__name__, error.code, error.what, error.remedy, lost)

    def error(self) -> DeviceError:
        kind: type[DeviceError] = getattr(hal.errors, self.kind)
        return kind(self.code, what=self.what, remedy=self.remedy)


Answer = Failed | tuple[Any, str, float]


def shot_lost(error: DeviceError) -> DeviceGone:
    """The error of a picture during which the camera was lost by ``error``."""
    return DeviceGone(
        "camera-shot-lost",
        what=f"The connection to the camera was lost during a picture: {error.what}",
        remedy="Check cable and power, then take this picture again. It was not taken twice.",
    )


class LibraryProcess:
    """Starts the process when it is needed, and again after it ended or was killed. One caller at a time.

    ``module``: whose ``main`` runs ``served``; ``library``: its name for people; ``start``: what the worker gets first
    in addition to the serial number that the camera must have, "" for any; ``note`` is called after a fault that was
    corrected. ``took_s``: what the library needed for the last request, without the way there and back.
    """

    def __init__(
        self, module: str, library: str, *, start: tuple[Any, ...], serial: str, note: Callable[[Notice], object]
    ) -> None:
        self.took_s = 0.0
        self._module = module
        self._library = library
        self._start = start
        self._serial = serial
        self._note = note
        self._turn = threading.Lock()
        self._running: tuple[subprocess.Popen[bytes], Connection] | None = None
        self._closed = False

    @property
    def pid(self) -> int | None:
        """Of the process, while it runs."""
        running = self._running
        return None if running is None else running[0].pid

    def request(self, name: str, *arguments: Any, deadline: Deadline, repeatable: bool = True) -> Any:
        """Do a request. One that is ``repeatable`` is done again if the camera was lost or the library crashed.

        Raises what the worker raises, DeviceGone if the process ended, DeviceTimeout or Cancelled: a request that takes
        too long is ended by killing the process.
        """
        with turn(self._turn, deadline, partial(self._still_time, deadline)):
            answer = self._answer(name, arguments, deadline)
            if isinstance(answer, Failed) and answer.lost and repeatable:
                self._note(Notice.warning(answer.code, answer.what))
                answer = self._answer(name, arguments, deadline)
            if isinstance(answer, Failed):
                raise answer.error()
            result, self._serial, self.took_s = answer
            return result

    def close(self) -> None:
        """End the process; a hanging one is killed after 0.7 s."""
        self._closed = True
        running, self._running = self._running, None
        if running is None:
            return
        process, connection = running
        with contextlib.suppress(OSError):
            connection.close()
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(_END_S)
        _kill(process)

    def _answer(self, name: str, arguments: tuple[Any, ...], deadline: Deadline) -> Answer:
        self._still_time(deadline)
        process, connection = self._started()
        try:
            connection.send((name, arguments))
            while not connection.poll(min(SLICE_S, deadline.left_s())):
                self._still_time(deadline)
            answer: Answer = connection.recv()
            return answer
        except (EOFError, OSError):
            self._stop()
            self._check_open()
            return Failed.of(self._ended(process.returncode), lost=True)
        except BaseException:
            # Its answer would be taken for the next one's.
            self._stop()
            raise

    def _started(self) -> tuple[subprocess.Popen[bytes], Connection]:
        self._check_open()
        if self._running is None:
            ours, theirs = socket.socketpair()
            with theirs:
                process = subprocess.Popen(  # noqa: S603 - this Python, with a module of ours
                    [sys.executable, "-m", self._module, str(theirs.fileno())],
                    pass_fds=[theirs.fileno()],
                    stdin=subprocess.DEVNULL,
                )
            self._running = process, Connection(ours.detach())
            self._running[1].send((*self._start, self._serial))
        return self._running

    def _stop(self) -> None:
        running, self._running = self._running, None
        if running is not None:
            _kill(running[0])
            running[1].close()

    def _check_open(self) -> None:
        if self._closed:
            raise DeviceGone("camera-closed", what="The camera was closed.", remedy="Open the camera again.")

    def _ended(self, code: int) -> DeviceGone:
        how = f"signal {-code}" if code < 0 else f"exit code {code}"
        return DeviceGone(
            CRASHED,
            what=f"The process of {self._library} ended by itself ({how}).",
            remedy="Switch the camera off and on, then try again. If it happens again, use another driver for it.",
        )

    def _still_time(self, deadline: Deadline) -> None:
        deadline.check(
            "camera-no-answer",
            what=f"The camera did not answer {self._library} in time.",
            remedy="Check that it is awake. If it does not answer, switch it off and on.",
        )


class LibraryWorker(Protocol):
    """The library's side: does one request after the other."""

    def answer(self, name: str, arguments: tuple[Any, ...]) -> Answer: ...

    def close(self) -> None: ...


def served(make: Callable[..., LibraryWorker]) -> int:
    """The process: ``make`` gets what ``start`` holds, then the serial number. Ends when the controller does."""
    # Ctrl-C goes to every process of the terminal; this one ends when its controller closes the socket.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with Connection(int(sys.argv[1])) as connection:
        worker = make(*connection.recv())
        with contextlib.suppress(EOFError, OSError):
            while True:
                connection.send(worker.answer(*connection.recv()))
        worker.close()
    return 0


def _kill(process: subprocess.Popen[bytes]) -> None:
    process.kill()
    process.wait()


class Closable(Protocol):
    """What a library opens."""

    def close(self) -> None: ...


Device = TypeVar("Device", bound=Closable)


class DeviceWorker(ABC, Generic[Device]):
    """Its public methods are the requests. The device is opened at the first of them, and again when it was lost.

    ``_serial``: the serial number that the device must have, "" for any
    """

    def __init__(self, serial: str) -> None:
        self._serial = serial
        self._device: Device | None = None

    @abstractmethod
    def _open_device(self) -> Device:
        """The device, just opened."""

    def _prepare(self, device: Device) -> None:
        """Make an opened device ready for requests; it is closed if this raises."""

    def _do(self, name: str, arguments: tuple[Any, ...]) -> Any:
        """The result of a request. Raises DeviceError: a library's own errors are translated here."""
        return getattr(self, name)(*arguments)

    def answer(self, name: str, arguments: tuple[Any, ...]) -> Answer:
        """Do a request. A lost device is closed, so that the next request opens it again."""
        began_s = time.monotonic()
        try:
            result = self._do(name, arguments)
        except DeviceError as error:
            lost = isinstance(error, DeviceGone | DeviceTimeout) and self._device is not None
            if lost:
                self.close()
            return Failed.of(error, lost=lost)
        return result, self._serial, time.monotonic() - began_s

    def close(self) -> None:
        device, self._device = self._device, None
        if device is not None:
            device.close()

    def _open(self) -> Device:
        if self._device is None:
            device = self._open_device()
            try:
                self._prepare(device)
            except BaseException:
                device.close()
                raise
            self._device = device
        return self._device


_MOST_NOTICES: Final = 1000
_MARGIN_S: Final = 1.0


class LibraryCamera:
    """``hal.interfaces.WatchedCamera`` on a ``LibraryProcess``.

    The worker has the methods ``capabilities``, ``identity``, ``configure`` and ``capture``, and sets its exposure
    again when it opens the camera again. ``module``, ``library``, ``start``, ``serial``: as for ``LibraryProcess``.
    """

    def __init__(self, module: str, library: str, *, start: tuple[Any, ...], serial: str, deadline: Deadline) -> None:
        self._notices: deque[Notice] = deque(maxlen=_MOST_NOTICES)
        self.process = LibraryProcess(module, library, start=start, serial=serial, note=self._notices.append)
        self._settings: ExposureSettings | None = None
        self._configured: int | None = None
        """The process that has these settings."""
        try:
            self._capabilities: CameraCapabilities = self.process.request("capabilities", deadline=deadline)
        except BaseException:
            self.close()
            raise

    @property
    def capabilities(self) -> CameraCapabilities:
        return self._capabilities

    def identity(self, *, deadline: Deadline) -> DeviceIdentity:
        identity: DeviceIdentity = self.process.request("identity", deadline=deadline)
        return identity

    def status(self, *, deadline: Deadline) -> CameraStatus:
        """It has neither battery nor card; raises DeviceGone where it is not there."""
        self.identity(deadline=deadline)
        return CameraStatus()

    def notices(self) -> list[Notice]:
        return [self._notices.popleft() for _ in range(len(self._notices))]

    def configure(self, settings: ExposureSettings, *, deadline: Deadline) -> ExposureSettings:
        confirmed: ExposureSettings = self.process.request("configure", settings, deadline=deadline)
        self._settings, self._configured = confirmed, self.process.pid
        return confirmed

    def capture(self, destination: Path, *, deadline: Deadline) -> list[CapturedFile]:
        """See ``hal.interfaces.Camera.capture``. Raises DeviceGone("camera-shot-lost") where the process ended."""
        try:
            if self._settings is not None and self.process.pid != self._configured:
                # The process was ended, perhaps also started again by another request: its exposure is forgotten.
                self.configure(self._settings, deadline=deadline)
            left_s = deadline.left_s()
            # The worker ends before the caller does: it knows why no picture came.
            theirs_s = left_s - min(_MARGIN_S, left_s / 5)
            files: list[CapturedFile] = self.process.request(
                "capture", destination.absolute(), theirs_s, deadline=deadline, repeatable=False
            )
        except DeviceGone as error:
            if error.code != CRASHED:
                raise
            raise shot_lost(error) from error
        return files

    def close(self) -> None:
        self.process.close()
