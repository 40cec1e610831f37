"""Collects the panel's words for its catalogues, and compiles these: python -m docs.panel_words."""

from __future__ import annotations

import io
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

from babel.messages.catalog import Catalog
from babel.messages.extract import extract_from_dir
from babel.messages.mofile import write_mo
from babel.messages.pofile import read_po, write_po

from controller.kiosk.operations.table import OPERATIONS
from controller.optics.calibrate.verify import error_causes
from controller.panel.pages.forms import LEADS_TO
from controller.panel.words.language import LANGUAGES

PANEL: Final = Path(__file__).parents[1] / "controller" / "panel"
WORDS: Final = PANEL / "words"
METHODS: Final = [("templates/**.html", "jinja2"), ("**.py", "python")]
KEYWORDS: Final = {"_": None, "gettext": None, "mark": None, "ngettext": (1, 2)}
DAY: Final = datetime(2026, 1, 1, tzinfo=UTC)
"""In the head of each catalogue, which a day there would change each time."""
OPTIONS: Final = {"templates/**.html": {"trimmed": "true", "silent": "false", "encoding": "utf-8"}}


def words() -> Catalog:
    """All that the panel says: in its templates and code, the operations with a form, and the causes of errors."""
    found = Catalog(project="Velatura", charset="utf-8", fuzzy=False)
    for file, _, message, _, context in extract_from_dir(PANEL, METHODS, OPTIONS, KEYWORDS):
        found.add(message, None, [(file, 0)], context=context)
    for operation in OPERATIONS:
        if operation.name in LEADS_TO:
            for sentence in (operation.done, operation.asks):
                if sentence:
                    found.add(sentence, None, [("operations", 0)])
    for name, _, _ in error_causes.WORDS.values():
        found.add(name, None, [("error_causes", 0)])
    return found


def catalogue(language: str) -> Catalog:
    """As it is kept; empty if there is none yet."""
    file = WORDS / f"{language}.po"
    if not file.exists():
        return Catalog(locale=language, charset="utf-8", fuzzy=False)
    with file.open("rb") as content:
        return read_po(content, locale=language)


def compiled(language: str) -> bytes:
    """The .mo file of a kept catalogue."""
    out = io.BytesIO()
    write_mo(out, catalogue(language))
    return out.getvalue()


def main() -> None:
    """Bring the catalogues up to date: new words come without a translation, those that are no longer used go."""
    template = words()
    for language in LANGUAGES:
        if language == "en":
            continue
        kept = catalogue(language)
        kept.update(template, no_fuzzy_matching=True, update_creation_date=False)
        kept.obsolete.clear()
        kept.header_comment = (
            f"# The words of Velatura's panel: {LANGUAGES[language]}. `python -m docs.panel_words` keeps it."
        )
        kept.project, kept.version, kept.msgid_bugs_address = "Velatura", "panel", ""
        kept.last_translator, kept.language_team, kept.creation_date, kept.revision_date = (
            "Velatura",
            language,
            DAY,
            DAY,
        )
        with (WORDS / f"{language}.po").open("wb") as file:
            write_po(file, kept, sort_output=True, omit_header=False, no_location=True, width=120)
        (WORDS / f"{language}.mo").write_bytes(compiled(language))
        print(f"{language}: {sum(1 for one in kept if one.id and not one.string)} of {len(kept)} words to translate")  # noqa: T201 - it is a command


if __name__ == "__main__":
    main()
