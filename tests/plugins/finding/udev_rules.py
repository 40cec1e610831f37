"""Reads udev rules as udev(7) describes them, and says what they give to a device of a ``/sys`` folder.

Only what the shipped rules need is understood; anything else in a rule is refused, so that a typing error is.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Final

_PART: Final = re.compile(r'\s*([A-Z_]+)(?:\{([^{}"]+)\})?\s*(==|!=|\+=|:=|=)\s*"([^"\\]*)"\s*(?:,|$)')
_MATCHES: Final = ("ACTION", "DEVPATH", "KERNEL", "SUBSYSTEM", "DRIVER")
_PARENTS: Final = ("KERNELS", "SUBSYSTEMS", "DRIVERS")
_NAMED: Final = ("ATTR", "ATTRS", "ENV")
_GIVEN: Final = ("MODE", "GROUP", "OWNER", "TAG")


@dataclass(frozen=True)
class Part:
    """One condition or assignment of a rule."""

    key: str
    name: str
    operator: str
    value: str

    @property
    def is_condition(self) -> bool:
        return self.operator in ("==", "!=")


@dataclass
class Given:
    """What rules give to a device."""

    mode: str = ""
    group: str = ""
    tags: set[str] = field(default_factory=set)
    properties: dict[str, str] = field(default_factory=dict)


def parse(text: str) -> list[list[Part]]:
    """The rules of a file. Raises ValueError with the line's number for what is no rule, or gives nothing."""
    rules = []
    for number, line in enumerate(text.splitlines(), start=1):
        if not line.strip() or line.startswith("#"):
            continue
        parts, at = [], 0
        while at < len(line):
            match = _PART.match(line, at)
            if match is None:
                raise ValueError(f"line {number}: {line[at:]!r} is neither a condition nor an assignment")
            parts.append(_checked(Part(match[1], match[2] or "", match[3], match[4]), number))
            at = match.end()
        if all(part.is_condition for part in parts) or not any(part.is_condition for part in parts):
            raise ValueError(f"line {number}: a rule needs conditions and assignments")
        rules.append(parts)
    return rules


def _checked(part: Part, number: int) -> Part:
    known = part.key in (*_MATCHES, *_PARENTS, *_NAMED, *_GIVEN) and bool(part.name) is (part.key in _NAMED)
    right = part.is_condition if part.key in (*_MATCHES, *_PARENTS, "ATTR", "ATTRS") else True
    if part.key in _GIVEN:
        right = part.operator == ("+=" if part.key == "TAG" else "=")
    if part.key == "MODE" and not re.fullmatch(r"0?[0-7]{3}", part.value):
        right = False
    if not known or not right:
        raise ValueError(f"line {number}: {part} is not understood")
    return part


def given(rules: list[list[Part]], device: Path, *, properties: Mapping[str, str] | None = None) -> Given:
    """What ``rules`` give to the device in the folder ``device`` of a ``/sys``, with these properties, too."""
    found = Given(properties={**_uevent(device), **_interfaces(device), **(properties or {})})
    for rule in rules:
        if all(_holds(part, device, found) for part in rule if part.is_condition and not _of_parents(part)) and (
            not (wanted := [part for part in rule if _of_parents(part)])
            or any(all(_parent_holds(part, one) for part in wanted) for one in (device, *_parents(device)))
        ):
            for part in rule:
                _give(part, found)
    return found


def _of_parents(part: Part) -> bool:
    return part.key in (*_PARENTS, "ATTRS")


def _holds(part: Part, device: Path, found: Given) -> bool:
    if part.key == "ENV":
        text = found.properties.get(part.name, "")
    else:
        text = {"KERNEL": device.name, "SUBSYSTEM": _subsystem(device), "ACTION": "add"}.get(part.key, "")
        if part.key == "ATTR":
            text = _attribute(device, part.name)
    return _like(part, text)


def _parent_holds(part: Part, one: Path) -> bool:
    text = _attribute(one, part.name) if part.key == "ATTRS" else ""
    return _like(part, {"KERNELS": one.name, "SUBSYSTEMS": _subsystem(one)}.get(part.key, text))


def _like(part: Part, text: str) -> bool:
    alike = any(fnmatchcase(text, pattern) for pattern in part.value.split("|"))
    return alike is (part.operator == "==")


def _give(part: Part, found: Given) -> None:
    if part.is_condition:
        return
    if part.key == "MODE":
        found.mode = part.value
    elif part.key == "GROUP":
        found.group = part.value
    elif part.key == "TAG":
        found.tags.add(part.value)
    else:
        found.properties[part.name] = part.value


def _parents(device: Path) -> Iterator[Path]:
    for folder in device.parents:
        if folder.name == "devices":
            return
        if (folder / "uevent").exists():
            yield folder


def _subsystem(device: Path) -> str:
    link = device / "subsystem"
    return link.readlink().name if link.is_symlink() else ""


def _attribute(device: Path, name: str) -> str:
    file = device / name
    return file.read_text(errors="replace").rstrip("\n") if file.is_file() else ""


def _uevent(device: Path) -> dict[str, str]:
    return dict(line.split("=", 1) for line in _attribute(device, "uevent").splitlines())


def _interfaces(device: Path) -> dict[str, str]:
    """ID_USB_INTERFACES, which udev's own rules (50-udev-default.rules) have set before ours are read."""
    classes = [
        "".join(_attribute(one, f"bInterface{part}") for part in ("Class", "SubClass", "Protocol"))
        for one in sorted(device.glob(f"{device.name}:*"))
    ]
    return {"ID_USB_INTERFACES": "".join(f":{one}" for one in classes) + ":"} if classes else {}
