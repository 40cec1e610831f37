from __future__ import annotations

import json
import re
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from controller.stage.report.page import Goal, Page, PictureRow, ReportPicture, nearness, render, write_report

GREY = np.full((6, 8, 3), 128, np.uint8)
EVIL = "<script>alert('x')</script><img src=x onerror=\"y\">&amp;"


def page(text: str = "plain") -> Page:
    picture = ReportPicture(text, GREY, text, points=(text, f"run `{text}` again"))
    return Page(
        title=text,
        summary=text,
        goals=(Goal(text, text, text, True, text), Goal("no goal", "1"), Goal("missed", "2", "1", False)),
        rows=(PictureRow(text, nearness(1.5, 0.9), ((text, text),), (picture, picture)),),
        galleries=((text, text, (picture,)),),
        steps=((text, 1.5), ("nothing", 0.0)),
        facts={text: text},
    )


class Elements(HTMLParser):
    """Every element of a page with its attributes, and all of its text."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.found: list[tuple[str, dict[str, str | None]]] = []
        self.text: list[str] = []
        self.feed(html)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found.append((tag, dict(attrs)))

    def handle_data(self, data: str) -> None:
        self.text.append(data)


def test_text_from_devices_is_shown_and_never_run() -> None:
    plain, evil = Elements(render(page())), Elements(render(page(EVIL)))
    assert [tag for tag, _ in evil.found] == [tag for tag, _ in plain.found]
    assert not any(name.startswith("on") for _, attributes in evil.found for name in attributes)
    assert "".join(evil.text).count(EVIL) >= 8


@settings(max_examples=25, deadline=None)
@given(text=st.text(alphabet=st.characters(exclude_categories=["Cs"]), min_size=1, max_size=40))
def test_no_text_changes_the_pages_elements(text: str) -> None:
    assert [tag for tag, _ in Elements(render(page(text))).found] == [tag for tag, _ in Elements(render(page())).found]


def test_every_picture_is_in_the_page_itself() -> None:
    html = render(page())
    sources = [attributes["src"] or "" for tag, attributes in Elements(html).found if tag == "img"]
    assert len(sources) == 4
    assert all(source.startswith("data:image/jpeg;base64,") for source in sources)
    assert not re.search(r"https?:|<link|<script|@import|url\((?!data:font/ttf;base64,)", html)


def test_pictures_and_how_near_they_are_come_before_every_figure_and_criterion() -> None:
    first = render(page()).partition("<details")[0]
    assert first.count("<figure>") == 2
    assert re.search(r"Very near <b>1.5</b> <span[^>]*>on 90% of the object</span>", first)
    assert "not reached" not in first
    assert "not reached" in render(page())


@pytest.mark.parametrize(
    ("delta_e", "words"), [(0.4, "No visible difference"), (3.9, "Near"), (9.0, "Not near"), (float("nan"), "Not near")]
)
def test_a_difference_has_words(delta_e: float, words: str) -> None:
    assert nearness(delta_e, 1.0).words == words
    assert nearness(delta_e, None).part == ""


def test_a_command_in_a_point_is_code() -> None:
    shown = render(
        Page("", "", (), (), galleries=(("", "", (ReportPicture("", GREY, points=("run `velatura drift`",)),)),))
    )
    assert "run <code>velatura drift</code>" in shown


def test_goals_say_whether_they_were_reached() -> None:
    html = render(page())
    assert html.count('class="good"') == 1
    assert html.count('class="bad"') == 1


def test_a_page_with_nothing_on_it_is_a_page() -> None:
    html = render(Page("empty", "", (), ()))
    assert "empty" in html


def test_both_files_are_written_and_json_holds_only_numbers(tmp_path: Path) -> None:
    figures: dict[str, Any] = {"captures": {"count": 3}, "none": None}
    html, machine = write_report(tmp_path / "new", page(), figures)
    assert json.loads(machine.read_text()) == figures
    assert html.read_text().startswith("<!doctype html>")


def test_a_figure_that_is_no_number_is_null_and_costs_no_other(tmp_path: Path) -> None:
    _, machine = write_report(tmp_path, page(), {"rms": float("nan"), "rows": [{"a": float("inf"), "b": 0.5}]})
    assert json.loads(machine.read_text()) == {"rms": None, "rows": [{"a": None, "b": 0.5}]}
