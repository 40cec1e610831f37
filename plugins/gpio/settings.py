"""What a ``[key_panel]`` table says for keys on GPIO lines."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

from hal.errors import PluginError
from hal.registry import setting
from hal.values import TECHNICIAN_KEYS

PULLS: Final = ("", "up", "down", "none")
_DOES: Final = TECHNICIAN_KEYS[1:]
EXPLAINED: Final = {
    "chip": "the GPIO chip: /dev/gpiochip0, or its label, such as cp2112_gpio",
    "keys": "a list of tables: line (its number or name), does (play, stop or recalibrate), active_low (default true)",
    "debounce_ms": "milliseconds for which a key must stay as it is: 1 to 500 (default 20)",
    "pull": 'the resistor in the chip: "up", "down" or "none" (default: as it is)',
}


@dataclass(frozen=True, slots=True)
class KeySettings:
    """``keys``: for each line its number or name, the key that it is, and whether it is pressed at a low level."""

    chip: str
    keys: tuple[tuple[int | str, int, bool], ...]
    debounce_s: float
    pull: str


def key_settings(settings: Mapping[str, Any]) -> KeySettings:
    """Raises PluginError for what can't be used."""
    debounce_ms = setting(settings, "debounce_ms", int, 20)
    pull = setting(settings, "pull", str, "")
    tables = setting(settings, "keys", list, [])
    keys = tuple(_key(table) for table in tables)
    if not keys or len({line for line, _, _ in keys}) < len(keys) or not 1 <= debounce_ms <= 500 or pull not in PULLS:
        raise _wrong("The keys, debounce_ms or pull of the key panel are wrong.")
    return KeySettings(setting(settings, "chip", str, ""), keys, debounce_ms / 1000, pull)


def _key(table: object) -> tuple[int | str, int, bool]:
    if not isinstance(table, Mapping) or table.keys() - {"line", "does", "active_low"}:
        raise _wrong("A key of the key panel is no table of line, does and active_low.")
    line, does, active_low = table.get("line"), table.get("does"), table.get("active_low", True)
    number = isinstance(line, int) and not isinstance(line, bool) and line >= 0
    sound = number or (isinstance(line, str) and line != "")
    if not sound or does not in _DOES or not isinstance(active_low, bool):
        raise _wrong(f"The key on line {line!r} can't be used.")
    assert isinstance(line, int | str)
    return line, TECHNICIAN_KEYS.index(does), active_low


def _wrong(what: str) -> PluginError:
    return PluginError(
        "key-setting",
        what=what,
        remedy=f"Write a line and one of {', '.join(_DOES)} for each key, each line once; 1 to 500 for debounce_ms; up,"
        " down or none for pull.",
    )
