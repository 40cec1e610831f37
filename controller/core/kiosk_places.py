"""Where `velatura kiosk install` puts the stage that this computer's services run, and their private folder."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Final

USER: Final = "velatura"
STATE: Final = Path("/var/lib/velatura")
STAGE: Final = STATE / "stage"
PLAYERS: Final = STAGE / "keys" / "players"
"""There if the stage has outputs on other computers."""
RUNTIME: Final = Path("/run/velatura")
PLAYER_SOCKET: Final = RUNTIME / "player.sock"
PLAYER_OPTIONS: Final = STATE / "player.options"
"""One argument a line, for the player that systemd starts."""
FIRST_LOGIN: Final = "first-login"
"""In the runtime folder: the one-time password of a kiosk whose output goes to the journal, for the installation."""


def is_installed(stage: Path) -> bool:
    """Whether ``stage`` is the one that this computer's services run, and this user is theirs, or root."""
    # First what is asked for nearly nothing: a kiosk asks this at each of its steps.
    try:
        ours = RUNTIME.stat().st_uid == os.getuid() or os.getuid() == 0
    except OSError:
        return False
    return ours and stage.resolve() == STAGE
