"""What emulated devices have in common: a switch, and where they serve."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Final, Self

HOST: Final = "127.0.0.1"


class Switchable(ABC):
    """Starts where its ``with`` statement begins, and stops where that ends."""

    @abstractmethod
    def start(self) -> object:
        """Switch on."""

    @abstractmethod
    def stop(self) -> None:
        """Switch off. Harmless when called twice."""

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()
