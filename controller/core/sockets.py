"""Unix sockets that other programs wait for."""

from __future__ import annotations

import os
import socket
from pathlib import Path
from typing import Final

LONGEST_PATH_BYTES: Final = 106
"""The system's 107, less the dot of the name that it has before it takes connections."""


def listening(path: Path, backlog: int) -> socket.socket:
    """A stream socket at ``path``, for this user alone, in the place of what was there.

    It appears there when it takes connections: whoever sees it is not refused. Raises OSError.
    """
    before_it_listens = path.with_name(f".{path.name}")
    before_it_listens.unlink(missing_ok=True)
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    mask = os.umask(0o177)
    try:
        listener.bind(str(before_it_listens))
        listener.listen(backlog)
        before_it_listens.replace(path)
    except OSError:
        listener.close()
        raise
    finally:
        os.umask(mask)
    return listener


__all__ = ["LONGEST_PATH_BYTES", "listening"]
