"""What sACN and Art-Net share: the settings of a lighting desk, and showing what its levels ask for."""

from __future__ import annotations

import asyncio
import logging
import time
from typing import Final, Literal, Never

from pydantic import Field

from controller.core.errors import VelaturaError
from controller.kiosk.building.dmx import Follower, Sources
from controller.kiosk.building.protocol import NetworkOptions
from controller.kiosk.building.verbs import Verbs

STEP_S: Final = 0.05
_LOG: Final = logging.getLogger("velatura.building")


class DeskOptions(NetworkOptions):
    """``channel``: the first of the three, 1 to 510. ``lost``: whether the picture stays without a signal, or is
    black.
    """

    channel: int = Field(default=1, ge=1, le=510)
    lost: Literal["stay", "black"] = "stay"


async def follow(sources: Sources, options: DeskOptions, verbs: Verbs) -> Never:
    """Show what the source that counts asks for, until cancelled."""
    follower = Follower(dark_when_lost=options.lost == "black")
    while True:
        await asyncio.sleep(STEP_S)
        now_s = time.monotonic()
        await asyncio.to_thread(_step, follower, sources.levels(now_s), verbs, now_s)


def _step(follower: Follower, levels: tuple[int, int, int] | None, verbs: Verbs, now_s: float) -> None:
    try:
        for verb, values in follower.verbs(levels, verbs.status(), verbs.appearances(), now_s):
            verbs.do(verb, values)
    except VelaturaError:
        # A stage that is not set up, or that closes at this moment; the desk goes on sending.
        _LOG.debug("A level could not be followed.", exc_info=True)
