"""When a device that is missing is tried again."""

from __future__ import annotations

from typing import Final

LONGEST_S: Final = 15.0
"""Not longer, because a person who plugs a cable in again waits for the result."""
_SHORTEST_S: Final = 2.0
_SHARE: Final = 0.25


def pause_s(missing_s: float) -> float:
    """Seconds until the next attempt, for a device that has been missing for ``missing_s``.

    A share of that time: what is back after half a minute, as a projector that boots, is not waited for much longer.
    """
    return min(LONGEST_S, max(_SHORTEST_S, _SHARE * missing_s))
