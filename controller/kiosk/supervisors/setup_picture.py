"""What the projectors of an installed kiosk show while it has no stage: how to reach the panel."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Iterator
from functools import partial
from typing import Final

from controller.core.kiosk_places import PLAYER_OPTIONS, PLAYER_SOCKET, RUNTIME
from controller.kiosk.supervisors.player_supervisor import PlayerSupervisor
from controller.play.control.attached import AttachedPlayer
from controller.play.control.launch import PlayerSettings

_STEP_S: Final = 0.5


@contextlib.contextmanager
def shown(lines: Callable[[], tuple[str, ...]]) -> Iterator[None]:
    """Show ``lines()``, as they are from time to time, on one projector after the other until the end."""
    supervisor = PlayerSupervisor(
        RUNTIME,
        lambda _: PlayerSettings((), None),
        lambda _: None,
        attach=lambda _: AttachedPlayer(PLAYER_SOCKET, PLAYER_OPTIONS, None),
    )
    ended = threading.Event()
    thread = threading.Thread(target=partial(_show, supervisor, lines, ended), name="set-up picture", daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join(10.0)
        supervisor.close()


def _show(supervisor: PlayerSupervisor, lines: Callable[[], tuple[str, ...]], ended: threading.Event) -> None:
    while not ended.is_set():
        supervisor.notice = lines()
        supervisor.step()
        ended.wait(_STEP_S)
