"""Carries requests from the socket out on the player, and answers them.

The last request that may be repeated is kept in a file, so that a player that was killed shows the same again at its
next start.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, Final

from controller.core.errors import UsageError, VelaturaError
from controller.core.storage import write_atomically
from controller.play.control import protocol
from controller.play.control.notify import log
from controller.play.control.protocol import MAX_LINE_BYTES, Play, Request, Sequence, Stop, Suggested, parse_request
from controller.play.control.server import Client, Server
from controller.play.display.identification import identification
from controller.play.frames import FrameFile, FrameSet
from controller.play.loop import Player, Playlist
from controller.play.presenting import PresentedSet
from hal.codecs import player as player_codec

SUFFIX: Final = ".playing"
_BLACK: Final = b'{"op": "stop"}\n'


class SavedRequest:
    """The last request to play, or that nothing is to be played, in ``path``; None keeps nothing.

    No disk ever stops the picture.
    """

    def __init__(self, path: Path | None) -> None:
        self._path = path
        self._line: bytes | None = None

    def accepted(self, request: Request, line: bytes) -> None:
        """Keep the line of a request to play; when something else is to be shown, that the next start is black."""
        kept = line if isinstance(request, Play | Sequence | Suggested) else _BLACK
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
            return request if isinstance(request, Play | Sequence | Suggested | Stop) else None
        return None


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
        # One may be shown, and be what the next picture fades from, while the other is read into.
        self._patterns = [FrameSet.black(player.sizes), FrameSet.black(player.sizes)]

    def serve(self, timeout_s: float) -> None:
        """Wait at most ``timeout_s`` seconds for requests and carry out those that came."""
        for client, line in self._server.poll(timeout_s):
            self._handle(client, line)

    def resume(self) -> None:
        """Go on with what is kept, or else begin with what there is to begin with; black if that can't be played."""
        request = self._kept.request() or self._first
        if request is not None:
            with contextlib.suppress(VelaturaError):
                self._do(request, lambda _: None)

    def _handle(self, client: Client, line: bytes) -> None:
        ticket = None
        try:
            ticket, request = protocol.parse_request(line)
            values = self._do(request, partial(self._answer, client, ticket))
            if not isinstance(request, protocol.Hello | protocol.Status | protocol.LoadBundle):
                self._kept.accepted(request, line)
        except protocol.InvalidRequest as error:
            self._server.send(client, player_codec.error_line(error.ticket, error))
        except VelaturaError as error:
            self._server.send(client, player_codec.error_line(ticket, error))
        else:
            if values is not None:
                self._server.send(client, player_codec.answer_line(ticket, values))

    def _answer(self, client: Client, ticket: Any, outcome: PresentedSet | VelaturaError) -> None:
        if isinstance(outcome, VelaturaError):
            self._server.send(client, player_codec.error_line(ticket, outcome))
        else:
            values = {"sequence": outcome.sequence, "presented_at": outcome.at_s}
            self._server.send(client, player_codec.answer_line(ticket, values))

    def _do(
        self, request: protocol.Request, on_result: Callable[[PresentedSet | VelaturaError], None]
    ) -> dict[str, Any] | None:
        """Carry a request out; return its answer, or None where that comes once it is presented."""
        match request:
            case protocol.Hello():
                return self._hello()
            case protocol.Status():
                return self._player.status()
            case protocol.Show(sequence):
                self._player.withdraw()  # the frames of an earlier show, not yet presented, are overwritten here
                self._player.show(self._read_inbox(sequence), on_result)
            case protocol.Play(appearance, fade_s, brightness):
                playlist = Playlist(((appearance, 0.0, fade_s),), repeat=1)
                self._player.play(playlist, on_result, brightness=brightness)
            case protocol.Sequence(items, repeat, rate_hz, brightness, first_fade_s):
                playlist = Playlist(items, repeat, first_fade_s)
                self._player.play(playlist, on_result, rate_hz=rate_hz, brightness=brightness)
            case protocol.Suggested(repeat):
                self._player.play(self._player.suggested(repeat), on_result)
            case protocol.Live(file, white):
                return self._player.live(Path(file), white)
            case protocol.Stop(fade_s):
                self._player.stop(on_result, fade_s=fade_s)
            case protocol.Identify():
                self._player.show(identification(self._player.sizes), on_result, showing="identification")
            case protocol.LoadBundle(path):
                self._player.load_bundle(Path(path))
                return {"bundle": self._player.bundle_identity}
            case protocol.Quit():
                self._player.end()
                return {}
        return None

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
