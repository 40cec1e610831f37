"""The panel's words in five languages: complete, same placeholders, and figures as each language writes them."""

from __future__ import annotations

import ast
import re
from datetime import datetime
from pathlib import Path

import pytest
from babel.dates import get_day_names, get_month_names
from babel.numbers import format_decimal, format_percent
from hypothesis import given
from hypothesis import strategies as st

from controller.kiosk.decide.interfaces import TITLES, Condition
from controller.kiosk.roles import Role
from controller.kiosk.state import LiveValue
from controller.kiosk.supervisors.devices import DARK_ENOUGH, TOO_BRIGHT
from controller.panel.words import figures, spoken
from controller.panel.words.language import COOKIE, LANGUAGES, chosen, gettext, ngettext, speaking
from controller.stage.steps.appearance.requests import TITLES as SOURCE_TITLES
from docs.panel_words import PANEL, WORDS, catalogue, compiled, words
from tests.controller.panel.served import Served

KIOSK = PANEL.parent / "kiosk"
OTHERS = [name for name in LANGUAGES if name != "en"]
PLACEHOLDER = re.compile(r"%\([a-z]+\)[sd]|%%|\{[a-z0-9]+\}")


@pytest.mark.parametrize("language", OTHERS)
def test_every_word_has_its_translation_and_no_other_is_kept(language: str) -> None:
    kept = {(one.id, one.context): one for one in catalogue(language) if one.id}
    asked = {(one.id, one.context) for one in words() if one.id}
    assert set(kept) == asked, "bring the catalogues up to date: python -m docs.panel_words"
    for one in kept.values():
        assert not one.fuzzy, one.id
        originals = (one.id,) if isinstance(one.id, str) else one.id
        translations = (one.string,) if isinstance(one.string, str) else tuple(one.string or ())
        assert translations, one.id
        for text in translations:
            assert text.strip(), one.id
            assert sorted(PLACEHOLDER.findall(text)) == sorted(PLACEHOLDER.findall(originals[-1])), text
            assert text[:1].isspace() == originals[0][:1].isspace()


@pytest.mark.parametrize("language", OTHERS)
def test_what_the_panel_reads_is_compiled_from_what_people_write(language: str) -> None:
    assert (WORDS / f"{language}.mo").read_bytes() == compiled(language), "run python -m docs.panel_words"


def test_no_word_of_the_code_is_overlooked() -> None:
    """By the syntax tree, because the collection reads tokens and sees nothing inside an f-string."""
    said = set()
    for file in PANEL.rglob("*.py"):
        for node in ast.walk(ast.parse(file.read_text())):
            if (
                isinstance(node, ast.Call)
                and isinstance(node.func, ast.Name)
                and node.func.id in ("gettext", "mark", "_")
            ):
                said |= {part.value for part in node.args if isinstance(part, ast.Constant)}
    assert said <= {one.id for one in words()}


def test_no_template_has_a_bare_word() -> None:
    """Text between the tags, and in what is read aloud, that is not marked for translation."""
    allowed = ("Velatura", "stage.toml")
    bare = []
    for file in sorted((PANEL / "templates").glob("*.html")):
        text = re.sub(r"\{#.*?#\}|\{%.*?%\}", "", file.read_text(), flags=re.DOTALL)
        text = re.sub(r"\{\{.*?\}\}", "", text, flags=re.DOTALL)
        shown = re.findall(r">([^<>]+)<", text) + re.findall(r'(?:alt|aria-label|title|placeholder)="([^"]+)"', text)
        bare += [(file.name, part.strip()) for part in shown if part.strip(" -\n") not in ("", *allowed)]
    assert not [one for one in bare if re.search(r"[A-Za-z]{2}", one[1])]


def test_the_kiosks_own_words_are_all_known() -> None:
    assert set(TITLES.values()) == set(spoken.JOBS)
    assert set(SOURCE_TITLES) == set(spoken.SOURCES)
    assert {role.name.lower() for role in Role} == set(spoken.ROLES)


def test_every_reason_that_is_translated_is_one_that_the_kiosk_gives() -> None:
    given = {
        part.value
        for file in KIOSK.rglob("*.py")
        for part in ast.walk(ast.parse(file.read_text()))
        if isinstance(part, ast.Constant)
    }
    assert set(spoken.REASONS) <= given, "change the sentence in spoken.py, too"


def test_what_the_devices_say_is_known() -> None:
    """Every pattern that stands in the kiosk's code; those that it puts together are named here."""
    said = {condition.value for condition in Condition} | {DARK_ENOUGH, TOO_BRIGHT}
    for file in KIOSK.rglob("*.py"):
        for call in ast.walk(ast.parse(file.read_text())):
            if isinstance(call, ast.Call) and ast.unparse(call.func) == "LiveValue.said":
                label, pattern = call.args[:2]
                said |= {str(pattern.value)} if isinstance(pattern, ast.Constant) else set()
                assert not isinstance(label, ast.Constant) or label.value in spoken.LABELS
    assert said <= set(spoken.VALUES)
    assert {"{0} pictures", "{0} h"} < said


def test_usual_events_are_said_in_the_language() -> None:
    with speaking("de"):
        assert spoken.event_text("The kiosk is starting.") == "Der Kiosk startet."
        assert spoken.event_text("Started: Test shots.") == "Begonnen: Testaufnahmen."
        assert spoken.event_text("anna logged in from ::1.") == "anna hat sich von ::1 angemeldet."
        assert (
            spoken.event_text("The stage is powering: light is needed.") == "Die Lampen gehen an: Licht wird gebraucht."
        )
        assert spoken.event_text("Mains off: left.") == "Netz aus: left."
        assert spoken.event_text("Something {0} else.") == "Something {0} else."


def test_a_value_of_a_device_is_said_in_the_language() -> None:
    value = LiveValue.said("Hours", "{0} h with Velatura, {1} strikes", 1204.4, 88)
    assert value.text == "1,204 h with Velatura, 88 strikes"
    assert value == LiveValue.said("Hours", "{0} h with Velatura, {1} strikes", 1203.8, 88)
    with speaking("de"):
        assert spoken.value_text(value) == "1.204 h mit Velatura, 88 Zündungen"
        assert spoken.value_text(LiveValue("Model", "EOS {0}")) == "EOS {0}"


def test_a_jobs_name_keeps_the_names_in_it() -> None:
    with speaking("de"):
        assert spoken.job_title("New appearance warm wood") == "Neues Erscheinungsbild warm wood"
        assert spoken.job_title("Frames without projector left") == "Bilder ohne Projektor left"
        assert spoken.job_title("Something newer") == "Something newer"


@pytest.mark.parametrize(
    ("cookie", "accepted", "expected"),
    [
        ("", "", "en"), ("", "de-AT,de;q=0.9,en;q=0.8", "de"), ("", "it,fr;q=0.4,es;q=0.6", "es"),
        ("ja", "de", "ja"), ("xx", "fr", "fr"), ("", "ja;q=0,de;q=nonsense", "en"), ("", "pt,*;q=0.1", "en"),
        ("../de", "", "en"),
    ],
)  # fmt: skip
def test_a_set_language_comes_before_that_of_the_browser(cookie: str, accepted: str, expected: str) -> None:
    assert chosen(cookie, accepted) == expected


@given(st.text(max_size=80), st.text(max_size=200))
def test_any_request_has_a_language(cookie: str, accepted: str) -> None:
    assert chosen(cookie, accepted) in LANGUAGES


@given(st.sampled_from(sorted(LANGUAGES)), st.floats(-1e7, 1e7) | st.floats(-12_000, 12_000), st.integers(0, 2))
def test_numbers_are_as_the_worlds_locales_write_them(language: str, value: float, digits: int) -> None:
    value = float(f"{value:.{digits}f}")
    # CLDR groups from five digits on in Spanish (minimumGroupingDigits), which Babel does not read.
    whole = "0" if language == "es" and abs(value) < 10_000 else "#,##0"
    pattern = whole + ("." + "0" * digits if digits else "")
    with speaking(language):
        assert figures.number(value, digits).lstrip("-") == format_decimal(abs(value), pattern, locale=language)


@pytest.mark.parametrize("language", OTHERS)
def test_shares_and_names_of_days_are_as_the_worlds_locales_write_them(language: str) -> None:
    with speaking(language):
        assert figures.percent(0.45) == format_percent(0.45, locale=language)
        if language == "de":
            days = get_day_names("abbreviated", "stand-alone", locale=language)
        else:
            days = get_day_names("abbreviated", "format", locale=language)
        months = get_month_names("abbreviated", "format", locale=language)
        assert figures.FIGURES[language].weekdays == tuple(days[n] for n in range(7))
        assert figures.FIGURES[language].months == tuple(months[n] for n in range(1, 13))


def test_moments_are_written_as_readers_expect() -> None:
    at = datetime(2026, 12, 5, 9, 4, 7)
    expected = {
        "en": "Sat 05 Dec 2026, 09:04", "de": "Sa, 5. Dez. 2026, 09:04", "es": "sáb, 5 dic 2026, 09:04",
        "fr": "sam. 5 déc. 2026, 09:04", "ja": "2026年12月5日(土) 09:04",
    }  # fmt: skip
    for language, text in expected.items():
        with speaking(language):
            assert figures.moment(at) == text


@pytest.mark.parametrize(("count", "expected"), [(0, "外観0件"), (1, "外観1件"), (2, "外観2件")])
def test_a_language_has_its_own_plurals(count: int, expected: str) -> None:
    words_of = ("%(num)d appearance", "%(num)d appearances")
    with speaking("ja"):
        assert ngettext(*words_of, count) % {"num": count} == expected
    with speaking("fr"):
        assert ngettext(*words_of, count).endswith("apparence" if count < 2 else "apparences")


def test_pages_come_in_the_browsers_language_and_in_that_of_the_setting(panel: Served) -> None:
    with panel.entered("tina") as client:
        german = client.get("/", headers={"accept-language": "de"}).text
        assert '<html lang="de">' in german
        assert "Erscheinungsbilder" in german
        kept = client.post("/language", data={"language": "ja", "back": "/schedule"})
        assert (kept.status_code, kept.headers["location"]) == (303, "/schedule")
        assert COOKIE in client.cookies
        assert "開館時間" in client.get("/schedule", headers={"accept-language": "de"}).text
        missing = client.get("/nothing", headers={"accept": "text/html"})
        assert "このページはありません。" in missing.text
        for address in ("//elsewhere.example", "https://elsewhere.example", "/\\elsewhere", "javascript:alert(1)"):
            assert client.post("/language", data={"language": "de", "back": address}).headers["location"] == "/"
        assert client.post("/language", data={"language": "xx"}).status_code == 403


def test_the_empty_text_has_no_translation() -> None:
    with speaking("de"):
        assert gettext("") == ""


def test_the_catalogues_lie_beside_the_code() -> None:
    assert {file.stem for file in Path(WORDS).glob("*.mo")} == set(OTHERS)
