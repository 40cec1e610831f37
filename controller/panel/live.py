"""Server-sent events: each change is rendered once for each language that is read, however many panels are open."""

from __future__ import annotations

import asyncio
import json
import logging
from collections.abc import AsyncIterator, Callable
from typing import Final

import anyio

KEEP_ALIVE_S: Final = 2.0
"""A page that hears nothing for three times as long says so."""
QUEUED: Final = 8
AGAIN_S: Final = 1.0
"""Pause after a failed rendering."""
_LOG: Final = logging.getLogger("velatura.panel")

Draw = Callable[[str], dict[str, str]]
"""The live parts in a language, by name."""


class Hub:
    """Renders the live parts after a change, at most ``frames_per_s`` times a second, for all open panels.

    ``draw`` returns the HTML of each part in a language, by name; it runs in a thread. Use it on the event loop of
    ``run``; only ``changed`` and ``end`` may be called from any thread.
    """

    def __init__(self, draw: Draw, *, frames_per_s: float, most: int) -> None:
        self._draw, self._pause_s, self._most = draw, 1.0 / frames_per_s, most
        self._parts: dict[str, dict[str, str]] = {}
        self._listeners: dict[asyncio.Queue[str], str] = {}
        self._loop: asyncio.AbstractEventLoop | None = None
        self._dirty = asyncio.Event()
        self._drawing = asyncio.Lock()
        self._number = 0
        self._ended = False

    @property
    def listening(self) -> int:
        return len(self._listeners)

    def changed(self) -> None:
        """Report a change; returns at once."""
        loop = self._loop
        if loop is not None and not loop.is_closed():
            loop.call_soon_threadsafe(self._dirty.set)

    def end(self) -> None:
        """End the streams of all open panels. Their pages reconnect after the next start."""
        loop = self._loop
        if loop is not None and not loop.is_closed():
            loop.call_soon_threadsafe(self._end)

    def _end(self) -> None:
        self._ended = True
        for queue in tuple(self._listeners):
            _put(queue, ": the service ends\n\n")

    async def run(self) -> None:
        """Render after every change, until cancelled; does nothing while no panel is open."""
        self._loop = asyncio.get_running_loop()
        self._dirty.set()
        while True:
            await self._dirty.wait()
            self._dirty.clear()
            if self._listeners:
                try:
                    await self._redraw()
                except Exception:  # noqa: BLE001 - one failure must not end the live updates
                    _LOG.exception("The live parts could not be rendered.")
                    # The change is not shown yet, and will not be reported again.
                    self._dirty.set()
                    await asyncio.sleep(AGAIN_S)
            await asyncio.sleep(self._pause_s)

    async def _redraw(self) -> None:
        async with self._drawing:
            for language in dict.fromkeys(self._listeners.values()):
                await self._draw_and_send(language)

    async def _draw_and_send(self, language: str) -> None:
        parts = await anyio.to_thread.run_sync(self._draw, language)
        before = self._parts.get(language, {})
        changed = {name: html for name, html in parts.items() if before.get(name) != html}
        self._parts[language] = parts
        if changed:
            self._number += 1
            message = self._message(changed)
            for queue, read in tuple(self._listeners.items()):
                if read == language:
                    _put(queue, message)

    def _message(self, parts: dict[str, str]) -> str:
        return f"id: {self._number}\nevent: parts\ndata: {json.dumps(parts)}\n\n"

    async def stream(self, alive: Callable[[], bool], language: str = "en") -> AsyncIterator[str]:
        """The events of one panel in its language: first all parts, then the changed ones, until ``alive`` is false
        (logged out).
        """
        if len(self._listeners) >= self._most:
            yield "retry: 10000\nevent: full\ndata: {}\n\n"
            return
        queue: asyncio.Queue[str] = asyncio.Queue(QUEUED)
        # Before rendering, so that a change in the meantime is sent, too.
        self._listeners[queue] = language
        try:
            # All open panels get it, because later changes are computed against the last rendering.
            await self._redraw()
            _empty(queue)
            yield "retry: 1000\n" + self._message(self._parts[language])
            while alive() and not self._ended:
                try:
                    yield await asyncio.wait_for(queue.get(), KEEP_ALIVE_S)
                except TimeoutError:
                    yield "event: still\ndata: {}\n\n"
        finally:
            self._listeners.pop(queue, None)


def _put(queue: asyncio.Queue[str], message: str) -> None:
    """A panel that does not read its events is asked to reload."""
    if queue.full():
        _empty(queue)
        message = "event: reload\ndata: {}\n\n"
    queue.put_nowait(message)


def _empty(queue: asyncio.Queue[str]) -> None:
    while not queue.empty():
        queue.get_nowait()
