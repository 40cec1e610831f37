"""Where an sACN stream goes."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Target:
    """Where the stream goes. ``multicast``: to the universe's group; then ``interface`` is an own IPv4 address or "".

    ``identity``: the source's 16 bytes, in hex, the same after a restart.
    """

    host: str
    port: int
    universe: int
    priority: int
    multicast: bool
    interface: str
    identity: str
