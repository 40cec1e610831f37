"""The controller's side of the process in which libgphoto2 runs.

A request is (name of a method of ``worker.Worker``, its arguments). The answer is ``Failed``, or (result, the camera's
serial number, seconds that the library took).
"""

from __future__ import annotations

import contextlib
import socket
import subprocess
import sys
import threading
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from multiprocessing.connection import Connection
from typing import Any, Final, Self

import hal.errors
from hal.deadline import SLICE_S, Deadline, turn
from hal.errors import DeviceError, DeviceGone, PluginError

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


class LibraryProcess:
    """Starts the process when it is needed, and again after it ended or was killed. One caller at a time.

    ``port``, ``serial``: see ``plugins.gphoto2.camera``; ``note`` is called with (code, sentence) after a fault that
    was corrected. ``took_s``: what the library needed for the last request, without the way there and back.
    """

    def __init__(self, port: str, serial: str, note: Callable[[str, str], object]) -> None:
        self.took_s = 0.0
        self._port = port
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

    def ask(self, name: str, *arguments: Any, deadline: Deadline, repeatable: bool = True) -> Any:
        """Do a request. One that is ``repeatable`` is done again if the camera was lost or the library crashed.

        Raises what the worker raises, DeviceGone if the process ended, DeviceTimeout or Cancelled: a request that takes
        too long is ended by killing the process.
        """
        with turn(self._turn, deadline, partial(_still_time, deadline)):
            answer = self._answer(name, arguments, deadline)
            if isinstance(answer, Failed) and answer.lost:
                self._note(answer.code, answer.what)
                if repeatable:
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
        _still_time(deadline)
        process, connection = self._started()
        try:
            connection.send((name, arguments))
            while not connection.poll(min(SLICE_S, deadline.left_s())):
                _still_time(deadline)
            answer: Answer = connection.recv()
            return answer
        except (EOFError, OSError):
            self._stop()
            self._check_open()
            return Failed.of(_ended(process.returncode), lost=True)
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
                    [sys.executable, "-m", "plugins.gphoto2.worker", str(theirs.fileno())],
                    pass_fds=[theirs.fileno()],
                    stdin=subprocess.DEVNULL,
                )
            self._running = process, Connection(ours.detach())
            self._running[1].send((self._port, self._serial))
        return self._running

    def _stop(self) -> None:
        running, self._running = self._running, None
        if running is not None:
            _kill(running[0])
            running[1].close()

    def _check_open(self) -> None:
        if self._closed:
            raise DeviceGone("camera-closed", what="The camera was closed.", remedy="Open the camera again.")


def load_library() -> Any:
    """The wheel's module. Raises PluginError("gphoto2-missing")."""
    try:
        import gphoto2
    except ImportError as error:
        raise PluginError(
            "gphoto2-missing",
            what=f"The library for this camera is not installed ({error}).",
            remedy="Install it into Velatura's environment: pip install 'velatura[gphoto2]'.",
        ) from error
    return gphoto2


def _kill(process: subprocess.Popen[bytes]) -> None:
    process.kill()
    process.wait()


def _ended(code: int) -> DeviceGone:
    return DeviceGone(
        CRASHED,
        what=f"The process of libgphoto2 ended by itself ({f'signal {-code}' if code < 0 else f'exit code {code}'}).",
        remedy="Switch the camera off and on, then try again. If it happens again, use the driver ptp for this camera.",
    )


def _still_time(deadline: Deadline) -> None:
    deadline.check(
        "camera-no-answer",
        what="The camera did not answer libgphoto2 in time.",
        remedy="Check that it is awake. If it does not answer, switch it off and on.",
    )
