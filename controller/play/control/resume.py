"""What was asked to be played, kept in a file, so that a player that was killed goes on when it is started again."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import Final

from controller.core.errors import VelaturaError
from controller.core.storage import write_atomically
from controller.play.control.notify import log
from controller.play.control.protocol import MAX_LINE_BYTES, Play, Request, Sequence, Stop, Suggested, parse_request

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
