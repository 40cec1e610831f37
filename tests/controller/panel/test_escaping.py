"""Devices, files and log lines say what they like; it stays text."""

from __future__ import annotations

import json
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import pytest

from controller.kiosk.state import DeviceRow, Grade, Job, JobStep, Lamp, LiveValue, NextEvent
from controller.kiosk.values import Appearance, Schedule, ScheduleRow
from tests.controller.panel.memory_kiosk import MemoryKiosk
from tests.controller.panel.served import served

CORPUS = (
    "<script>alert(1)</script>",
    '"><img src=x onerror=alert(1)>',
    "' autofocus onfocus=alert(1) x='",
    "</textarea><script>alert(1)</script>",
    "</title><svg/onload=alert(1)>",
    "javascript:alert(1)",
    "{{ 7 * 7 }}{% raw %}",
    "<!--<script>-->",
    "\u202eevil\u0000\x1b[31m",
    "&lt;script&gt;",
    "data: x\n\nevent: parts\ndata: {}",
    "]]><x/>",
    "<a href='http://evil.example'>x</a>",
    "${alert(1)}`",
    "\ud83d\ude00 é ß 漢字",
)


class Elements(HTMLParser):
    """Counts what could run: elements, attributes that are code, addresses elsewhere."""

    def __init__(self) -> None:
        super().__init__()
        self.bad: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        names = dict(attrs)
        if tag == "script" and names.get("src") not in ("/static/panel.js", "/static/looks.js"):
            self.bad.append("script")
        if tag in ("iframe", "object", "embed", "b-evil", "x") or (tag == "svg" and "viewbox" not in names):
            self.bad.append(tag)
        self.bad += [name for name in names if name.startswith("on") or name in ("style", "autofocus")]
        for name in ("href", "src", "action", "formaction"):
            value = names.get(name) or "/"
            if not value.startswith(("/", "#")) or value.startswith("//"):
                self.bad.append(value)


def poisoned(folder: Path, text: str) -> MemoryKiosk:
    """A kiosk all of whose texts are ``text``."""
    kiosk = MemoryKiosk(folder)
    kiosk.note("error", text, text)
    value = (LiveValue(text, text),)
    kiosk.change(
        stage=text,
        reason=text,
        playing=text,
        devices=(DeviceRow(text, "projector", text, value, text, text), DeviceRow(text, text, text, value)),
        job=Job(1, text, (JobStep(text, 0.5),), 3.0),
        next_event=NextEvent(text, 0.0),
        lamps=(Lamp(text, 1.0, 1, True),),
        grades=(Grade(text, 0.0, text, text, True, None, text),),
    )
    kiosk._appearances = {text: Appearance(text, 0.0, preview=folder / "0.png")}
    kiosk._results = {"first": replace(kiosk._results["first"], figures=((text, text),))}
    kiosk._schedule = Schedule(text, (ScheduleRow(text, "10:00", "11:00", text),), text)
    kiosk._toml = text
    return kiosk


@pytest.mark.parametrize("number", range(len(CORPUS)))
def test_hostile_text_stays_text_on_every_page(tmp_path: Path, number: int) -> None:
    text = CORPUS[number].encode("utf-16", "surrogatepass").decode("utf-16", "replace")
    with (
        served(poisoned(tmp_path / "pictures", text), tmp_path / "private") as running,
        running.entered("tina") as client,
    ):
        for entry in running.app.state.entries:
            if (
                entry.method == "GET"
                and entry.way == "session"
                and "{" not in entry.path
                and entry.path.count("/") == 1
            ):
                if entry.path == "/live":
                    continue
                answer = client.get(entry.path)
                elements = Elements()
                elements.feed(answer.text)
                assert not elements.bad, (entry.path, elements.bad)
                assert answer.status_code == 200, entry.path
        with client.stream("GET", "/live") as stream:
            lines = stream.iter_lines()
            first = [next(lines) for _ in range(4)]
            assert [line.partition(":")[0] for line in first] == ["retry", "id", "event", "data"]
            for part in json.loads(first[3].removeprefix("data: ")).values():
                elements = Elements()
                elements.feed(part)
                assert not elements.bad, elements.bad
