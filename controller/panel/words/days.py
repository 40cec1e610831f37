"""Days of a schedule as a reader of a language writes them, to and from the words that the kiosk knows.

The kiosk knows English names and dates such as 2026-12-24 (``kiosk.schedule``); in every language these stay right.
"""

from __future__ import annotations

import re
import unicodedata
from dataclasses import dataclass
from datetime import date
from typing import Final

from controller.kiosk.schedule import WEEKDAYS
from controller.panel.words.figures import FIGURES
from controller.panel.words.language import gettext, language, mark

DAILY: Final = mark("daily")
ISO: Final = r"20[0-9]{2}-[01][0-9]-[0-3][0-9]"


@dataclass(frozen=True, slots=True)
class Names:
    """``days`` and ``months`` in their order, of which three letters are enough; ``short`` names of days; ``phrases``
    that stand for something else; ``slashes``: 24/12/2026 is the day first.
    """

    days: tuple[str, ...]
    months: tuple[str, ...] = ()
    short: tuple[str, ...] = ()
    phrases: tuple[tuple[str, str], ...] = ()
    slashes: bool = False


def _names(text: str) -> tuple[str, ...]:
    return tuple(text.split())


NAMES: Final = {
    "en": Names(
        _names("monday tuesday wednesday thursday friday saturday sunday"),
        _names("january february march april may june july august september october november december"),
    ),
    "de": Names(
        _names("montag dienstag mittwoch donnerstag freitag samstag sonntag"),
        _names("januar februar märz april mai juni juli august september oktober november dezember"),
        _names("mo di mi do fr sa so"),
        (("jeden tag", "daily"), ("täglich", "daily"), ("wochenende", "weekend"), ("sonnabend", "sat"), ("bis", "to"),
         ("und", ","), ("jänner", "januar")),
    ),
    "es": Names(
        _names("lunes martes miercoles jueves viernes sabado domingo"),
        _names("enero febrero marzo abril mayo junio julio agosto septiembre octubre noviembre diciembre"),
        (),
        (("todos los dias", "daily"), ("cada dia", "daily"), ("a diario", "daily"), ("diario", "daily"),
         ("fin de semana", "weekend"), ("al", "to"), ("a", "to"), ("hasta", "to"), ("y", ","), ("de", ""), ("del", ""),
         ("los", ""), ("el", "")),
        True,
    ),
    "fr": Names(
        _names("lundi mardi mercredi jeudi vendredi samedi dimanche"),
        _names("janvier fevrier mars avril mai juin juillet aout septembre octobre novembre decembre"),
        _names("lu ma me je ve sa di"),
        (("tous les jours", "daily"), ("chaque jour", "daily"), ("quotidien", "daily"), ("week-end", "weekend"),
         ("au", "to"), ("a", "to"), ("et", ","), ("du", ""), ("le", ""), ("les", "")),
        True,
    ),
    "ja": Names((), (), (), (("毎日", "daily"), ("週末", "weekend"), ("平日", "weekdays"), ("から", "-"), ("まで", ""),
                             ("、", ","), ("・", ","), ("と", ","), ("~", "-"), ("〜", "-"))),
}  # fmt: skip
_JAPANESE: Final = "月火水木金土日"


def canonical(text: str) -> str:
    """What was typed, in the words that the kiosk knows; what is not understood stays, for the kiosk's own message."""
    names = NAMES[language()]
    # Wide letters and accents that a keyboard may not have make no difference.
    plain = unicodedata.normalize("NFKC", text).strip().lower()
    plain = _dates(plain if language() == "ja" else _bare(plain), names)
    for phrase, meaning in names.phrases:
        # Japanese has no spaces between its words.
        found = re.escape(phrase) if language() == "ja" else rf"(?<!\w){re.escape(_bare(phrase))}(?!\w)"
        plain = re.sub(found, f" {meaning} ", plain)
    if language() == "ja":
        plain = re.sub(f"([{_JAPANESE}])(?:曜日?)?", lambda one: f" {WEEKDAYS[_JAPANESE.index(one[1])]} ", plain)
    else:
        plain = re.sub(r"([^\W\d_]+)\.?", lambda one: _weekday(one[1], names) or one[0], plain)
    one_day = rf"\b(?:{'|'.join(WEEKDAYS)})\b"
    plain = re.sub(rf"({one_day})\s+(?={one_day})", r"\1, ", plain)
    return re.sub(r"\s*,\s*", ", ", " ".join(plain.split()))


def written(text: str) -> str:
    """Days as the kiosk groups them, such as "mon-fri", in the present language."""
    shown = [name.removesuffix(".") for name in FIGURES[language()].weekdays]
    named = re.sub(rf"\b(?:{'|'.join(WEEKDAYS)})\b", lambda one: shown[WEEKDAYS.index(one[0])], text)
    named = re.sub(rf"({ISO}) to ({ISO})", "\\1 \u2013 \\2", named)
    return gettext(DAILY) if named == DAILY else named


def _bare(text: str) -> str:
    """Without accents."""
    return "".join(one for one in unicodedata.normalize("NFD", text) if not unicodedata.combining(one))


def _weekday(word: str, names: Names) -> str:
    if word in names.short:
        return WEEKDAYS[names.short.index(word)]
    if len(word) < 3:
        return ""
    return next((day for day, whole in zip(WEEKDAYS, names.days, strict=False) if whole.startswith(word)
                 or word == f"{whole}s"), "")  # fmt: skip


def _dates(text: str, names: Names) -> str:
    day, month, year = "([0-3]?[0-9])", "([01]?[0-9])", "(20[0-9]{2})"
    text = re.sub(rf"{year}年{month}月{day}日", lambda one: _iso(one, 1, 2, 3), text)
    text = re.sub(rf"\b{year}/{month}/{day}\b", lambda one: _iso(one, 1, 2, 3), text)
    text = re.sub(rf"\b{day}\.\s*{month}\.\s*{year}\b", lambda one: _iso(one, 3, 2, 1), text)
    if names.slashes:
        text = re.sub(rf"\b{day}/{month}/{year}\b", lambda one: _iso(one, 3, 2, 1), text)
    return re.sub(rf"\b{day}(?:\.|er|st|nd|rd|th)?\s+(?:de\s+)?([^\W\d_]+)\.?\s+(?:del?\s+)?{year}\b",
                  lambda one: _with_month(one, names), text)  # fmt: skip


def _iso(found: re.Match[str], year: int, month: int, day: int) -> str:
    return f"{found[year]}-{int(found[month]):02d}-{int(found[day]):02d}"


def _with_month(found: re.Match[str], names: Names) -> str:
    word = found[2]
    number = next((n for n, name in enumerate(names.months, 1) if len(word) >= 3 and _bare(name).startswith(word)), 0)
    try:
        return date(int(found[3]), number, int(found[1])).isoformat()
    except ValueError:
        return found[0]
