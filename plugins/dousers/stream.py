"""One sACN stream for each universe, shared by its dousers: two sources of one universe would be merged by the node."""

from __future__ import annotations

import contextlib
import json
import subprocess
import sys
import threading
from dataclasses import asdict, dataclass
from functools import partial
from typing import IO, Final

from hal.deadline import SLICE_S, Deadline, turn
from hal.errors import DeviceGone


@dataclass(frozen=True, slots=True)
class Target:
    """Where the stream goes. ``multicast``: to the universe's group; then ``interface`` is an own IPv4 address or "".

    ``identity``: the source's 16 bytes, in hex, the same after a restart.
    """

    host: str
    port: int
    universe: int
    priority: int
    multicast: bool
    interface: str
    identity: str


_END_S: Final = 0.7
_STARTED_S: Final = 5.0
_SKIPPED: Final = 64


class Stream:
    """The process that sends a universe, started when a level is put, and again after it ended by itself.

    Levels stay when a douser leaves. The stream ends with the last one.
    """

    def __init__(self, target: Target) -> None:
        self._target = target
        self._name = f"The sACN stream of universe {target.universe}"
        self._levels: dict[int, int] = {}
        self._number = 0
        self._running: _Running | None = None
        self._turn = threading.Lock()
        self._over = False

    def put(self, channel: int, level: int, *, deadline: Deadline) -> None:
        """Send ``level`` (0 to 255) from now on; returns when it was sent three times.

        Raises DeviceGone("douser-gone") if packets do not go out; the level is still sent again and again. Raises
        DeviceTimeout("douser-no-answer") and Cancelled.
        """
        with turn(self._turn, deadline, partial(self._check, deadline)):
            self._check(deadline)
            self._levels[channel] = level
            self._number += 1
            self._publish_levels()
            self._await_sent(deadline)

    def verify(self, *, deadline: Deadline) -> None:
        """Raise as ``put`` if packets do not go out now. No effect before the first level."""
        with turn(self._turn, deadline, partial(self._check, deadline)):
            self._check(deadline)
            if not self._levels:
                return
            if self._running is None or self._running.ended:
                self._publish_levels()
            self._await_sent(deadline)

    def end(self) -> None:
        """End the stream for good, and tell its receivers: at most 2 s. Harmless when called twice."""
        self._over = True  # a movement that still waits ends soon, and starts no other process
        with self._turn:
            self._end_process()

    def _end_process(self) -> None:
        running, self._running = self._running, None
        if running is not None:
            running.end()

    def _publish_levels(self) -> None:
        line = {"number": self._number, "levels": self._levels}
        before = self._running
        if before is not None and before.write(line):
            return
        self._end_process()
        # Receivers drop packets whose number is up to 20 behind: the new process starts well ahead of the old one.
        self._running = _Running(self._target, 0 if before is None else (before.sequence + _SKIPPED) % 256)
        self._running.write(line)

    def _await_sent(self, deadline: Deadline) -> None:
        running, again = self._process(), True
        patience = deadline.within(_STARTED_S)
        while running.sent < self._number:
            if running.ended and again:
                # It ended in the moment in which it was written to.
                again = False
                self._check(deadline)
                self._publish_levels()
                running = self._process()
                continue
            if running.ended or patience.passed:
                self._check(deadline)
                raise self._gone("the process that sends it does not run")
            running.news.wait(min(SLICE_S, patience.left_s()))
            running.news.clear()
            self._check(deadline)
        if running.trouble:
            raise self._gone(running.trouble)

    def _process(self) -> _Running:
        assert self._running is not None
        return self._running

    def _check(self, deadline: Deadline) -> None:
        if self._over:
            raise DeviceGone("douser-closed", what=f"{self._name} was ended.", remedy="Open the stage again.")
        deadline.check(
            "douser-no-answer",
            what=f"{self._name} was not sent in time.",
            remedy="Check the load of this computer, and try again.",
        )

    def _gone(self, why: str) -> DeviceGone:
        where = "all receivers" if self._target.multicast else f"{self._target.host}:{self._target.port}"
        return DeviceGone(
            "douser-gone",
            what=f"{self._name} does not reach {where} ({why}).",
            remedy="Check the node's power, its network cable, its address, and the network of this computer.",
        )


class _Running:
    """The process. ``sent``, ``sequence``, ``trouble``: what it said last; ``news`` is set when it said something.

    ``sequence``: of the packet before its first one.
    """

    def __init__(self, target: Target, sequence: int) -> None:
        self.sent, self.sequence, self.trouble = 0, sequence, ""
        self.news = threading.Event()
        self._process = subprocess.Popen(
            [sys.executable, "-m", "plugins.dousers.sender"], stdin=subprocess.PIPE, stdout=subprocess.PIPE
        )
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._input: IO[bytes] = self._process.stdin
        self._thread = threading.Thread(target=self._read, args=(self._process.stdout,), name="sacn", daemon=True)
        self._thread.start()
        self.write({"target": asdict(target), "sequence": sequence})

    @property
    def ended(self) -> bool:
        return self._process.poll() is not None

    def write(self, line: object) -> bool:
        """Whether the process took it."""
        try:
            self._input.write((json.dumps(line) + "\n").encode())
            self._input.flush()
        except (OSError, ValueError):
            return False
        return True

    def end(self) -> None:
        """Close its input: it ends the stream. One that hangs is killed."""
        with contextlib.suppress(OSError):
            self._input.close()
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(_END_S)
        self._process.kill()
        self._process.wait()
        self._thread.join(_END_S)

    def _read(self, output: IO[bytes]) -> None:
        with output:
            for line in output:
                said = json.loads(line)
                self.sequence, self.trouble, self.sent = said["sequence"], said["trouble"], said["sent"]
                self.news.set()
        self.news.set()


_STREAMS: Final[dict[Target, tuple[Stream, int]]] = {}
_LOCK: Final = threading.Lock()


def joined(target: Target) -> Stream:
    """The stream to ``target``, for one more user, who calls ``left`` once."""
    with _LOCK:
        stream, users = _STREAMS.get(target, (None, 0))
        stream = stream or Stream(target)
        _STREAMS[target] = stream, users + 1
        return stream


def left(target: Target) -> None:
    """One user less. After the last one the stream ends, before another user of this universe can start one."""
    with _LOCK:
        stream, users = _STREAMS.pop(target)
        if users > 1:
            _STREAMS[target] = stream, users - 1
        else:
            stream.end()
