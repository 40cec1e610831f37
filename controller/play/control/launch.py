"""Starts, watches and ends a player process, for the program that supervises it. Light: no solver, no window.

On an installed kiosk systemd starts and restarts it, and the controller only connects to it (``AttachedPlayer``).
"""

from __future__ import annotations

import contextlib
import os
import select
import signal
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, Self

from controller.core.errors import WorkError
from controller.core.storage import write_atomically
from hal.codecs.player import parse_answer, request_line

SOCKET_NAME: Final = "player.sock"
LOG_NAME: Final = "player.log"
_READY_S: Final = 20.0
_END_S: Final = 5.0
_POLL_S: Final = 0.02
_TOLD_BYTES: Final = 600
_TAKEN: Final = "is already running"
"""Part of a player's error when another one is already running (``storage.exclusive``)."""


@dataclass(frozen=True, slots=True)
class PlayerSettings:
    """What a player is started with.

    ``outputs``: (name, width_px, height_px) in stage order; ``frames``: the memory output's file, None for windows;
    ``where``: connector or display serial number by output name, where that is another; ``trusted``, ``revoked``:
    public key files; ``resume``: it shows again what was playing when it was killed; ``suggested``: it begins with the
    bundle's own playlist otherwise; ``rate_hz``: pictures change at multiples of 1 / rate_hz seconds; ``part``: the
    outputs are a part of what bundles are made for; ``display``: the X screen, "" for that of the environment.

    ``hosts``: where outputs are that are not on this computer's first screen, as "COMPUTER" or "COMPUTER/:0.1" or
    "/:0.1" by output name; then a conductor of several players serves instead of one player (``stage.hosts``).
    ``keys``: the folder of its authority; ``alone``: how long its players continue without it, and what they do then.
    """

    outputs: Sequence[tuple[str, int, int]]
    frames: Path | None
    bundle: Path | None = None
    trusted: Sequence[Path] = field(default=())
    allow_unsigned: bool = False
    rate_hz: float = 60.0
    revoked: Sequence[Path] = field(default=())
    where: Mapping[str, str] = field(default_factory=dict)
    resume: bool = False
    suggested: bool = False
    part: bool = False
    display: str = ""
    hosts: Mapping[str, str] = field(default_factory=dict)
    keys: Path | None = None
    alone: tuple[float, str] = (3600.0, "on")

    def arguments(self) -> list[str]:
        """Them as the player's command line has them."""
        words = ["--outputs", ",".join(f"{name}:{width}x{height}" for name, width, height in self.outputs)]
        words += ["--windows"] if self.frames is None else ["--frames", str(self.frames)]
        words += [word for name, place in self.where.items() for word in ("--where", f"{name}={place}")]
        words += [] if self.bundle is None else ["--bundle", str(self.bundle)]
        words += [word for key in self.trusted for word in ("--trusted", str(key))]
        words += [word for key in self.revoked for word in ("--revoked", str(key))]
        words += ["--allow-unsigned"] if self.allow_unsigned else []
        words += ["--resume"] if self.resume else []
        words += ["--suggested"] if self.suggested else []
        words += ["--part"] if self.part else []
        words += [word for name, place in self.hosts.items() for word in ("--host", f"{name}={place}")]
        if self.hosts:
            words += ["--alone", f"{self.alone[0]:g},{self.alone[1]}"]
            words += [] if self.keys is None else ["--keys", str(self.keys)]
        return [*words, "--rate", f"{self.rate_hz:g}"]


class PlayerProcess:
    """A running player. Use as a context manager, or call ``terminate``; it keeps running if its starter dies.

    ``socket`` is where it serves.
    """

    def __init__(self, runtime: Path, settings: PlayerSettings) -> None:
        self.socket = runtime / SOCKET_NAME
        self.log = runtime / LOG_NAME
        self._settings = settings
        self._process = self._start()

    def _start(self) -> subprocess.Popen[bytes]:
        command = [sys.executable, "-m", "controller.play", "--socket", str(self.socket)]
        command += self._settings.arguments()
        with self.log.open("wb") as log:
            # A session of its own: Ctrl-C is for the controller, which ends the player when the lamps are safe.
            return subprocess.Popen(  # noqa: S603
                command,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                start_new_session=True,
                env=_environment(self._settings.display),
            )

    @property
    def pid(self) -> int:
        return self._process.pid

    @property
    def alive(self) -> bool:
        """Whether the process runs (it may still be hung: ask it for its status)."""
        return self._process.poll() is None

    def wait_until_ready(self, timeout_s: float = _READY_S) -> dict[str, Any]:
        """Return the player's answer to hello once it serves.

        Raises WorkError("player-not-started") if it ends or stays silent; the sentence contains its output.
        """
        ends_s = time.monotonic() + timeout_s
        while self.alive and time.monotonic() < ends_s:
            try:
                return self._hello(ends_s - time.monotonic())
            except OSError:
                time.sleep(_POLL_S)
        log_tail = self.log.read_bytes()[-_TOLD_BYTES:].decode(errors="replace").strip()
        said = " ".join(log_tail.split()) or f"it did not answer within {timeout_s:.0f} s"
        self.terminate()
        # The log is not named: a folder of a run that fails is deleted with it.
        raise WorkError(
            "player-not-started",
            what=f"The player did not start: {said.removesuffix('.')}.",
            remedy="Correct the cause, then start again."
            if log_tail
            else "Close programs that keep this computer busy, then start again.",
        )

    def _hello(self, timeout_s: float) -> dict[str, Any]:
        answer = hello(self.socket, timeout_s)
        # A player that served here before may be on its way out still.
        if answer.get("pid") != self.pid:
            raise ConnectionError
        return answer

    def kill(self) -> None:
        """End it at once, without asking."""
        os.kill(self.pid, signal.SIGKILL)

    def terminate(self, timeout_s: float = _END_S) -> int:
        """Ask the player to leave black and end; kill it if it does not in time. Returns its exit code."""
        if self.alive:
            self._process.send_signal(signal.SIGTERM)
            try:
                self._process.wait(timeout_s)
            except subprocess.TimeoutExpired:
                self.kill()
        return self._process.wait()

    def restart(self, timeout_s: float = _READY_S) -> dict[str, Any]:
        """End the player, hung or not, and start it again with the same settings; returns its answer to hello."""
        self.terminate(timeout_s=1.0)
        self._process = self._start()
        return self.wait_until_ready(timeout_s)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.terminate()


def hello(path: Path, timeout_s: float) -> dict[str, Any]:
    """The description that the player at ``path`` gives; empty while it ends. Raises OSError."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as channel:
        channel.settimeout(max(0.01, timeout_s))
        channel.connect(str(path))
        channel.sendall(request_line(None, {"op": "hello"}))
        line = channel.makefile("rb").readline()
    return parse_answer(line) if line.endswith(b"\n") else {}


def _environment(display: str) -> dict[str, str]:
    # The player does no linear algebra; its threads would cost a fifth of the time that its imports take.
    return {**os.environ, "OPENBLAS_NUM_THREADS": "1", **({"DISPLAY": display} if display else {})}


def end_leftover(runtime: Path, timeout_s: float = _END_S) -> bool:
    """End the player that still serves ``runtime`` because its starter was killed; whether there was one.

    Only for the holder of the stage's lock: other programs may need that player. One that hangs is killed.
    """
    return end_serving(runtime / SOCKET_NAME, timeout_s)


def end_serving(path: Path, timeout_s: float = _END_S) -> bool:
    """End the player that serves the socket ``path``, if there is one, and wait for its end."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as channel:
        channel.settimeout(1.0)
        try:
            channel.connect(str(path))
            pid, _, _ = struct.unpack("3i", channel.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, 12))
            process = os.pidfd_open(pid)
        except OSError:
            return False
    try:
        for number, patience_s in ((signal.SIGTERM, timeout_s), (signal.SIGKILL, 1.0)):
            with contextlib.suppress(ProcessLookupError):
                signal.pidfd_send_signal(process, number)
            if select.select([process], [], [], patience_s)[0]:
                break
    finally:
        os.close(process)
    return True


def start_player(runtime: Path, settings: PlayerSettings, *, timeout_s: float = _READY_S) -> PlayerProcess:
    """Start a player that serves ``runtime``/player.sock, and return once it has shown black and answers.

    ``runtime`` must be private (``controller.core.storage.runtime_folder``). Raises WorkError("player-not-started").
    """
    player = PlayerProcess(runtime, settings)
    player.wait_until_ready(timeout_s)
    return player


def replace_player(runtime: Path, settings: PlayerSettings, *, timeout_s: float = _READY_S) -> PlayerProcess:
    """``start_player`` in the place of one that a killed starter left behind, as ``end_leftover`` and for whom it may.

    One that was still loading when its starter was killed has no client yet, and takes the socket a moment later.
    """
    end_leftover(runtime)
    try:
        return start_player(runtime, settings, timeout_s=timeout_s)
    except WorkError as error:
        if _TAKEN not in error.what:
            raise
    until_s = time.monotonic() + timeout_s
    while not end_leftover(runtime) and time.monotonic() < until_s:
        time.sleep(_POLL_S)
    return start_player(runtime, settings, timeout_s=timeout_s)


_ATTACHED_POLL_S: Final = 0.05
_ATTACHED_READY_S: Final = 20.0


class AttachedPlayer:
    """As ``launch.PlayerProcess``, of a player that another program starts with the arguments in ``options``.

    ``settings``: what it has to be started with; where the file says something else, the file is written and the player
    ended, and its next start reads it. None: as it is.
    """

    def __init__(self, socket: Path, options: Path, settings: PlayerSettings | None) -> None:
        self.socket = socket
        self.pid = 0
        self._outputs = None if settings is None else [tuple(output) for output in settings.outputs]
        self._process = -1
        wanted = None if settings is None else "".join(f"{word}\n" for word in settings.arguments()).encode()
        with contextlib.suppress(FileNotFoundError):
            if wanted is None or options.read_bytes() == wanted:
                return
        if wanted is not None:
            write_atomically(options, wanted, mode=0o600)
            end_serving(socket)

    @property
    def alive(self) -> bool:
        """Whether the process that answered runs still."""
        return self._process >= 0 and not select.select([self._process], [], [], 0)[0]

    def wait_until_ready(self, timeout_s: float = _ATTACHED_READY_S) -> dict[str, Any]:
        """The player's answer to hello. Raises WorkError("player-not-started") where none answers in time."""
        ends_s = time.monotonic() + timeout_s
        while time.monotonic() < ends_s:
            with contextlib.suppress(OSError, ValueError):
                answer = hello(self.socket, ends_s - time.monotonic())
                if answer and not self._fits(answer):
                    # It was about to serve when the file was written, and has read what stood there before.
                    end_serving(self.socket)
                elif answer:
                    self._process = os.pidfd_open(int(answer["pid"]))
                    self.pid = int(answer["pid"])
                    return answer
            time.sleep(_ATTACHED_POLL_S)
        raise WorkError(
            "player-not-started",
            what="The player of this computer does not answer.",
            remedy="Read the reason with `journalctl -u velatura-player`. systemd starts it again until it runs.",
        )

    def _fits(self, answer: Mapping[str, Any]) -> bool:
        actual = [(row["name"], row["width_px"], row["height_px"]) for row in answer["outputs"]]
        return self._outputs is None or self._outputs == actual

    def kill(self) -> None:
        """End it at once, without asking; its starter starts it again."""
        os.kill(self.pid, signal.SIGKILL)

    def terminate(self, timeout_s: float = 0.0) -> int:
        """Let go of it; it plays on."""
        if self._process >= 0:
            os.close(self._process)
            self._process = -1
        return 0
