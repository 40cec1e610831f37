"""What the bench prints: sentences for people, or JSON lines for programs."""

from __future__ import annotations

import contextlib
import json
import shlex
import sys
from collections.abc import Mapping
from typing import Any

from hal.errors import DeviceError


class OutputLines:
    """Prints what is served on standard output; ``json_lines``: one JSON object for each line."""

    def __init__(self, json_lines: bool) -> None:
        self._json = json_lines
        self._reported_percent = -1

    def say(self, record: Mapping[str, Any], sentence: str) -> None:
        # A reader that went away must not take the bench with it.
        with contextlib.suppress(BrokenPipeError):
            sys.stdout.write((json.dumps(record) if self._json else sentence) + "\n")
            sys.stdout.flush()

    def progress(self, share: float) -> None:
        if (percent := int(100 * share) // 10 * 10) > self._reported_percent:
            self._reported_percent = percent
            self.say({"progress": percent / 100, "what": "rays"}, f"Casting rays through the stage: {percent} %")

    def served(self, device: str, kind: str, address: str) -> None:
        self.say({"device": device, "kind": kind, "address": address}, f"{kind:<10} {device:<10} {address}")

    def environment(self, variables: Mapping[str, str]) -> None:
        words = " ".join(f"{name}={shlex.quote(value)}" for name, value in variables.items())
        self.say({"environment": dict(variables)}, f"To see the USB devices, begin commands with: {words}")

    def mains(self, projector: str, on: bool, damages: int) -> None:
        hurt = f" Its lamp was switched off hot, {damages} times so far." if damages else ""
        self.say(
            {"mains": projector, "on": on, "damages": damages},
            f"Projector {projector} {'has' if on else 'has no'} mains.{hurt}",
        )

    def douser(self, projector: str, is_open: bool) -> None:
        state = "opens" if is_open else "closes"
        self.say({"douser": projector, "open": is_open}, f"The douser of projector {projector} {state}.")

    def ready(self) -> None:
        self.say({"ready": True}, "Ready. Ctrl-C ends.")

    def failed(self, error: DeviceError) -> None:
        if self._json:
            self.say({"error": {"code": error.code, "what": error.what, "remedy": error.remedy}}, "")
        else:
            sys.stderr.write(f"velatura: {error.what}\n{error.remedy}\n")
