"""The kiosk's socket (mode 0600): the command line talks to a running kiosk in JSON lines, as it does to the player."""

from __future__ import annotations

import base64
import contextlib
import json
import pwd
import socket
import struct
import threading
from collections.abc import Callable, Mapping
from dataclasses import asdict, is_dataclass
from pathlib import Path
from typing import Any, Final

from controller.core.errors import SEND_DIAGNOSTICS, UsageError, VelaturaError
from controller.core.storage import listening, runtime_path
from controller.kiosk.operations.dispatch import CALLER
from hal.errors import CodedError

NAME: Final = "kiosk.sock"
LONGEST_LINE: Final = 1 << 20
MOST_CONNECTIONS: Final = 16
AGAIN_S: Final = 1.0
"""Pause after a failed accept: too many open files is a passing state, and this thread is not restarted."""
Operation = Callable[..., Any]


class ControlServer:
    """Serves ``operations`` by name; the request's other keys are the arguments. Use as a context manager."""

    def __init__(self, path: Path, operations: Mapping[str, Operation]) -> None:
        self._operations = dict(operations)
        self._path = path
        self._ended = threading.Event()
        self._places = threading.BoundedSemaphore(MOST_CONNECTIONS)
        self._listener = listening(path, MOST_CONNECTIONS)  # the stage's lock ensures that this is the only server
        self._thread = threading.Thread(target=self._accept, name="control", daemon=True)
        self._thread.start()

    def __enter__(self) -> ControlServer:
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._path.unlink(missing_ok=True)
        with contextlib.suppress(OSError):
            self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()

    def _accept(self) -> None:
        while not self._ended.is_set():
            try:
                channel, _ = self._listener.accept()
            except OSError:
                self._ended.wait(AGAIN_S)
                continue
            if not self._places.acquire(blocking=False):
                channel.close()
                continue
            threading.Thread(target=self._serve, args=(channel,), name="control-client", daemon=True).start()

    def _serve(self, channel: socket.socket) -> None:
        try:
            CALLER.set(_user_of(channel))
            with channel, channel.makefile("rwb") as lines:
                while line := lines.readline(LONGEST_LINE + 1):
                    lines.write(json.dumps(self._answer(line)).encode() + b"\n")
                    lines.flush()
                    if not line.endswith(b"\n"):
                        return
        except OSError:
            return
        finally:
            self._places.release()

    def _answer(self, line: bytes) -> dict[str, Any]:
        try:
            request = json.loads(line)
            operation = self._operations[request.pop("op")]
        except (ValueError, KeyError, AttributeError, TypeError, RecursionError):
            return _error("request-wrong", "The request is unknown.", "See docs/reference/http-api.md.")
        try:
            return {"ok": True, "result": plain(operation(**request))}
        except CodedError as error:
            return _error(error.code, error.what, error.remedy)
        except TypeError as error:
            return _error(
                "request-wrong", f"The arguments of the request are wrong: {error}.", "See docs/reference/http-api.md."
            )
        except OSError as error:
            return _error("cannot-write", f"A file could not be used: {error}.", "Check the disk and its free space.")
        except Exception as error:  # noqa: BLE001 - the last boundary of this thread: it answers and continues
            what = f"The kiosk met an unexpected error ({type(error).__name__}: {error})."
            return _error("crash", what, SEND_DIAGNOSTICS)


def _user_of(channel: socket.socket) -> str:
    """The user whose program is at the other end, as ``user_name`` says it."""
    _, uid, _ = struct.unpack("3i", channel.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, 12))
    return user_name(uid)


def user_name(uid: int) -> str:
    """The name of a user, or the number of one without a name."""
    try:
        return pwd.getpwuid(uid).pw_name
    except KeyError:
        return str(uid)


def _error(code: str, what: str, remedy: str) -> dict[str, Any]:
    return {"ok": False, "error": {"code": code, "what": what, "remedy": remedy}}


def plain(value: Any) -> Any:
    """As JSON: dataclasses become objects, paths strings, tuples lists, and bytes base64."""
    if is_dataclass(value) and not isinstance(value, type):
        return plain(asdict(value))
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple | set | frozenset):
        return [plain(item) for item in value]
    if isinstance(value, bytes):
        return base64.b64encode(value).decode()
    return value if isinstance(value, str | int | float | bool | None) else str(value)


def is_running(stage: Path) -> bool:
    """Whether a kiosk serves this stage."""
    with contextlib.suppress(OSError, UsageError), _connected(stage, 2.0):
        return True
    return False


def call_kiosk(stage: Path, op: str, *, timeout_s: float = 30.0, **arguments: Any) -> Any:
    """Send a request to the running kiosk of ``stage`` and return its result.

    Raises UsageError("not-serving") if none runs, and VelaturaError with the kiosk's own code and sentences.
    """
    try:
        with _connected(stage, timeout_s) as channel, channel.makefile("rwb") as lines:
            lines.write(json.dumps({"op": op, **arguments}).encode() + b"\n")
            lines.flush()
            answer = json.loads(lines.readline() or b"{}")
    except (OSError, ValueError) as error:
        raise UsageError(
            "not-serving",
            what="No kiosk runs on this stage, or it does not answer.",
            remedy="Start it with `velatura kiosk serve`.",
        ) from error
    if not answer.get("ok"):
        problem = answer.get("error") or {
            "code": "not-serving",
            "what": "The kiosk stopped before it answered.",
            "remedy": "Start it again.",
        }
        raise VelaturaError(problem["code"], what=problem["what"], remedy=problem["remedy"])
    return answer["result"]


def _connected(stage: Path, timeout_s: float) -> socket.socket:
    channel = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        channel.settimeout(timeout_s)
        channel.connect(str(runtime_path(stage.resolve()) / NAME))
    except OSError:
        channel.close()
        raise
    return channel
