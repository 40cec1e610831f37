"""Live values: soon, for many, and cheap."""

from __future__ import annotations

import contextlib
import json
import threading
import time
from pathlib import Path

import httpx

from controller.panel.context import PanelOptions
from tests.controller.panel.memory_kiosk import MemoryKiosk
from tests.controller.panel.served import Served, served


def test_a_change_is_on_every_one_of_fifty_open_panels_within_a_second(tmp_path: Path) -> None:
    kiosk = MemoryKiosk(tmp_path / "pictures")
    arrivals: list[float] = []
    ready = threading.Semaphore(0)

    def watch(running: Served, cookies: httpx.Cookies) -> None:
        with running.client() as client:
            client.cookies = cookies
            with client.stream("GET", "/live") as stream:
                for line in stream.iter_lines():
                    if line.startswith("data:") and "Playing" in line and "now for all" not in line:
                        ready.release()
                    if "now for all" in line:
                        arrivals.append(time.monotonic())
                        return

    options = PanelOptions(tmp_path / "private")
    with served(kiosk, tmp_path / "private", options=options) as running, running.entered("vera") as vera:
        threads = [threading.Thread(target=watch, args=(running, vera.cookies)) for _ in range(50)]
        for thread in threads:
            thread.start()
        for _ in threads:
            assert ready.acquire(timeout=20)
        time.sleep(0.5)
        began = time.monotonic()
        kiosk.change(reason="now for all")
        for thread in threads:
            thread.join(20)
        assert len(arrivals) == 50
        assert max(arrivals) - began < 1.0


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
                    if "the last one" in messages[-1].get("top", ""):
                        break
        thread.join()
    assert len(messages) <= 14
    assert set(messages[0]) == {"top", "devices", "job", "lamps", "next", "events"}
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


def test_the_first_page_comes_quickly(panel: Served) -> None:
    with panel.entered("tina") as client:
        times = []
        for _ in range(10):
            began = time.monotonic()
            client.get("/")
            times.append(time.monotonic() - began)
    assert min(times) < 0.15
