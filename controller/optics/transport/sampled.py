"""The transport of frames of one colour each, at some of the camera's pixels: what a quick preview needs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from controller.core.arrays import FloatImage, Mask
from controller.optics.transport.camera_box import CameraBox
from controller.optics.transport.operator import LightTransport


@dataclass(frozen=True, eq=False, repr=False)
class SampledLight(LightTransport):
    """T of projectors that have one pixel each.

    ``white`` (projectors, 3, rows, columns) float32: the light of each projector's white at the pixels that are kept
    """

    white: FloatImage

    @classmethod
    def of(cls, transport: LightTransport, at: tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]) -> Self:
        """Of a whole transport, at the camera's rows and columns ``at``."""
        count = len(transport.sizes)
        ones = np.ones((3, transport.pixels), np.float32)
        kept = np.ix_(*at)
        white = np.stack([transport.forward_planes(ones, projectors=(n, n + 1))[:, kept[0], kept[1]]
                          for n in range(count)])  # fmt: skip
        lit = np.stack([np.asarray(part)[kept] for part in transport.lit])
        return cls.made(transport.mixing, lit, white, transport.segments)

    @classmethod
    def made(cls, mixing: FloatImage, lit: Mask, white: FloatImage, segments: Sequence[float]) -> Self:
        """From its parts."""
        seen = lit.reshape(len(lit), -1).sum(axis=1)
        per_weight = np.divide(1, seen, out=np.zeros(len(lit), np.float32), where=seen > 0).astype(np.float32)
        return cls(mixing, lit, per_weight, ((1, 1),) * len(lit), white, segments=tuple(segments))

    def forward_planes(
        self, p: FloatImage, *, projectors: tuple[int, int] | None = None, out: FloatImage | None = None
    ) -> FloatImage:
        image = np.zeros((3, *self.camera_shape), np.float32) if out is None else out
        image[...] = 0
        for n in range(*(projectors or (0, len(self.white)))):
            image += self.white[n] * (self.mixing[n] @ p[:, n])[:, None, None]
        return image

    def adjoint_planes(
        self, r: FloatImage, *, projectors: tuple[int, int] | None = None, out: FloatImage | None = None
    ) -> FloatImage:
        planes = np.zeros((3, self.pixels), np.float32) if out is None else out
        for n in range(*(projectors or (0, len(self.white)))):
            planes[:, n] = self.mixing[n].T @ np.einsum("cyx,cyx->c", self.white[n], r)
        return planes

    def gaussian_mean_planes(self, image: FloatImage, *, projectors: tuple[int, int] | None = None) -> FloatImage:
        planes = np.zeros((3, self.pixels), np.float32)
        for n in range(*(projectors or (0, len(self.white)))):
            planes[:, n] = image[:, self.lit[n]].sum(axis=1) * self.per_weight[n]
        return planes

    def submatrix(
        self, box: CameraBox, pixels: npt.NDArray[np.int64], channels: tuple[int, ...]
    ) -> sp.csr_matrix[np.float64]:
        blocks = [
            [self.mixing[n][row, column] * self.white[n][row][box.window].reshape(-1, 1) for column in channels
             for n in pixels]
            for row in channels
        ]  # fmt: skip
        return sp.csr_matrix(np.block(blocks).astype(np.float64))

    def arrays(self) -> dict[str, npt.NDArray[Any]]:
        return {"mixing": self.mixing, "lit": self.lit, "white": self.white, "segments": np.array(self.segments)}
