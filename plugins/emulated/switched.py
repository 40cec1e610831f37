"""An emulated device that is on inside a ``with`` statement."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Self


class Switched(ABC):
    """Starts where its ``with`` statement begins, and stops where that ends."""

    @abstractmethod
    def start(self) -> object:
        """Switch on."""

    @abstractmethod
    def stop(self) -> None:
        """Switch off."""

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()
