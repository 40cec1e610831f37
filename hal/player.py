"""The client of the player process: its socket and its inbox (docs/reference/player-protocol.md)."""

from __future__ import annotations

import mmap
import socket
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from hal.codecs.player import (
    LONGEST_ANSWER_BYTES,
    LONGEST_HEAD_BYTES,
    FrameLayout,
    MappedFrames,
    accepted,
    parse_answer,
    parse_layout,
    protocol_broken,
    request_line,
)
from hal.deadline import Deadline, Time
from hal.errors import DeviceError, DeviceGone, DeviceTimeout, ProtocolError
from hal.values import OutputInfo

_SLICE_S: Final = 0.1
_RESTARTED: Final = "Start it again with 'velatura play' or through its systemd unit. Then repeat the command."


class Inbox:
    """The mapped file for frames to the player, which has these ``outputs``.

    Raises DeviceGone("player-not-running"), ProtocolError("player-protocol-broken" or "frame-file-wrong").
    """

    def __init__(self, path: Path, outputs: Sequence[OutputInfo]) -> None:
        try:
            with path.open("r+b") as file:
                mapped = mmap.mmap(file.fileno(), 0)
        except (OSError, ValueError) as error:
            raise DeviceGone(
                "player-not-running", what=f"The player's inbox {path} can't be opened.", remedy=_RESTARTED
            ) from error
        layout = parse_layout(mapped[:LONGEST_HEAD_BYTES])
        if layout != FrameLayout.of((o.name, o.width_px, o.height_px) for o in outputs) or layout.size != len(mapped):
            mapped.close()
            raise protocol_broken("the outputs of its inbox differ from its answer to hello")
        self._names = [output.name for output in outputs]
        self._frames = MappedFrames(mapped, layout)

    def put(self, frames: Mapping[str, npt.NDArray[np.uint8]]) -> int:
        """Write a set, black where no frame is given; return its sequence number."""
        self._frames.begin()
        for name, pixels in zip(self._names, self._frames.pixels, strict=True):
            pixels[...] = frames.get(name, np.uint8(0))
        return self._frames.finish()

    def close(self) -> None:
        """Release the mapping."""
        self._frames.close()


def connected(path: Path, deadline: Deadline) -> socket.socket:
    """A connection to the player that serves ``path``; if too many others wait for the player, wait, too.

    Raises OSError, DeviceTimeout("player-silent") and Cancelled.
    """
    channel = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        channel.setblocking(False)
        while True:
            _check(deadline)
            try:
                channel.connect(str(path))
            except BlockingIOError:
                deadline.sleep(_SLICE_S)
            else:
                return channel
    except BaseException:
        channel.close()
        raise


class PlayerClient:
    """One connection to the player, made at the first request, and again after ``hang_up``.

    ``connect`` and ``clock`` can be replaced, for a simulated player in virtual time.
    """

    def __init__(self, connect: Callable[[Path, Deadline], socket.socket] = connected, clock: Time = time) -> None:
        self._connect, self._clock = connect, clock
        self._channel: socket.socket | None = None
        self._received = b""
        self._ticket = 0

    @property
    def is_connected(self) -> bool:
        return self._channel is not None

    def within(self, seconds: float) -> Deadline:
        """A deadline on this client's clock."""
        return Deadline(self._clock.monotonic() + seconds, time=self._clock)

    def hang_up(self) -> None:
        """Drop the connection; the next request makes a new one."""
        channel, self._channel = self._channel, None
        self._received = b""
        if channel is not None:
            channel.close()

    def request(self, path: Path, request: Mapping[str, Any], deadline: Deadline) -> dict[str, Any]:
        """The answer of the player that serves ``path``; answers to earlier, abandoned requests are skipped.

        Raises DeviceGone("player-not-running" or "player-gone"), DeviceTimeout("player-silent"), Cancelled,
        ProtocolError("player-protocol-broken"), and DeviceRefused with the player's own code and sentences.
        """
        channel = self._channel = self._channel or self._open(path, deadline)
        self._ticket += 1
        try:
            self._send(channel, request_line(self._ticket, request), deadline)
            while (answer := self._answer(channel, deadline)).get("id") != self._ticket:
                pass
            return accepted(answer)
        except (OSError, ProtocolError) as error:
            self.hang_up()
            if isinstance(error, DeviceError):
                raise
            raise DeviceGone("player-gone", what="The player ended during the command.", remedy=_RESTARTED) from error

    def _open(self, path: Path, deadline: Deadline) -> socket.socket:
        try:
            return self._connect(path, deadline)
        except OSError as error:
            raise DeviceGone("player-not-running", what=f"No player answers at {path}.", remedy=_RESTARTED) from error

    def _send(self, channel: socket.socket, line: bytes, deadline: Deadline) -> None:
        _check(deadline)
        channel.settimeout(max(0.001, deadline.left_s()))
        try:
            channel.sendall(line)
        except TimeoutError as error:
            self.hang_up()  # half a line may have been sent
            raise _silent() from error

    def _answer(self, channel: socket.socket, deadline: Deadline) -> dict[str, Any]:
        while b"\n" not in self._received:
            _check(deadline)
            channel.settimeout(max(0.001, min(_SLICE_S, deadline.left_s())))
            try:
                data = channel.recv(1 << 16)
            except TimeoutError:
                continue
            if not data:
                raise ConnectionError("the player closed the connection")
            self._received += data
            if len(self._received) > LONGEST_ANSWER_BYTES:
                raise protocol_broken("an answer of it is too long")
        line, self._received = self._received.split(b"\n", 1)
        return parse_answer(line)


def _check(deadline: Deadline) -> None:
    silent = _silent()
    deadline.check(silent.code, what=silent.what, remedy=silent.remedy)


def _silent() -> DeviceTimeout:
    return DeviceTimeout(
        "player-silent", what="The player did not answer in time.", remedy="If this happens again, restart the player."
    )
