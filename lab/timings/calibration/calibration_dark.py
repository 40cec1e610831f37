"""As ``calibration``, in a dark room without indirect light, glare or flicker: the errors of the method alone."""

from __future__ import annotations

from lab.timings import Row
from lab.timings.calibration import calibration


def measure(size: str) -> list[Row]:
    """As ``calibration.measure``."""
    return calibration.measure(size, room="dark")
