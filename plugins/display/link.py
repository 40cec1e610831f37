"""The connection to the player: its socket and its inbox (docs/reference/player-protocol.md)."""

from __future__ import annotations

import contextlib
import json
import mmap
import socket
import struct
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from hal.deadline import Deadline
from hal.errors import DeviceError, DeviceGone, DeviceRefused, DeviceTimeout, ProtocolError
from hal.values import OutputInfo

_PROTOCOL: Final = 1
_SLICE_S: Final = 0.1
_MAX_ANSWER_BYTES: Final = 1024 * 1024
_HEAD: Final = struct.Struct("<8sIIQdQ24x")
_ENTRY: Final = struct.Struct("<40sIIQQ")
_RESTARTED: Final = "Start it again with 'velatura play' or through its systemd unit. Then repeat the command."


class Inbox:
    """The mapped file for frames to the player."""

    def __init__(self, path: Path, outputs: Sequence[OutputInfo]) -> None:
        try:
            with path.open("r+b") as file:
                self._map = mmap.mmap(file.fileno(), 0)
        except (OSError, ValueError) as error:
            raise DeviceGone(
                "player-not-running",
                what=f"The player's inbox {path} can't be opened.",
                remedy=_RESTARTED,
            ) from error
        magic, version, count, _, _, size = _HEAD.unpack_from(self._map)
        if (magic, version, count, size) != (b"VELFRAME", _PROTOCOL, len(outputs), len(self._map)):
            raise broken("the layout of its inbox differs from its answer to hello")
        self._sequence = np.frombuffer(self._map, "<u8", 1, 16)
        self._pixels = {}
        for number, output in enumerate(outputs):
            name, width, height, offset, _ = _ENTRY.unpack_from(self._map, _HEAD.size + number * _ENTRY.size)
            if (name.rstrip(b"\0").decode(), width, height) != (output.name, output.width_px, output.height_px):
                raise broken("the outputs of its inbox differ from its answer to hello")
            pixels = np.frombuffer(self._map, np.uint8, width * height * 3, offset)
            self._pixels[output.name] = pixels.reshape(height, width, 3)

    def put(self, frames: Mapping[str, npt.NDArray[np.uint8]]) -> int:
        """Write a set, black where no frame is given; return its sequence number."""
        sequence = int(self._sequence[0]) | 1
        self._sequence[0] = sequence
        for name, target in self._pixels.items():
            target[...] = frames.get(name, np.uint8(0))
        self._sequence[0] = sequence + 1
        return sequence + 1

    def close(self) -> None:
        """Release the mapping."""
        del self._sequence, self._pixels
        with contextlib.suppress(BufferError):
            self._map.close()


class PlayerLink:
    """A connection to a player, opened when needed, and again after a restart of the player.

    ``expected``: the outputs that the player must have, or None for any. ``outputs`` and ``inbox`` are those of the
    connected player.
    """

    def __init__(self, path: Path, expected: tuple[OutputInfo, ...] | None) -> None:
        self._path, self._expected = path, expected
        self._channel: socket.socket | None = None
        self.inbox: Inbox | None = None
        self.outputs: tuple[OutputInfo, ...] = ()
        self._received = b""
        self._ticket = 0
        self._closed = False

    def close(self) -> None:
        """Close the connection permanently."""
        self._closed = True
        self.hang_up()

    def hang_up(self) -> None:
        """Drop the connection; the next request makes a new one."""
        channel, self._channel = self._channel, None
        inbox, self.inbox = self.inbox, None
        self._received = b""
        if channel is not None:
            channel.close()
        if inbox is not None:
            inbox.close()

    def connect(self, deadline: Deadline) -> None:
        """Connect unless connected.

        Raises DeviceGone("player-not-running" or "display-closed"), DeviceRefused("player-protocol" or
        "player-outputs-differ"), DeviceTimeout("player-silent"), ProtocolError("player-protocol-broken").
        """
        if self._closed:
            raise DeviceGone("display-closed", what="The display was closed.", remedy="Open it again to use it.")
        if self._channel is not None:
            return
        channel = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            _call(channel, self._path, deadline)
        except OSError as error:
            channel.close()
            raise DeviceGone(
                "player-not-running",
                what=f"No player answers at {self._path}.",
                remedy="Start it with 'velatura play' or through its systemd unit. Then repeat the command.",
            ) from error
        except BaseException:
            channel.close()
            raise
        self._channel = channel
        try:
            self._greet(deadline)
        except BaseException:
            self.hang_up()
            raise

    def _greet(self, deadline: Deadline) -> None:
        hello = self.request({"op": "hello"}, deadline)
        try:
            outputs = tuple(OutputInfo(o["name"], o["width_px"], o["height_px"]) for o in hello["outputs"])
            spoken, inbox = hello["protocol"], Path(hello["inbox"])
        except (KeyError, TypeError) as error:
            raise broken("its answer to hello lacks a key") from error
        if spoken != _PROTOCOL:
            raise DeviceRefused(
                "player-protocol",
                what=f"The player has protocol {spoken}, but this driver has {_PROTOCOL}.",
                remedy="Install player and controller of the same release, and restart the player.",
            )
        if self._expected is not None and self._expected != outputs:
            raise DeviceRefused(
                "player-outputs-differ",
                what=f"The player has the outputs {_listed(outputs)}, but stage.toml has {_listed(self._expected)}.",
                remedy="Restart the player for this stage, or correct [[display.outputs]].",
            )
        self.outputs, self.inbox = outputs, Inbox(inbox, outputs)

    def request(self, request: Mapping[str, Any], deadline: Deadline) -> dict[str, Any]:
        """Send a request and return its answer; skip answers to earlier, abandoned requests.

        Raises as ``connect``; DeviceRefused with the player's own code and sentences if it refuses.
        """
        self.connect(deadline)
        self._ticket += 1
        line = json.dumps({"id": self._ticket, **request}).encode() + b"\n"
        try:
            self._send(line, deadline)
            while (answer := self._answer(deadline)).get("id") != self._ticket:
                pass
        except (OSError, ProtocolError) as error:
            self.hang_up()
            if isinstance(error, DeviceError):
                raise
            raise DeviceGone("player-gone", what="The player ended during the command.", remedy=_RESTARTED) from error
        if answer.get("ok") is True:
            return answer
        failure = answer.get("error")
        if not isinstance(failure, dict) or not all(
            isinstance(failure.get(k), str) for k in ("code", "what", "remedy")
        ):
            self.hang_up()
            raise broken("one of its errors lacks code, what or remedy")
        raise DeviceRefused(failure["code"], what=failure["what"], remedy=failure["remedy"])

    def _send(self, line: bytes, deadline: Deadline) -> None:
        assert self._channel is not None
        silent = _silent()
        deadline.check(silent.code, what=silent.what, remedy=silent.remedy)
        self._channel.settimeout(max(0.001, deadline.left_s()))
        try:
            self._channel.sendall(line)
        except TimeoutError as error:
            self.hang_up()  # half a line may have been sent
            raise silent from error

    def _answer(self, deadline: Deadline) -> dict[str, Any]:
        assert self._channel is not None
        while b"\n" not in self._received:
            silent = _silent()
            deadline.check(silent.code, what=silent.what, remedy=silent.remedy)
            self._channel.settimeout(max(0.001, min(_SLICE_S, deadline.left_s())))
            try:
                data = self._channel.recv(65536)
            except TimeoutError:
                continue
            if not data:
                raise ConnectionError("the player closed the connection")
            self._received += data
            if len(self._received) > _MAX_ANSWER_BYTES:
                raise broken("an answer of it is too long")
        line, self._received = self._received.split(b"\n", 1)
        try:
            answer = json.loads(line)
        except (ValueError, RecursionError) as error:
            raise broken("an answer of it is not JSON") from error
        if not isinstance(answer, dict):
            raise broken("an answer of it is not a JSON object")
        return answer


def _call(channel: socket.socket, path: Path, deadline: Deadline) -> None:
    """Connect; if too many others wait for the player, wait, too."""
    channel.setblocking(False)
    while True:
        silent = _silent()
        deadline.check(silent.code, what=silent.what, remedy=silent.remedy)
        try:
            channel.connect(str(path))
        except BlockingIOError:
            deadline.sleep(_SLICE_S)
        else:
            return


def _silent() -> DeviceTimeout:
    return DeviceTimeout(
        "player-silent",
        what="The player did not answer in time.",
        remedy="If this happens again, restart the player.",
    )


def broken(detail: str) -> ProtocolError:
    """The error for bytes that the player's protocol does not allow."""
    return ProtocolError(
        "player-protocol-broken",
        what=f"The player broke its protocol: {detail}.",
        remedy="Install player and controller of the same release, and restart the player.",
    )


def _listed(outputs: Sequence[OutputInfo]) -> str:
    return ", ".join(f"{output.name} {output.width_px}x{output.height_px}" for output in outputs)
