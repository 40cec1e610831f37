"""Live values: for many, and cheap. How soon they come is measured by `python -m lab.timings serve`."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import json
import re
import threading
import time
from pathlib import Path

import httpx
import pytest

from controller.panel import live
from controller.panel.context import PanelOptions
from controller.panel.live import Hub
from tests.controller.panel.memory_kiosk import MemoryKiosk
from tests.controller.panel.served import Served, served
from tests.waiting import wait_for


def test_a_change_is_on_every_one_of_fifty_open_panels(tmp_path: Path) -> None:
    kiosk = MemoryKiosk(tmp_path / "pictures")
    arrived: list[str] = []
    ready = threading.Semaphore(0)

    def watch(running: Served, cookies: httpx.Cookies) -> None:
        with running.client() as client:
            client.cookies = cookies
            with client.stream("GET", "/live") as stream:
                for line in stream.iter_lines():
                    if line.startswith("data:") and "Playing" in line and "Now for all" not in line:
                        ready.release()
                    if "Now for all" in line:
                        arrived.append(line)
                        return

    options = PanelOptions(tmp_path / "private")
    with served(kiosk, tmp_path / "private", options=options) as running, running.entered("vera") as vera:
        threads = [threading.Thread(target=watch, args=(running, vera.cookies)) for _ in range(50)]
        for thread in threads:
            thread.start()
        for _ in threads:
            assert ready.acquire(timeout=20)
        kiosk.change(reason="now for all")
        for thread in threads:
            thread.join(20)
        assert len(arrived) == 50


def test_a_change_while_the_first_picture_is_drawn_is_not_lost() -> None:
    texts = ["old"]

    async def story() -> list[str]:
        def draw(_: str) -> dict[str, str]:
            text = texts[-1]
            if text == "old":
                texts.append("new")
                hub.changed()
                time.sleep(0.3)  # long enough for the hub to hear of it while no one is served yet
            return {"top": text}

        hub = Hub(draw, frames_per_s=100, most=1)
        running = asyncio.create_task(hub.run())
        await asyncio.sleep(0)
        stream = hub.stream(lambda: True)
        try:
            async with asyncio.timeout(10):
                return [await anext(stream), await anext(stream)]
        finally:
            running.cancel()

    first, second = asyncio.run(story())
    assert "old" in first
    assert "new" in second


def test_a_change_whose_drawing_fails_is_drawn_when_it_can_be(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live, "AGAIN_S", 0.01)
    texts, failures = ["old"], list[Exception]()

    def draw(_: str) -> dict[str, str]:
        if failures:
            raise failures.pop()
        return {"top": texts[-1]}

    async def story() -> str:
        hub = Hub(draw, frames_per_s=100, most=1)
        running = asyncio.create_task(hub.run())
        stream = hub.stream(lambda: True)
        await anext(stream)
        await asyncio.sleep(0.1)  # the drawing at the beginning is over
        texts.append("new")
        failures.append(OSError("Too many open files"))
        hub.changed()
        try:
            async with asyncio.timeout(10):
                return await anext(stream)
        finally:
            running.cancel()

    assert "new" in asyncio.run(story())


def test_what_was_drawn_before_the_first_picture_does_not_come_after_it() -> None:
    drawn = itertools.count()

    async def story() -> str:
        hub = Hub(lambda _: {"top": str(next(drawn))}, frames_per_s=100, most=2)
        running = asyncio.create_task(hub.run())
        first = hub.stream(lambda: True)
        await anext(first)
        second = hub.stream(lambda: True)
        hub.changed()
        opening = await anext(second)
        try:
            async with asyncio.timeout(0.3):
                opening += await anext(second)
        except TimeoutError:
            pass
        finally:
            running.cancel()
        return opening

    numbers = [int(found) for found in re.findall(r'"top": "(\d+)"', asyncio.run(story()))]
    assert numbers == sorted(numbers)


def test_a_storm_of_changes_is_drawn_a_few_times_only(tmp_path: Path) -> None:
    kiosk = MemoryKiosk(tmp_path / "pictures")
    messages: list[dict[str, str]] = []
    options = PanelOptions(tmp_path / "private", frames_per_s=5)
    with served(kiosk, tmp_path / "private", options=options) as running, running.entered("vera") as vera:
        stop = threading.Event()

        def storm() -> None:
            number = 0
            while not stop.wait(0.001):
                number += 1
                kiosk.change(reason=f"change {number}")
            kiosk.change(reason="the last one")

        thread = threading.Thread(target=storm)
        thread.start()
        began = time.monotonic()
        with vera.stream("GET", "/live") as stream:
            for line in stream.iter_lines():
                if line.startswith("data:"):
                    messages.append(json.loads(line[5:]))
                    if time.monotonic() - began > 1.5:
                        stop.set()
                    if "The last one" in messages[-1].get("top", ""):
                        break
        thread.join()
    assert len(messages) <= 14
    assert set(messages[0]) == {"top", "devices", "job", "lamps", "next", "events", "around", "first", "made"}
    assert all(set(message) == {"top"} for message in messages[1:])


def test_who_logs_out_is_told_nothing_more(fresh: Served) -> None:
    with fresh.entered("vera") as vera, fresh.entered("tina") as tina:
        assert tina.get("/").status_code == 200
        lines: list[str] = []
        with vera.stream("GET", "/live") as stream:
            iterator = stream.iter_lines()
            while not lines or not lines[-1].startswith("data:"):
                lines.append(next(iterator))
            fresh.app.state.panel.sessions.end_all("vera")
            fresh.kiosk.identify(True)
            rest = list(iterator)
        assert sum("Each projector shows" in line for line in rest) <= 1


def test_asking_only_for_the_headers_leaves_the_connection_free(fresh: Served) -> None:
    with fresh.entered("vera") as vera:
        cookies = vera.cookies
    limits = httpx.Limits(max_connections=1)
    with httpx.Client(base_url=fresh.address, cookies=cookies, limits=limits, timeout=20, trust_env=False) as client:
        for _ in range(3):
            answer = client.head("/live")
            assert (answer.status_code, answer.headers["content-type"]) == (200, "text/event-stream; charset=utf-8")
        with client.stream("GET", "/live") as stream:
            assert any(line.startswith("data:") for line in stream.iter_lines())


def test_too_many_panels_are_refused_and_come_back_later(tmp_path: Path) -> None:
    options = PanelOptions(tmp_path / "private", most_open_panels=1)
    kiosk = MemoryKiosk(tmp_path / "pictures")
    with contextlib.ExitStack() as held:
        running = held.enter_context(served(kiosk, tmp_path / "private", options=options))
        vera, otto = held.enter_context(running.entered("vera")), held.enter_context(running.entered("otto"))
        stream = held.enter_context(vera.stream("GET", "/live"))
        lines = stream.iter_lines()
        next(lines)
        assert "event: full" in otto.get("/live").text
        stream.close()
        wait_for(lambda: _has_a_place(otto))


def _has_a_place(client: httpx.Client) -> bool:
    with client.stream("GET", "/live") as stream:
        return next(line for line in stream.iter_lines() if line.startswith("event: ")) == "event: parts"
