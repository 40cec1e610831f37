"""A reporter that keeps the progress and the sentences that it is given."""

from __future__ import annotations

from controller.run.progress import Progress, Silent
from hal.notices import Level


class Listening(Silent):
    def __init__(self) -> None:
        self.told: list[Progress] = []
        self.said: list[str] = []

    def progress(self, now: Progress) -> None:
        self.told.append(now)

    def say(self, text: str, level: Level = Level.INFO) -> None:
        self.said.append(text)
