"""The player's unix socket, and what its requests do.

Lines in, lines out, without ever blocking the loop that owns the socket. Requests are carried out on the player, and
answered. The last request that may be repeated is kept in a file, so that a player that was killed shows the same again
at its next start.
"""

from __future__ import annotations

import contextlib
import os
import select
import signal
import socket
import stat
from functools import partial
from pathlib import Path
from typing import Any, Final, Self

from controller.core.errors import UsageError, VelaturaError, WorkError
from controller.core.storage import LONGEST_PATH_BYTES, exclusive, listening, write_atomically
from controller.play.control import protocol
from controller.play.control.notify import log
from controller.play.control.protocol import (
    MAX_LINE_BYTES,
    InvalidRequest,
    Play,
    Request,
    Sequence,
    Stop,
    Suggested,
    parse_request,
)
from controller.play.display.identification import identification
from controller.play.frames import FrameFile, FrameSet
from controller.play.loop import Player
from controller.play.playlist import Playlist
from controller.play.presenting import Outcome, PresentedSet, ResultCallback
from hal.codecs import player as player_codec
from hal.codecs.player import error_line

MAX_CLIENTS: Final = 16
_BACKLOG: Final = 64
_MAX_UNSENT_BYTES: Final = 1024 * 1024
_RECEIVE_BYTES: Final = 64 * 1024


class Client:
    """One connection: what came in and is not yet a line, and what could not yet be sent."""

    def __init__(self, connection: socket.socket) -> None:
        self.connection = connection
        self.received = bytearray()
        self.unsent = bytearray()
        self.closing = False
        self.drained_bytes = 0

    def fileno(self) -> int:
        return self.connection.fileno()


class Server:
    """Listens on a unix stream socket of mode 0600; a stale one of a dead player is replaced.

    Use as a context manager. ``wake`` may be called from any thread, and signals wake ``poll`` too.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._clients: list[Client] = []
        self._stack = contextlib.ExitStack()

    def __enter__(self) -> Self:
        if len(os.fsencode(self.path)) > LONGEST_PATH_BYTES:
            raise UsageError(
                "socket-path-long",
                what=f"The socket's path {self.path} is longer than {LONGEST_PATH_BYTES} bytes.",
                remedy="Use a shorter path, for instance below /run.",
            )
        with self._stack as stack:
            lock = self.path.with_name(self.path.name + ".lock")
            stack.enter_context(exclusive(lock, what_is_running="A player"))
            self._listener = stack.enter_context(self._bound())
            stack.callback(self.path.unlink, missing_ok=True)
            self._woken, self._waker = (stack.enter_context(end) for end in socket.socketpair())
            for end in (self._listener, self._woken, self._waker):
                end.setblocking(False)
            before = signal.set_wakeup_fd(self._waker.fileno(), warn_on_full_buffer=False)
            stack.callback(signal.set_wakeup_fd, before)
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        for client in self._clients:
            client.connection.close()
        self._stack.close()

    def _bound(self) -> socket.socket:
        # The lock is ours, so whatever socket lies here belongs to a player that is dead.
        with contextlib.suppress(FileNotFoundError):
            if not stat.S_ISSOCK(self.path.lstat().st_mode):
                raise UsageError(
                    "socket-path-taken",
                    what=f"{self.path} already exists and is not a socket.",
                    remedy="Remove it, or give the player another path.",
                )
        try:
            return listening(self.path, _BACKLOG)
        except OSError as error:
            raise WorkError(
                "socket-not-made",
                what=f"The socket {self.path} could not be created: {error.strerror}.",
                remedy="Check that its folder exists and that you may write to it.",
            ) from error

    def wake(self) -> None:
        """End a ``poll`` that is waiting, now. A full pipe means that it is ending already."""
        with contextlib.suppress(OSError):
            self._waker.send(b"\0")

    def poll(self, timeout_s: float) -> list[tuple[Client, bytes]]:
        """Move bytes for at most ``timeout_s`` seconds; return at the first event, with the whole lines that came."""
        sources: list[socket.socket | Client] = [self._listener, self._woken, *self._clients]
        unsent = [client for client in self._clients if client.unsent]
        readable, writable, _ = select.select(sources, unsent, [], max(0.0, timeout_s))
        lines = []
        for source in readable:
            if isinstance(source, Client):
                lines += [(source, line) for line in self._receive(source)]
            elif source is self._listener:
                self._accept()
            else:
                with contextlib.suppress(BlockingIOError):
                    self._woken.recv(_RECEIVE_BYTES)
        for client in writable:
            self._flush(client)
        return lines

    def send(self, client: Client, line: bytes) -> None:
        """Send an answer, now or when the client takes it; one that has gone is forgotten."""
        if client in self._clients:
            client.unsent += line
            self._flush(client)

    def _accept(self) -> None:
        with contextlib.suppress(OSError):
            connection, _ = self._listener.accept()
            connection.setblocking(False)
            if len(self._clients) < MAX_CLIENTS:
                self._clients.append(Client(connection))
                return
            full = UsageError(
                "player-busy",
                what=f"The player already serves {MAX_CLIENTS} connections.",
                remedy="Close one of them first.",
            )
            with connection:
                connection.send(error_line(None, full))

    def _receive(self, client: Client) -> list[bytes]:
        try:
            data = client.connection.recv(_RECEIVE_BYTES)
        except BlockingIOError:
            return []
        except OSError:
            data = b""
        if not data:
            self._drop(client)
            return []
        if client.closing:
            # Closing with bytes unread would reset the connection before our last line is read.
            client.drained_bytes += len(data)
            if client.drained_bytes > _MAX_UNSENT_BYTES:
                self._drop(client)
            return []
        client.received += data
        *lines, rest = client.received.split(b"\n")
        client.received = rest
        if len(rest) > MAX_LINE_BYTES or any(len(line) > MAX_LINE_BYTES for line in lines):
            self._end(client, error_line(None, InvalidRequest(None, f"the line is longer than {MAX_LINE_BYTES} bytes")))
            return []
        return [bytes(line) for line in lines if line.strip()]

    def _end(self, client: Client, last_line: bytes) -> None:
        client.closing = True
        client.received.clear()
        self.send(client, last_line)

    def _flush(self, client: Client) -> None:
        try:
            sent = client.connection.send(client.unsent)
            del client.unsent[:sent]
        except BlockingIOError:
            pass
        except OSError:
            self._drop(client)
            return
        if len(client.unsent) > _MAX_UNSENT_BYTES:
            self._drop(client)
        elif client.closing and not client.unsent:
            with contextlib.suppress(OSError):
                client.connection.shutdown(socket.SHUT_WR)

    def _drop(self, client: Client) -> None:
        if client in self._clients:
            self._clients.remove(client)
        client.connection.close()


SUFFIX: Final = ".playing"
_BLACK: Final = b'{"op": "stop"}\n'
_SHOWS_NOTHING: Final = (
    protocol.Hello | protocol.Status | protocol.LoadBundle | protocol.Clock | protocol.Reports | protocol.Device
)


class SavedRequest:
    """The last request to play, or that nothing is to be played, in ``path``; None keeps nothing.

    No disk ever stops the picture.
    """

    def __init__(self, path: Path | None) -> None:
        self._path = path
        self._line: bytes | None = None

    def accepted(self, request: Request, line: bytes) -> None:
        """Keep the line of a request to play; when something else is to be shown, that the next start is black."""
        kept = line if isinstance(_inner(request), Play | Sequence | Suggested) else _BLACK
        if self._path is None or kept == self._line:
            return
        try:
            write_atomically(self._path, kept)
            self._line = kept
        except (VelaturaError, OSError) as error:
            self._line = None
            log(f"The current request could not be saved: {error}")

    def request(self) -> Request | None:
        """What is kept, or None where nothing is, or nothing that can be played."""
        if self._path is None:
            return None
        with contextlib.suppress(OSError, VelaturaError), self._path.open("rb") as file:
            _, request = parse_request(file.read(MAX_LINE_BYTES))
            return request if isinstance(_inner(request), Play | Sequence | Suggested | Stop) else None
        return None


def _inner(request: Request) -> Request:
    """What is to be done, at whatever moment."""
    return request.request if isinstance(request, protocol.Timed) else request


class Commands:
    """Between the socket, the inbox and the player; no request, however wrong, raises out of ``serve``."""

    def __init__(
        self,
        player: Player,
        server: Server,
        inbox: FrameFile,
        kept: SavedRequest,
        *,
        first: protocol.Request | None = None,
    ) -> None:
        """``first``: what to begin with where nothing is kept."""
        self._player, self._server, self._inbox, self._kept = player, server, inbox, kept
        self._first = first
        self._waits_for_clock = False
        # One may be shown, and be what the next picture fades from, while the other is read into.
        self._patterns = [FrameSet.black(player.sizes), FrameSet.black(player.sizes)]

    def serve(self, timeout_s: float) -> None:
        """Wait at most ``timeout_s`` seconds for requests and carry out those that came."""
        for client, line in self._server.poll(timeout_s):
            self._handle(client, line)

    def resume(self) -> None:
        """Continue with what is kept, or else begin with what there is to begin with; black if that can't be played."""
        request, self._waits_for_clock = self._kept.request() or self._first, False
        if request is None:
            return
        try:
            self._do(request, lambda _: None)
        except VelaturaError as error:
            self._waits_for_clock = error.code == "clock-unknown"

    def _handle(self, client: Client, line: bytes) -> None:
        ticket = None
        try:
            ticket, request = protocol.parse_request(line)
            values = self._do(request, partial(self._answer, client, ticket))
            if not isinstance(request, _SHOWS_NOTHING):
                self._waits_for_clock = False
                self._kept.accepted(request, line)
        except protocol.InvalidRequest as error:
            self._server.send(client, player_codec.error_line(error.ticket, error))
        except VelaturaError as error:
            self._server.send(client, player_codec.error_line(ticket, error))
        else:
            if values is not None:
                self._server.send(client, player_codec.answer_line(ticket, values))

    def _answer(self, client: Client, ticket: Any, outcome: Outcome) -> None:
        if isinstance(outcome, VelaturaError):
            self._server.send(client, player_codec.error_line(ticket, outcome))
            return
        if isinstance(outcome, PresentedSet):
            outcome = {"sequence": outcome.sequence, "presented_at": outcome.at_s}
        self._server.send(client, player_codec.answer_line(ticket, outcome))

    def _do(
        self,
        request: protocol.Request,
        on_result: ResultCallback,
        at_s: float | None = None,
        bundle: Path | None = None,
    ) -> dict[str, Any] | None:
        """Carry a request out; return its answer, or None where that comes once it is presented."""
        player = self._player
        match request:
            case protocol.Timed(timed, moment_s, file):
                return self._do(timed, on_result, moment_s, None if file is None else Path(file))
            case protocol.Show(sequence):
                player.withdraw()  # the frames of an earlier show, not yet presented, are overwritten here
                player.show(self._read_inbox(sequence), on_result, at_s=at_s)
            case protocol.Play(appearance, fade_s, brightness):
                playlist = Playlist(((appearance, 0.0, fade_s),), repeat=1)
                player.play(playlist, on_result, brightness=brightness, at_s=at_s, bundle=bundle)
            case protocol.Sequence(items, repeat, rate_hz, brightness, first_fade_s):
                playlist = Playlist(items, repeat, first_fade_s)
                player.play(playlist, on_result, rate_hz=rate_hz, brightness=brightness, at_s=at_s, bundle=bundle)
            case protocol.Suggested(repeat):
                player.play(player.suggested(repeat), on_result)
            case protocol.Stop(fade_s):
                player.stop(on_result, fade_s=fade_s, at_s=at_s)
            case protocol.Device(host, call):
                if not player.device(host, call, on_result):
                    raise UsageError(
                        "host-unknown", what=f"The display has no output on the computer {host}.",
                        remedy="Start the stage again, so that its player has the outputs of stage.toml.",
                    )  # fmt: skip
            case protocol.Identify():
                player.show(identification(player.sizes), on_result, showing="identification")
            case _:
                return self._answered(request)
        return None

    def _answered(self, request: protocol.Request) -> dict[str, Any]:
        """Carry out a request that is answered at once."""
        answer: dict[str, Any] = {}
        match request:
            case protocol.Hello():
                answer = self._hello()
            case protocol.Status():
                answer = self._player.status()
            case protocol.Live(file, white):
                answer = self._player.live(Path(file), white)
            case protocol.LoadBundle(path):
                self._player.load_bundle(Path(path))
                answer = {"bundle": self._player.bundle_identity}
            case protocol.Clock(ahead_s, keep_s, then):
                self._player.clock(ahead_s, keep_s, then)
                if self._waits_for_clock:
                    self.resume()
            case protocol.Reports(after):
                answer = {"reports": self._player.reports(after)}
            case protocol.Quit():
                self._player.end()
        return answer

    def _read_inbox(self, sequence: int) -> FrameSet:
        pattern = next(pattern for pattern in self._patterns if pattern is not self._player.shown)
        found = self._inbox.read(pattern)
        if found != sequence:
            raise UsageError(
                "inbox-sequence",
                what=f"The inbox holds frames number {found}, not {sequence}.",
                remedy="Let only one program write to the inbox, and let it request only the frames that it has "
                "written.",
            )
        return pattern

    def _hello(self) -> dict[str, Any]:
        player = self._player
        return {
            "player": "velatura",
            "protocol": player_codec.PROTOCOL,
            "minor": protocol.MINOR,
            "pid": os.getpid(),
            "rate_hz": player.rate_hz,
            "outputs": [{"name": o.name, "width_px": o.width_px, "height_px": o.height_px} for o in player.sizes],
            "inbox": str(self._inbox.path.resolve()),
            "bundle": player.bundle_identity,
        }
