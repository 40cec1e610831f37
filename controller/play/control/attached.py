"""The player of an installed kiosk: systemd starts and restarts it; the controller only connects to it."""

from __future__ import annotations

import contextlib
import os
import select
import signal
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from controller.core.errors import WorkError
from controller.core.storage import write_atomically
from controller.play.control.launch import PlayerSettings, end_serving, hello

_POLL_S: Final = 0.05
_READY_S: Final = 20.0


class AttachedPlayer:
    """As ``launch.PlayerProcess``, of a player that somebody else starts with the arguments in ``options``.

    ``settings``: what it is to be started with; where the file says something else, the file is written and the player
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

    def wait_until_ready(self, timeout_s: float = _READY_S) -> dict[str, Any]:
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
            time.sleep(_POLL_S)
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
