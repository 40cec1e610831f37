"""A rectangle of camera pixels."""

from __future__ import annotations

from typing import NamedTuple


class CameraBox(NamedTuple):
    """Camera pixels from (top, left) up to, not including, (bottom, right)."""

    top: int
    left: int
    bottom: int
    right: int

    def grown(self, by: int, shape: tuple[int, int]) -> CameraBox:
        """Larger by ``by`` on every side, within an image of ``shape`` (rows, columns)."""
        top, left = max(self.top - by, 0), max(self.left - by, 0)
        return CameraBox(top, left, min(self.bottom + by, shape[0]), min(self.right + by, shape[1]))

    @property
    def window(self) -> tuple[slice, slice]:
        """Rows and columns, as an index of an image."""
        return slice(self.top, self.bottom), slice(self.left, self.right)
