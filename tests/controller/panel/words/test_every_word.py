"""Walks all pages in all languages: nothing that the panel itself says stays English."""

from __future__ import annotations

import re
import time
from html.parser import HTMLParser

import pytest

from controller.core.errors import UsageError
from controller.panel.words import figures
from controller.panel.words import language as spoken
from controller.panel.words.language import LANGUAGES
from docs.panel_words import words
from tests.controller.panel.served import Served
from tests.controller.panel.test_in_browser import PAGES

READ_ALOUD = ("alt", "aria-label", "title", "placeholder", "data-alt")
WALKED = (*PAGES, "/changes", "/doctor?wait=yes", "/late/doctor", "/reports/first", "/nothing-here")
LEFT, RIGHT = "\u27e6", "\u27e7"
ALLOWED = {"Velatura", "stage", "toml", "CIEDE", *LANGUAGES.values()}
"""Names, which are the same in all languages."""


class Seen(HTMLParser):
    """What a person reads or hears of a page."""

    def __init__(self) -> None:
        super().__init__()
        self.texts: list[str] = []
        self._inside = ""

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag in ("script", "style", "textarea", "code"):
            self._inside = tag
        self.texts += [value for name, value in attrs if name in READ_ALOUD and value]

    def handle_endtag(self, tag: str) -> None:
        if tag == self._inside:
            self._inside = ""

    def handle_data(self, data: str) -> None:
        if not self._inside and data.strip():
            self.texts.append(" ".join(data.split()))


def walked(panel: Served, language: str) -> dict[str, list[str]]:
    """The texts of every page, before the log-in and after it."""
    found = {}
    headers = {"accept-language": language, "accept": "text/html"}
    with panel.client() as client:
        pages = {"/login": client.get("/login", headers=headers).text}
    with panel.entered("tina") as client:
        pages |= {path: client.get(path, headers=headers).text for path in WALKED}
    for path, page in pages.items():
        assert path.startswith("/late") or f'<html lang="{language}">' in page, path
        seen = Seen()
        seen.feed(page)
        found[path] = seen.texts
    return found


@pytest.fixture
def photographed(panel: Served) -> Served:
    if not panel.kiosk.comparisons():
        panel.kiosk.compare()
    while not panel.kiosk.comparisons():
        time.sleep(0.02)
    return panel


@pytest.mark.parametrize("language", [name for name in LANGUAGES if name != "en"])
def test_no_page_has_a_word_that_its_language_has_another_one_for(photographed: Served, language: str) -> None:
    with spoken.speaking(language):
        english = {one.id for one in words() if isinstance(one.id, str) and spoken.gettext(one.id) != one.id}
    kept = {(path, text) for path, texts in walked(photographed, language).items() for text in texts
            if text in english and len(text) > 2}  # fmt: skip
    # Names that a person gave to projectors and appearances are not words.
    named = {"left", "middle", "right"}
    assert not {one for one in kept if one[1] not in named}


def test_all_that_the_panel_itself_says_is_translated(photographed: Served, monkeypatch: pytest.MonkeyPatch) -> None:
    """With a catalogue that marks every word: what has no mark came from the kiosk, or is untranslated."""

    class Marking:
        def gettext(self, text: str) -> str:
            return f"{LEFT}{text}{RIGHT}"

        def ngettext(self, one: str, many: str, count: int) -> str:
            return f"{LEFT}{one if count == 1 else many}{RIGHT}"

    monkeypatch.setattr(spoken, "_catalogue", lambda _: Marking())
    kiosk = photographed.kiosk
    said = repr((
        kiosk.snapshot(), kiosk.events(), kiosk.appearances(), kiosk.results("first"), kiosk.doctor(), kiosk.changes(),
        kiosk.aiming(), kiosk.schedule(), kiosk.lamp_history(), photographed.accounts.all(),
        photographed.accounts.tokens(),
    ))  # fmt: skip
    # Sentences of errors are English in every language; their codes lead to the documentation.
    with pytest.raises(UsageError) as refused:
        kiosk.results("nothing")
    said += f"{refused.value.what} {refused.value.remedy}"
    known = ALLOWED | set(re.findall(r"[^\W\d_]+", said))
    # Dates and numbers have their own tables, which Babel judges.
    known |= {*figures.FIGURES["en"].weekdays, *figures.FIGURES["en"].months, "px"}
    left: dict[str, set[str]] = {}
    for path, texts in walked(photographed, "en").items():
        for text in texts:
            bare = re.sub(f"{LEFT}[^{LEFT}{RIGHT}]*{RIGHT}", "", text)
            bare = re.sub(f"{LEFT}[^{LEFT}{RIGHT}]*{RIGHT}", "", bare)
            if unknown := set(re.findall(r"[^\W\d_]{2,}", bare)) - known:
                left[path] = left.get(path, set()) | unknown
    assert not left
