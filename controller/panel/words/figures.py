"""Numbers, shares and moments as a reader of a language writes them.

Only what the panel shows, so that no kiosk needs all of the world's locales; the tests compare it with those.
"""

from __future__ import annotations

from dataclasses import dataclass
from datetime import date, datetime
from typing import Final

from controller.panel.words.language import language


@dataclass(frozen=True, slots=True)
class Figures:
    """``point`` of decimals; ``group`` between thousands, from ``grouped_from`` digits on; ``percent``, ``moment``,
    ``day`` and ``short`` (weekday and clock) are patterns.
    """

    point: str
    group: str
    grouped_from: int
    percent: str
    weekdays: tuple[str, ...]
    months: tuple[str, ...]
    moment: str
    day: str
    short: str


def _names(text: str) -> tuple[str, ...]:
    return tuple(text.split())


FIGURES: Final = {
    "en": Figures(".", ",", 4, "{} %", _names("Mon Tue Wed Thu Fri Sat Sun"),
                  _names("Jan Feb Mar Apr May Jun Jul Aug Sep Oct Nov Dec"),
                  "{weekday} {day:02d} {month} {year}, {clock}", "{weekday} {day:02d} {month}", "{weekday} {clock}"),
    "de": Figures(",", ".", 4, "{}\u00a0%", _names("Mo Di Mi Do Fr Sa So"),
                  _names("Jan. Feb. März Apr. Mai Juni Juli Aug. Sept. Okt. Nov. Dez."),
                  "{weekday}, {day}. {month} {year}, {clock}", "{weekday}, {day}. {month}", "{weekday} {clock}"),
    "es": Figures(",", ".", 5, "{}\u00a0%", _names("lun mar mié jue vie sáb dom"),
                  _names("ene feb mar abr may jun jul ago sept oct nov dic"),
                  "{weekday}, {day} {month} {year}, {clock}", "{weekday}, {day} {month}", "{weekday} {clock}"),
    "fr": Figures(",", "\u202f", 4, "{}\u00a0%", _names("lun. mar. mer. jeu. ven. sam. dim."),
                  _names("janv. févr. mars avr. mai juin juil. août sept. oct. nov. déc."),
                  "{weekday} {day} {month} {year}, {clock}", "{weekday} {day} {month}", "{weekday} {clock}"),
    "ja": Figures(".", ",", 4, "{}%", _names("月 火 水 木 金 土 日"), tuple(f"{n}月" for n in range(1, 13)),
                  "{year}年{month}{day}日({weekday}) {clock}", "{month}{day}日({weekday})", "({weekday}) {clock}"),
}  # fmt: skip


def number(value: float, digits: int = 0) -> str:
    """``1204.5`` as "1,204.5" in English and "1.204,5" in German."""
    form = FIGURES[language()]
    whole, _, part = f"{abs(value):,.{digits}f}".partition(".")
    if len(whole.replace(",", "")) < form.grouped_from:
        whole = whole.replace(",", "")
    text = whole.replace(",", form.group) + (form.point + part if part else "")
    return f"-{text}" if value < 0 and any(c in "123456789" for c in text) else text


def percent(share: float, digits: int = 0) -> str:
    """A share from 0 to 1 in per cent."""
    return FIGURES[language()].percent.format(number(100 * share, digits))


def moment(at: datetime, *, seconds: bool = False) -> str:
    """Weekday, date and time."""
    form = FIGURES[language()]
    return form.moment.format(**_parts(form, at), clock=f"{at:%H:%M:%S}" if seconds else f"{at:%H:%M}")


def day(at: date) -> str:
    """Weekday, day and month."""
    form = FIGURES[language()]
    return form.day.format(**_parts(form, at))


def short(at: datetime) -> str:
    """Weekday and time."""
    form = FIGURES[language()]
    return form.short.format(**_parts(form, at), clock=f"{at:%H:%M}")


def _parts(form: Figures, at: date) -> dict[str, str | int]:
    return {"weekday": form.weekdays[at.weekday()], "day": at.day, "month": form.months[at.month - 1], "year": at.year}
