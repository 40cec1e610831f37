"""The display through the player process: the player's socket and inbox, as docs/player-protocol.md describes them."""

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
from hal.errors import DeviceError, DeviceGone, DeviceRefused, DeviceTimeout, PluginError, ProtocolError
from hal.registry import Driver, OpenContext
from hal.values import DeviceIdentity, OutputInfo, PlaybackStatus, Presented

_PROTOCOL: Final = 1
_SLICE_S: Final = 0.1
_MAX_ANSWER_BYTES: Final = 1024 * 1024
_HEAD: Final = struct.Struct("<8sIIQdQ24x")
_ENTRY: Final = struct.Struct("<40sIIQQ")
_RESTARTED: Final = "Start it again with 'velatura play' or through its systemd unit; then ask again."


class _Inbox:
    """The mapped file in which frames go to the player."""

    def __init__(self, path: Path, outputs: Sequence[OutputInfo]) -> None:
        try:
            with path.open("r+b") as file:
                self._map = mmap.mmap(file.fileno(), 0)
        except (OSError, ValueError) as error:
            raise DeviceGone(
                "player-not-running",
                what=f"The player's inbox {path} can not be opened.",
                remedy=_RESTARTED,
            ) from error
        magic, version, count, _, _, size = _HEAD.unpack_from(self._map)
        if (magic, version, count, size) != (b"VELFRAME", _PROTOCOL, len(outputs), len(self._map)):
            raise _broken("its inbox has another layout than its answer to hello")
        self._sequence = np.frombuffer(self._map, "<u8", 1, 16)
        self._pixels = {}
        for number, output in enumerate(outputs):
            name, width, height, offset, _ = _ENTRY.unpack_from(self._map, _HEAD.size + number * _ENTRY.size)
            if (name.rstrip(b"\0").decode(), width, height) != (output.name, output.width_px, output.height_px):
                raise _broken("its inbox has other outputs than its answer to hello")
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
        del self._sequence, self._pixels
        with contextlib.suppress(BufferError):
            self._map.close()


class PlayerDisplay:
    """A running player as a display. Connects again by itself after the player was restarted.

    Beyond ``hal.interfaces.Display`` it offers ``play_sequence``, ``stop``, ``status`` and ``load_bundle``. Not for use
    from several threads at once.
    """

    def __init__(self, path: Path, expected: tuple[OutputInfo, ...] | None) -> None:
        self._path, self._expected = path, expected
        self._channel: socket.socket | None = None
        self._inbox: _Inbox | None = None
        self._outputs: tuple[OutputInfo, ...] = ()
        self._received = b""
        self._ticket = 0
        self._closed = False

    # --- hal.interfaces.Display ---------------------------------------------------------------------------------

    def identity(self, *, deadline: Deadline) -> DeviceIdentity:
        """The player's name and the protocol that it speaks; its process number stands for the serial number."""
        hello = self._ask({"op": "hello"}, deadline)
        return DeviceIdentity(
            "Velatura", str(hello["player"]), serial=str(hello["pid"]), firmware=f"protocol {hello['protocol']}"
        )

    def outputs(self, *, deadline: Deadline) -> tuple[OutputInfo, ...]:
        """The outputs in stage order, as the player that runs now has them."""
        self._connect(deadline)
        return self._outputs

    def show(self, frames: Mapping[str, npt.NDArray[np.uint8]], *, deadline: Deadline) -> Presented:
        """Show one frame an output; see ``hal.interfaces.Display.show``."""
        self._connect(deadline)
        assert self._inbox is not None
        self._check(frames)
        return _presented(self._ask({"op": "show", "sequence": self._inbox.put(frames)}, deadline))

    def play(self, appearance: str, *, deadline: Deadline) -> Presented:
        """Show an appearance of the player's bundle; see ``hal.interfaces.Display.play``."""
        return _presented(self._ask({"op": "play", "appearance": appearance}, deadline))

    def close(self) -> None:
        """Let go of the player; it goes on showing what it shows."""
        self._closed = True
        self._hang_up()

    # --- beyond the interface -----------------------------------------------------------------------------------

    def play_sequence(
        self, items: Sequence[tuple[str, float]], *, deadline: Deadline, repeat: int = 0, rate_hz: float | None = None
    ) -> Presented:
        """Show appearances in turn, (name, seconds) each, ``repeat`` times (0: for ever); returns at the first.

        ``rate_hz``: pictures change at multiples of 1 / rate_hz seconds; None: at the player's own rate.
        """
        request = {"op": "sequence", "items": [list(item) for item in items], "repeat": repeat, "rate_hz": rate_hz}
        return _presented(self._ask(request, deadline))

    def stop(self, *, deadline: Deadline) -> Presented:
        """Show black."""
        return _presented(self._ask({"op": "stop"}, deadline))

    def status(self, *, deadline: Deadline) -> dict[str, Any]:
        """What the player shows and how evenly: the keys of "status" in docs/player-protocol.md."""
        return self._ask({"op": "status"}, deadline)

    def playing(self, *, deadline: Deadline) -> PlaybackStatus:
        """What is shown now, and how evenly; see ``hal.interfaces.BundleDisplay.playing``."""
        answer = self.status(deadline=deadline)
        try:
            return PlaybackStatus(
                swaps=int(answer["swaps"]),
                presented_at_s=float(answer["presented_at"]),
                running=bool(answer["sequence_running"]),
                late=int(answer["late"]),
                appearance=answer["appearance"],
                bundle=answer["bundle"],
                interval_p50_s=answer["interval_p50_s"],
                interval_p99_s=answer["interval_p99_s"],
                rss_bytes=int(answer["rss_bytes"]),
            )
        except (KeyError, TypeError, ValueError) as error:
            raise _broken("its status lacks something") from error

    def load_bundle(self, path: Path, *, deadline: Deadline) -> str:
        """Let the player use another bundle from now on; returns the bundle's identity (hex)."""
        return str(self._ask({"op": "load-bundle", "path": str(path.resolve())}, deadline)["bundle"])

    # --- the wire -----------------------------------------------------------------------------------------------

    def _check(self, frames: Mapping[str, npt.NDArray[np.uint8]]) -> None:
        shapes = {output.name: (output.height_px, output.width_px, 3) for output in self._outputs}
        for name, frame in frames.items():
            if name not in shapes:
                raise DeviceRefused(
                    "display-no-output",
                    what=f"The player has no output {name!r}; it has {', '.join(shapes)}.",
                    remedy="Use the names of [[display.outputs]] in stage.toml.",
                )
            if frame.shape != shapes[name] or frame.dtype != np.uint8:
                raise DeviceRefused(
                    "display-frame-unfit",
                    what=f"A frame of shape {frame.shape}, {frame.dtype} does not fit output {name}, "
                    f"which takes {shapes[name]}, uint8.",
                    remedy="Make frames of the size that stage.toml gives for this output.",
                )

    def _hang_up(self) -> None:
        channel, self._channel = self._channel, None
        inbox, self._inbox = self._inbox, None
        self._received = b""
        if channel is not None:
            channel.close()
        if inbox is not None:
            inbox.close()

    def _connect(self, deadline: Deadline) -> None:
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
                remedy="Start it with 'velatura play' or through its systemd unit; then ask again.",
            ) from error
        except BaseException:
            channel.close()
            raise
        self._channel = channel
        try:
            self._greet(deadline)
        except BaseException:
            self._hang_up()
            raise

    def _greet(self, deadline: Deadline) -> None:
        hello = self._ask({"op": "hello"}, deadline)
        try:
            outputs = tuple(OutputInfo(o["name"], o["width_px"], o["height_px"]) for o in hello["outputs"])
            spoken, inbox = hello["protocol"], Path(hello["inbox"])
        except (KeyError, TypeError) as error:
            raise _broken("its answer to hello lacks a key") from error
        if spoken != _PROTOCOL:
            raise DeviceRefused(
                "player-protocol",
                what=f"The player speaks protocol {spoken}; this driver speaks {_PROTOCOL}.",
                remedy="Install player and controller of the same release, and restart the player.",
            )
        if self._expected is not None and self._expected != outputs:
            raise DeviceRefused(
                "player-outputs-differ",
                what=f"The player has the outputs {_listed(outputs)}; stage.toml says {_listed(self._expected)}.",
                remedy="Restart the player for this stage, or correct [[display.outputs]].",
            )
        self._outputs, self._inbox = outputs, _Inbox(inbox, outputs)

    def _ask(self, request: Mapping[str, Any], deadline: Deadline) -> dict[str, Any]:
        """Send a request and return its answer; answers to earlier requests, given up since, are passed over."""
        self._connect(deadline)
        self._ticket += 1
        line = json.dumps({"id": self._ticket, **request}).encode() + b"\n"
        try:
            self._send(line, deadline)
            while (answer := self._answer(deadline)).get("id") != self._ticket:
                pass
        except (OSError, ProtocolError) as error:
            self._hang_up()
            if isinstance(error, DeviceError):
                raise
            raise DeviceGone("player-gone", what="The player ended meanwhile.", remedy=_RESTARTED) from error
        if answer.get("ok") is True:
            return answer
        told = answer.get("error")
        if not isinstance(told, dict) or not all(isinstance(told.get(k), str) for k in ("code", "what", "remedy")):
            self._hang_up()
            raise _broken("an error of it does not say what and why")
        raise DeviceRefused(told["code"], what=told["what"], remedy=told["remedy"])

    def _send(self, line: bytes, deadline: Deadline) -> None:
        assert self._channel is not None
        silent = _silent()
        deadline.check(silent.code, what=silent.what, remedy=silent.remedy)
        self._channel.settimeout(max(0.001, deadline.left_s()))
        try:
            self._channel.sendall(line)
        except TimeoutError as error:
            self._hang_up()  # half a line may be under way
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
                raise _broken("an answer of it is too long")
        line, self._received = self._received.split(b"\n", 1)
        try:
            answer = json.loads(line)
        except (ValueError, RecursionError) as error:
            raise _broken("an answer of it is not JSON") from error
        if not isinstance(answer, dict):
            raise _broken("an answer of it is not a JSON object")
        return answer


def _call(channel: socket.socket, path: Path, deadline: Deadline) -> None:
    """Connect; where too many others wait for the player, wait with them."""
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


def _presented(answer: Mapping[str, Any]) -> Presented:
    sequence, at_s = answer.get("sequence"), answer.get("presented_at")
    if not isinstance(sequence, int) or not isinstance(at_s, float):
        raise _broken("an answer of it does not say when it presented")
    return Presented(sequence, at_s)


def _silent() -> DeviceTimeout:
    return DeviceTimeout(
        "player-silent",
        what="The player did not answer in time.",
        remedy="If it goes on, restart the player; it may hang.",
    )


def _broken(detail: str) -> ProtocolError:
    return ProtocolError(
        "player-protocol-broken",
        what=f"The player does not keep to its protocol: {detail}.",
        remedy="Install player and controller of the same release, and restart the player.",
    )


def _listed(outputs: Sequence[OutputInfo]) -> str:
    return ", ".join(f"{output.name} {output.width_px}x{output.height_px}" for output in outputs)


def _open(settings: Mapping[str, Any], context: OpenContext, deadline: Deadline) -> PlayerDisplay:
    path = context.stage / settings["socket"] if "socket" in settings else None
    if path is None and context.runtime is not None:
        path = context.runtime / "player.sock"
    if path is None:
        raise PluginError(
            "player-socket-unknown",
            what="Neither stage.toml nor the command says where the player's socket is.",
            remedy='Set socket = "..." in [display].',
        )
    try:
        tables = settings.get("outputs")
        expected = tables and tuple(OutputInfo(t["name"], int(t["width_px"]), int(t["height_px"])) for t in tables)
    except (KeyError, TypeError, ValueError) as error:
        raise PluginError(
            "player-outputs-wrong",
            what="An output in [[display.outputs]] lacks its name, width_px or height_px.",
            remedy='Give each output all three, e.g. name = "P1", width_px = 1400, height_px = 1050.',
        ) from error
    display = PlayerDisplay(path, expected)
    display.outputs(deadline=deadline)
    return display


DRIVER = Driver(
    kind="display",
    name="player",
    summary="all projector outputs together, through Velatura's player process",
    open=_open,
    settings={
        "outputs": "list of tables with name, width_px and height_px, in stage order",
        "frames": "file, relative to the stage, in which the player shows frames instead of windows (memory output)",
        "socket": "the player's socket, relative to the stage; default: player.sock in the stage's runtime folder",
    },
)
