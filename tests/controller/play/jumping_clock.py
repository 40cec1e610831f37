"""A player in a process whose wall clock jumps by up to ten years, back or forward, each time that somebody reads it.

``python -m tests.controller.play.jumping_clock ARGUMENTS OF THE PLAYER``. What reads the kernel's clock without Python
is not deceived; the player's waiting in the kernel is monotonic by its nature (select, nanosleep).
"""

from __future__ import annotations

import datetime
import random
import sys
import time
from collections.abc import Callable
from typing import Any, Final

_TEN_YEARS_S: Final = 315_360_000


def _jumps(clock: Callable[..., Any], scale: int) -> Callable[..., Any]:
    randomly = random.Random(7)
    return lambda *arguments: clock(*arguments) + scale * randomly.randrange(-_TEN_YEARS_S, _TEN_YEARS_S)


class JumpingDate(datetime.datetime):
    """A calendar that shows another day at each look."""

    @classmethod
    def now(cls, tz: datetime.tzinfo | None = None) -> JumpingDate:
        return cls.fromtimestamp(time.time(), tz)


def deceive() -> None:
    """Make the wall clock of this process jump."""
    real = time.clock_gettime
    time.time, time.time_ns = _jumps(time.time, 1), _jumps(time.time_ns, 10**9)
    jumping = _jumps(real, 1)
    time.clock_gettime = lambda clock: jumping(clock) if clock == time.CLOCK_REALTIME else real(clock)
    datetime.datetime = JumpingDate  # type: ignore[misc]


if __name__ == "__main__":
    deceive()
    assert abs(time.time() - time.time()) > 1, "this clock does not jump"
    # Only now, so that nothing has a clock of its own yet.
    from controller.play.__main__ import main

    sys.exit(main())
