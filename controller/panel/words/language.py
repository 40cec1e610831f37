"""Which language a visitor reads, and the panel's words in it."""

from __future__ import annotations

import contextlib
import functools
import gettext as catalogues
from collections.abc import Iterator
from contextvars import ContextVar
from importlib import resources
from typing import Final

LANGUAGES: Final = {"en": "English", "de": "Deutsch", "es": "Español", "fr": "Français", "ja": "日本語"}
"""Each by its own name. English is what the code says."""
COOKIE: Final = "velatura-language"
LOOKS: Final = ("", "dark", "light")
"""Of pages; empty: as the device asks."""
LOOK_COOKIE: Final = "velatura-look"
_spoken: ContextVar[str] = ContextVar("language", default="en")
_look: ContextVar[str] = ContextVar("look", default="")


def chosen(cookie: str, accepted: str) -> str:
    """The language that a person has set, else the one that the browser likes best (Accept-Language), else English."""
    if cookie in LANGUAGES:
        return cookie
    liked: list[tuple[float, int, str]] = []
    for place, part in enumerate(accepted[:500].split(",")):
        name, _, weight = part.strip().partition(";q=")
        language = name.strip().lower().split("-")[0]
        try:
            wanted = float(weight) if weight else 1.0
        except ValueError:
            continue
        if language in LANGUAGES and 0 < wanted <= 1:
            liked.append((-wanted, place, language))
    return min(liked)[2] if liked else "en"


def language() -> str:
    """The language of the present request."""
    return _spoken.get()


def look() -> str:
    """The look of the present request's page."""
    return _look.get()


@contextlib.contextmanager
def speaking(name: str, looks: str = "") -> Iterator[None]:
    """In this context, also in threads started with it, the panel speaks ``name``, and its pages look so."""
    before, looked = _spoken.set(name), _look.set(looks if looks in LOOKS else "")
    try:
        yield
    finally:
        _spoken.reset(before)
        _look.reset(looked)


@functools.cache
def _catalogue(name: str) -> catalogues.NullTranslations:
    if name == "en":
        return catalogues.NullTranslations()
    with resources.files("controller.panel.words").joinpath(f"{name}.mo").open("rb") as file:
        return catalogues.GNUTranslations(file)


def gettext(text: str) -> str:
    """``text`` in the present language; what the catalogue does not have stays English."""
    # A catalogue keeps its own head under the empty text.
    return _catalogue(language()).gettext(text) if text else ""


def ngettext(one: str, many: str, count: int) -> str:
    """The text for ``count`` things in the present language."""
    return _catalogue(language()).ngettext(one, many, count)


def mark(text: str) -> str:
    """``text`` itself; it says that the catalogues must have it, because it is translated where it is shown."""
    return text
