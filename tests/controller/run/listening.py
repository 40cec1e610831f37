"""A reporter that keeps the progress it is told."""

from __future__ import annotations

from controller.run.progress import Progress, Silent


class Listening(Silent):
    def __init__(self) -> None:
        self.told: list[Progress] = []

    def progress(self, now: Progress) -> None:
        self.told.append(now)
