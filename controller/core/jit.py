"""``compiled`` for the numeric packages, which import nothing of ``hal`` themselves."""

from hal.runtime.jit import compiled

__all__ = ["compiled"]
