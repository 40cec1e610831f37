"""What was asked to be played, kept in a file, so that a player that was killed goes on when it is started again."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import Final

from controller.errors import VelaturaError
from controller.play.notify import tell
from controller.play.protocol import MAX_LINE_BYTES, Play, Request, Sequence, parse_request
from controller.storage import write_atomically

SUFFIX: Final = ".playing"


class Kept:
    """The last request to play, in ``path``; None keeps nothing. No disk ever stops the picture."""

    def __init__(self, path: Path | None) -> None:
        self._path = path

    def accepted(self, request: Request, line: bytes) -> None:
        """Keep the line of a request to play; forget what was kept when something else is to be shown."""
        if self._path is None:
            return
        try:
            if isinstance(request, Play | Sequence):
                write_atomically(self._path, line)
            else:
                self._path.unlink(missing_ok=True)
        except (VelaturaError, OSError) as error:
            tell(f"What is playing could not be kept: {error}")

    def request(self) -> Request | None:
        """What is kept, or None where nothing is, or nothing that can be played."""
        if self._path is None:
            return None
        with contextlib.suppress(OSError, VelaturaError), self._path.open("rb") as file:
            _, request = parse_request(file.read(MAX_LINE_BYTES))
            return request if isinstance(request, Play | Sequence) else None
        return None
