"""Days of a schedule in five languages, judged by the kiosk's own reading of English and by Babel's names."""

from __future__ import annotations

import unicodedata
from datetime import date, timedelta
from typing import Literal, TypeAlias

import pytest
from babel.dates import get_day_names, get_month_names
from hypothesis import given
from hypothesis import strategies as st

from controller.kiosk.schedule import WEEKDAYS, days_of, grouped
from controller.kiosk.values import ScheduleRow
from controller.panel.words.days import canonical, written
from controller.panel.words.language import LANGUAGES, speaking
from tests.controller.panel.served import Served, csrf

Width: TypeAlias = Literal["wide", "abbreviated", "short"]


def read(language: str, text: str) -> str:
    with speaking(language):
        return " ".join(days_of(canonical(text)))


@pytest.mark.parametrize("language", LANGUAGES)
@pytest.mark.parametrize("number", range(7))
def test_every_name_of_a_day_is_understood_in_its_language(language: str, number: int) -> None:
    widths: list[Width] = ["wide", "abbreviated"]
    if language in ("de", "fr"):
        widths.append("short")
    for width in widths:
        name = get_day_names(width, "format", locale=language)[number]
        for text in (name, name.upper(), name.removesuffix(".")):
            assert read(language, text) == WEEKDAYS[number], text
    assert read(language, WEEKDAYS[number]) == WEEKDAYS[number], "English stays right"


@pytest.mark.parametrize("language", ["en", "de", "es", "fr"])
@pytest.mark.parametrize("month", range(1, 13))
def test_every_name_of_a_month_is_understood_in_its_language(language: str, month: int) -> None:
    name, day = get_month_names("wide", "format", locale=language)[month], date(2026, month, 7)
    between = " de " if language == "es" else ". " if language == "de" else " "
    assert read(language, f"7{between}{name}{' de ' if language == 'es' else ' '}2026") == str(day)
    assert read(language, f"7 {name[:4]} 2026") == str(day)


@pytest.mark.parametrize(
    ("language", "text", "days"),
    [
        ("de", "Mo-Fr", "mon tue wed thu fri"), ("de", "Montag bis Mittwoch", "mon tue wed"),
        ("de", "Sa und So", "sat sun"),
        ("de", "täglich", " ".join(WEEKDAYS)), ("de", "Wochenende", "sat sun"), ("de", "Sonnabend", "sat"),
        ("de", "24.12.2026", "2026-12-24"), ("de", "24.12.2026 bis 26. 12. 2026", "2026-12-24 2026-12-25 2026-12-26"),
        ("es", "de lunes a viernes", "mon tue wed thu fri"), ("es", "sábado y domingo", "sat sun"),
        ("es", "todos los días", " ".join(WEEKDAYS)), ("es", "24/12/2026", "2026-12-24"), ("es", "miércoles", "wed"),
        ("fr", "du lundi au vendredi", "mon tue wed thu fri"), ("fr", "sam. et dim.", "sat sun"), ("fr", "di", "sun"),
        ("fr", "1er mai 2026", "2026-05-01"), ("fr", "tous les jours", " ".join(WEEKDAYS)), ("de", "di", "tue"),
        ("ja", "月曜日から金曜日まで", "mon tue wed thu fri"), ("ja", "土日", "sat sun"),
        ("ja", "月～水", "mon tue wed"),
        ("ja", "毎日", " ".join(WEEKDAYS)), ("ja", "2026年12月24日", "2026-12-24"),
        ("ja", "２０２６/１２/２４", "2026-12-24"),
        ("en", "24 December 2026", "2026-12-24"), ("en", "05/06/2026", ""), ("de", "31.02.2026", ""),
        ("fr", "demain", ""),
        ("de", "irgendwann", ""), ("es", "a", ""),
    ],
)  # fmt: skip
def test_a_day_is_understood_as_people_write_it(language: str, text: str, days: str) -> None:
    assert read(language, text) == days


@given(
    st.sampled_from(sorted(LANGUAGES)),
    st.sets(st.sampled_from((*WEEKDAYS, *(str(date(2026, 12, 20) + timedelta(n)) for n in range(9)))), min_size=1),
)
def test_what_the_form_shows_is_understood_again(language: str, days: set[str]) -> None:
    rows = grouped([ScheduleRow(day, "10:00", "18:00") for day in sorted(days)])
    with speaking(language):
        assert {day for row in rows for day in days_of(canonical(written(row.day)))} == days


@given(st.sampled_from(sorted(LANGUAGES)), st.text(max_size=40))
def test_any_text_is_read(language: str, text: str) -> None:
    assert unicodedata.is_normalized("NFC", read(language, text))


def test_a_german_form_takes_german_days_and_shows_them_again(fresh: Served) -> None:
    with fresh.entered("otto") as client:
        german = {"accept-language": "de"}
        page = client.get("/schedule", headers=german).text
        form = {"csrf": csrf(page), "time_zone": "Europe/Vienna", "drift_check": "", "day": ["Di bis Do", "24.12.2026"],
                "opens": ["10:00", ""], "closes": ["18:00", ""], "appearance": ["", ""]}  # fmt: skip
        saved = client.post("/do/set-schedule", data=form, headers=german | {"origin": fresh.address})
        assert saved.status_code == 303, saved.text
        assert [row.day for row in fresh.kiosk.schedule().rows] == ["tue", "wed", "thu", "2026-12-24"]
        assert 'value="Di-Do"' in client.get("/schedule", headers=german).text
        assert 'value="火-木"' in client.get("/schedule", headers={"accept-language": "ja"}).text
        form["day"] = ["irgendwann", "24.12.2026"]
        wrong = client.post("/do/set-schedule", data=form, headers=german | {"origin": fresh.address})
        assert (wrong.status_code, 'value="irgendwann"' in wrong.text) == (422, True)
