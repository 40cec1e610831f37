"""The settings that museums change, as fields of a form. What each may hold is what the models of stage.toml allow."""

from __future__ import annotations

import contextlib
import json
import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Final

from controller.config.models import (
    AlertsTable,
    AppearanceTable,
    BackupTable,
    CalibrationTable,
    DiskTable,
    LightSensorTable,
    ObjectTable,
    StageTable,
)  # fmt: skip
from controller.config.table import ConfigTable
from controller.config.writer import KeyChange, edited
from controller.panel.words.language import mark
from hal.toml_lines import KeyPath

_FIELDS: Final[Mapping[tuple[str, str, type[ConfigTable]], Mapping[str, str]]] = {
    ("stage", mark("The stage"), StageTable): {"name": mark("Name of the object")},
    ("appearances", mark("Appearance"), AppearanceTable): {
        "shown_s": mark("Seconds shown in turn"), "fade_s": mark("Seconds of the fade at its start"),
    },
    ("light_sensor", mark("Room light"), LightSensorTable): {
        "most_lux": mark("Most lux at the object for a calibration"),
    },
    ("object", mark("The object"), ObjectTable): {"outline": mark("Outline of the object")},
    ("calibration", mark("Calibration"), CalibrationTable): {
        "photographs": mark("Number of photographs"),
        "worst_grade": mark("Largest error that is published, in per cent"),
        "photograph_at_night": mark("Photograph the appearances at night"),
    },
    ("backup", mark("Backup"), BackupTable): {
        "folder": mark("Folder for backups"), "usb": mark("Label of the USB stick"), "at": mark("Time of the backup"),
        "keep": mark("Backups that are kept"),
    },
    ("alerts", mark("Alerts"), AlertsTable): {
        "least": mark("From this level on"), "mail_to": mark("Mail addresses, with commas between them"),
        "mail_from": mark("Mail address of the sender"), "mail_host": mark("Mail server"),
        "mail_port": mark("Its port"), "mail_security": mark("Its security"), "mail_user": mark("Its log-in name"),
        "webhook": mark("Webhook"),
    },
    ("disk", mark("Free space"), DiskTable): {
        "warn_free_gb": mark("Free gigabytes below which it warns"), "keep_runs": mark("Runs that are never removed"),
    },
}  # fmt: skip
"""Labels by key, for each table of stage.toml: its name, its heading and its model."""


_CHOICES: Final = {
    "true": mark("Yes"), "false": mark("No"), "warning": mark("warning"), "error": mark("error"),
    "full": mark("many"), "few": mark("few"), "fewest": mark("as few as possible"), "starttls": mark("STARTTLS"),
    "tls": mark("TLS"), "none": mark("none, without a password"),
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class SettingField:
    """``path`` in stage.toml; ``value``: its text now; ``rules``: what is allowed, as JSON schema."""

    path: KeyPath
    label: str
    value: str
    rules: Mapping[str, Any]

    @property
    def name(self) -> str:
        """In the form."""
        return ".".join(map(str, self.path))

    @property
    def choices(self) -> dict[str, str]:
        """The words of what can be chosen; {} for what is typed."""
        values = ["true", "false"] if "boolean" in self.kinds else self.rules.get("enum", ())
        return {value: _CHOICES[value] for value in values}

    @property
    def kinds(self) -> set[str]:
        """Of JSON values that are allowed."""
        return {str(one.get("type")) for one in (self.rules, *self.rules.get("anyOf", ()))}

    def parsed(self, text: str) -> Any:
        """The value that a text stands for; the text itself where it stands for none, and None for an empty one."""
        if not text:
            return None
        if text.startswith("["):
            with contextlib.suppress(ValueError):
                return json.loads(text)
        if "array" in self.kinds:
            return [word for one in text.split(",") if (word := one.strip())]
        if "boolean" in self.kinds:
            return text == "true"
        for kind, number in (("integer", int), ("number", float)):
            if kind in self.kinds:
                with contextlib.suppress(ValueError):
                    return number(text.replace(",", "."))
        return text


def groups(text: str) -> list[tuple[str, str, list[SettingField]]]:
    """Heading, name (of an appearance) and fields of each group, with the values of this text; [] if it is damaged."""
    try:
        content = tomllib.loads(text)
    except tomllib.TOMLDecodeError:
        return []
    found = []
    for (name, heading, model), labels in _FIELDS.items():
        rules = model.model_json_schema()["properties"]
        for path, table in _tables(name, content):
            fields = [
                SettingField((*path, key), label, _text(table, key, rules), rules[key]) for key, label in labels.items()
            ]
            found.append((heading, str(table.get("name", "")) if len(path) > 1 else "", fields))
    return found


def _tables(name: str, content: Mapping[str, Any]) -> Iterator[tuple[KeyPath, Mapping[str, Any]]]:
    table = content.get(name, None if name == "light_sensor" else [] if name == "appearances" else {})
    if isinstance(table, Mapping):
        yield (name,), table
    elif isinstance(table, list):
        yield from (((name, number), one) for number, one in enumerate(table) if isinstance(one, Mapping))


def _text(table: Mapping[str, Any], key: str, rules: Mapping[str, Any]) -> str:
    value = table.get(key, rules[key].get("default"))
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, list) and any(isinstance(one, list) for one in value):
        return json.dumps(value)
    if isinstance(value, list | tuple):
        return ", ".join(map(str, value))
    return "" if value is None else f"{value:g}" if isinstance(value, float) else str(value)


def with_fields(text: str, sent: Mapping[str, str]) -> str:
    """The stage.toml with the fields that were changed; an empty one goes back to what Velatura takes by itself.

    Raises UsageError("stage-not-editable"). What is not allowed is found when the text is checked.
    """
    content, changes, added = tomllib.loads(text), list[KeyChange](), dict[str, dict[str, Any]]()
    for field in (field for _, _, fields in groups(text) for field in fields):
        new = sent.get(field.name, field.value).strip()
        if new == field.value:
            continue
        *path, key = field.path
        if str(path[0]) in content:
            changes.append(KeyChange(tuple(path), str(key), field.parsed(new)))
        elif new:
            added.setdefault(str(path[0]), {})[str(key)] = field.parsed(new)
    return edited(text, changes, added)
