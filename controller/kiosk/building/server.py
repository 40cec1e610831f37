"""Serves the protocols of building.toml, all in one thread beside the kiosk's."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import threading
from collections.abc import Iterator, Sequence
from typing import Final

from controller.core.errors import VelaturaError
from controller.kiosk.building.protocol import Configured
from controller.kiosk.building.verbs import Verbs
from controller.kiosk.interface import Kiosk

AGAIN_S: Final = (1.0, 5.0, 30.0)
"""Pauses between attempts to listen."""
_LOG: Final = logging.getLogger("velatura.building")


@contextlib.contextmanager
def serving(kiosk: Kiosk, protocols: Sequence[Configured]) -> Iterator[None]:
    """Serve the protocols until the context ends."""
    if not protocols:
        yield
        return
    loop, started = asyncio.new_event_loop(), threading.Event()
    tasks: list[asyncio.Task[None]] = []

    async def run() -> None:
        tasks.extend(asyncio.ensure_future(_kept(one, one.verbs(kiosk), kiosk)) for one in protocols)
        started.set()
        await asyncio.gather(*tasks, return_exceptions=True)

    def work() -> None:
        with contextlib.closing(loop):
            loop.run_until_complete(run())

    thread = threading.Thread(target=work, name="building", daemon=True)
    thread.start()
    started.wait()
    try:
        yield
    finally:
        for task in tasks:
            loop.call_soon_threadsafe(task.cancel)
        thread.join(10.0)


async def _kept(one: Configured, verbs: Verbs, kiosk: Kiosk) -> None:
    """Serve one protocol; if it fails, log that once and try again without end."""
    failed = 0
    while True:
        try:
            await one.protocol.serve(one.options, verbs)
        except Exception as error:  # noqa: BLE001 - one protocol must not end the others
            if not isinstance(error, OSError | VelaturaError):
                _LOG.exception("%s failed.", one.protocol.title)
            if not failed:
                why = f"{error.what} {error.remedy}" if isinstance(error, VelaturaError) else str(error)
                what = f"{one.protocol.title} does not work ({one.options.where}). {why}"
                kiosk.record("building-failed", what, "error")
        pause_s = AGAIN_S[min(failed, len(AGAIN_S) - 1)]
        failed += 1
        await asyncio.sleep(pause_s)


@contextlib.contextmanager
def changes(verbs: Verbs) -> Iterator[asyncio.Event]:
    """An event of the running loop that is set after every change of the kiosk's state, and at the beginning."""
    loop, changed = asyncio.get_running_loop(), asyncio.Event()

    def notify() -> None:
        # A kiosk may change while the loop ends.
        with contextlib.suppress(RuntimeError):
            loop.call_soon_threadsafe(changed.set)

    changed.set()
    leave = verbs.subscribe(notify)
    try:
        yield changed
    finally:
        leave()
