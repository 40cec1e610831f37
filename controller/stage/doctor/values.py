"""The results of the doctor."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from controller.core.text import printable
from hal.finding import Found
from hal.notices import Notice


@dataclass(frozen=True, slots=True)
class DeviceResult:
    """A tested device of stage.toml: ``answer`` describes its state, None if it failed."""

    name: str
    kind: str
    answer: str | None


@dataclass(frozen=True, slots=True)
class Examination:
    """All results.

    ``findings``: each about a device's place, or about the whole stage (""); ``new``: devices that are not in
    stage.toml yet; ``graphics``: what this computer can solve on
    """

    found: tuple[Found, ...]
    tried: tuple[DeviceResult, ...]
    findings: tuple[Notice, ...]
    new: tuple[Found, ...]
    written: tuple[str, ...] = ()
    graphics: str = ""

    @property
    def healthy(self) -> bool:
        return not self.findings

    def as_json(self) -> dict[str, Any]:
        """For programs; every text of a device is made printable."""
        return {
            "healthy": self.healthy,
            "found": [
                {
                    "bus": device.bus,
                    "address": printable(device.address),
                    "what": printable(device.what),
                    "kind": device.kind,
                    "driver": device.driver,
                    "settings": dict(device.settings),
                    "new": device in self.new,
                }
                for device in self.found
            ],
            "tried": [{"name": tried.name, "kind": tried.kind, "answer": tried.answer} for tried in self.tried],
            "problems": [
                {
                    "device": finding.about,
                    "code": finding.code,
                    "what": printable(finding.what),
                    "remedy": printable(finding.remedy),
                }
                for finding in self.findings
            ],
            "written": list(self.written),
            "graphics": self.graphics,
        }

    def as_text(self) -> str:
        """For people: devices, their states, and what to correct, the most important last."""
        lines = [f"Found {len(self.found)} devices." if self.found else "Nothing was found."]
        lines += [
            f"  {device.bus:<8} {device.address:<28} {device.what}{'  (not in stage.toml)' * (device in self.new)}"
            for device in self.found
        ]
        if self.tried:
            lines += ["", "The stage's devices:"]
            lines += [f"  {tried.name:<16} {tried.answer or 'failed, see below'}" for tried in self.tried]
        if self.graphics:
            lines += ["", self.graphics]
        for number, finding in enumerate(self.findings, 1):
            where = f"{finding.about}: " if finding.about else ""
            lines += ["", f"{number}. {where}{finding.what} [{finding.code}]", f"   {finding.remedy}"]
        if self.written:
            lines += ["", *(f"Written into stage.toml: {text}." for text in self.written)]
        lines += ["", "No problems found." if self.healthy else f"Problems to correct: {len(self.findings)}."]
        return "\n".join(printable(line) for line in lines)
