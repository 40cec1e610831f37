"""TCP ports for servers that come and go during a test."""

from __future__ import annotations

import contextlib
import random
import socket
from collections.abc import Iterator


@contextlib.contextmanager
def kept_port() -> Iterator[int]:
    """A port of the loopback that is given to no one else meanwhile, also while the test's server does not run.

    Bound and not listening: connections are refused, and a server may still listen there if it sets SO_REUSEADDR, as
    asyncio's and Mosquitto's do on Linux.
    """
    with socket.socket() as kept:
        kept.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        kept.bind(("127.0.0.1", 0))
        yield int(kept.getsockname()[1])


def free_port() -> int:
    """A free port below those that the system gives to outgoing connections, which could take it before its server."""
    for port in random.SystemRandom().sample(range(20000, 32768), 100):
        with contextlib.suppress(OSError), socket.socket() as tried:
            tried.bind(("127.0.0.1", port))
            return port
    raise AssertionError("there is no free port")
