"""The light transport T of a stage: camera image = K + T p (paper 2.1, eq. 1; 4.2.3).

For projector n with frame p_n, T_n p_n = W_n (.) G_n (p_n M_n'). W_n is the projector's white image, M_n its colour
mixing, and G_n holds, for each camera pixel, the shares of its light that come from each projector pixel; they sum to
1. So T_n 1 reproduces W_n, which a plain Gaussian model counts twice where neighbours overlap, and edges of the
object's colour stay as sharp as the camera sees them.

One operator is what one camera sees of all projectors: T = [T_1 ... T_N], in columns. Solvers read the camera only
through sensor buffers (flat float32 vectors), so that several cameras become one operator (``views``), whose buffer is
theirs joined end to end (docs/decisions/0005).
"""

from __future__ import annotations

import dataclasses
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final, Self

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp
from scipy.sparse.linalg import LinearOperator

from controller.core.arrays import FloatImage, Mask
from controller.core.checks import check_shape
from controller.optics.transport.planes import CameraBox, frame_planes, image_planes, plane_frames, plane_image

FAINTEST: Final = 1e-6
"""A camera pixel counts as lit by a projector above this fraction of the projector's brightest white."""


@dataclass(frozen=True, eq=False, repr=False)
class LightTransport(LinearOperator[np.float32], ABC):
    """T without its black image K, for all projectors of a stage and three channels at once.

    It is a SciPy linear operator from planes (3, pixels of all projectors) to planes (3, camera rows, columns), both
    flat: ``lsqr(T, b)``, ``lsq_linear(T, b, (0, 1))`` and ``svds(T)`` accept it directly. ``forward`` and ``adjoint``
    do the same with pictures. SciPy's transposed operator is ``T.H``.

    ``shape``: (3 camera pixels, 3 projector pixels); ``dtype``: float32
    ``mixing`` (projectors, 3, 3) float32: camera channel by projector channel
    ``lit`` (projectors, rows, columns) bool: camera pixels on the object with shares of that projector
    ``per_weight`` (pixels,) float32: 1 / sum of a projector pixel's shares over its lit camera pixels, or 0
    ``sizes``: (rows, columns) of each projector's image
    ``segments``: share of white that each projector's white segment makes (``Radiometry.segment``); T is the same, but
    its frames end earlier where they are saturated: p_c <= 1 - s + s min(p)
    ``beside`` (pixels,) bool: pixels that light the room beside the object (``beside_object``), which solves leave
    dark; None if there are none
    """

    mixing: FloatImage
    lit: Mask
    per_weight: FloatImage
    sizes: tuple[tuple[int, int], ...]
    segments: tuple[float, ...] = dataclasses.field(default=(), kw_only=True)
    beside: Mask | None = dataclasses.field(default=None, kw_only=True)

    def __post_init__(self) -> None:
        # SciPy's own constructor assigns them, which a frozen class refuses
        object.__setattr__(self, "dtype", np.dtype(np.float32))
        object.__setattr__(self, "shape", (3 * self.lit[0].size, 3 * self.pixels))

    def segment(self, n: int) -> float:
        """Share of white that projector ``n``'s white segment makes; 0 without one."""
        return self.segments[n] if self.segments else 0.0

    @property
    def camera_shape(self) -> tuple[int, int]:
        """(rows, columns) of the camera image."""
        return self.lit.shape[1], self.lit.shape[2]

    @property
    def object_mask(self) -> Mask:
        """(rows, columns): camera pixels that at least one projector lights."""
        return np.asarray(self.lit.any(axis=0))

    def counts(self) -> FloatImage:
        """(rows, columns) float32: how much each camera pixel counts in a solve; 0 off the object. A new array."""
        return self.object_mask.astype(np.float32)

    def mixing_of(self, n: int) -> FloatImage:
        """(3, 3, 1 or rows, 1): the mixing of projector ``n`` at the rows of the camera image, or at all alike."""
        return np.asarray(self.mixing[n][:, :, None, None])

    @property
    def pixels(self) -> int:
        """How many pixels all projectors have."""
        return sum(rows * columns for rows, columns in self.sizes)

    def span(self, n: int) -> slice:
        """The pixels of projector ``n`` among those of all projectors."""
        start = sum(rows * columns for rows, columns in self.sizes[:n])
        return slice(start, start + self.sizes[n][0] * self.sizes[n][1])

    # pictures

    def forward(self, p: Sequence[FloatImage]) -> FloatImage:
        """T p: (rows, columns, 3) light from one (rows, columns, 3) frame a projector; K is not in it."""
        for n, frame in enumerate(p):
            self._check_frame(n, frame)
        return plane_image(self.forward_planes(frame_planes(p)))

    def adjoint(self, r: FloatImage) -> list[FloatImage]:  # type: ignore[override,misc]  # SciPy's operator is T.H
        """T' r: one (rows, columns, 3) image a projector from a camera image (rows, columns, 3)."""
        return plane_frames(self.adjoint_planes(image_planes(self._checked(r))), self.sizes)

    def forward_part(self, n: int, p: FloatImage) -> FloatImage:
        """T_n p_n: (rows, columns, 3) light from projector ``n`` alone."""
        self._check_frame(n, p)
        planes = np.zeros((3, self.pixels), np.float32)
        planes[:, self.span(n)] = frame_planes([p])
        return plane_image(self.forward_planes(planes, projectors=(n, n + 1)))

    def part(self, n: int) -> LinearOperator[np.float32]:
        """T_n as a SciPy operator, from the flat planes (3, its pixels) of projector ``n`` alone to the camera's."""
        span, only = self.span(n), (n, n + 1)
        pixels = span.stop - span.start

        def matvec(x: _Vector) -> _Vector:
            p = np.zeros((3, self.pixels), np.float32)
            p[:, span] = _planes(x, pixels)
            return _vector(self.forward_planes(p, projectors=only), x)

        def rmatvec(x: _Vector) -> _Vector:
            r = _planes(x, self.lit[0].size).reshape(3, *self.camera_shape)
            return _vector(self.adjoint_planes(r, projectors=only)[:, span], x)

        return LinearOperator((self.shape[0], 3 * pixels), matvec, rmatvec, dtype=np.float32)

    def reach(self) -> FloatImage:
        """T 1: (rows, columns, 3) the light with every projector at white."""
        return plane_image(self.forward_planes(np.ones((3, self.pixels), np.float32)))

    def gaussian_mean(self, image: FloatImage, n: int) -> FloatImage:
        """Mean of a camera image over each metapixel of projector ``n``, by its normalised Gaussian (paper 3.1, eq. 6).

        ``image`` (rows, columns, 3), finite. Returns (rows, columns, 3) of the projector, 0 where no pixel is lit.
        """
        means = self.gaussian_mean_planes(image_planes(self._checked(image)), projectors=(n, n + 1))
        (frame,) = plane_frames(means[:, self.span(n)], [self.sizes[n]])
        return frame

    # planes

    @abstractmethod
    def forward_planes(
        self, p: FloatImage, *, projectors: tuple[int, int] | None = None, out: FloatImage | None = None
    ) -> FloatImage:
        """T p on planes: (3, pixels) to (3, rows, columns), for a range of projectors or for all."""

    @abstractmethod
    def adjoint_planes(
        self, r: FloatImage, *, projectors: tuple[int, int] | None = None, out: FloatImage | None = None
    ) -> FloatImage:
        """T' r on planes: (3, rows, columns) to (3, pixels), for a range of projectors or for all.

        Pixels of other projectors stay as they are in ``out``, and are 0 without it.
        """

    @abstractmethod
    def gaussian_mean_planes(self, image: FloatImage, *, projectors: tuple[int, int] | None = None) -> FloatImage:
        """``gaussian_mean`` on planes: (3, rows, columns) to (3, pixels); pixels of other projectors are 0."""

    @abstractmethod
    def submatrix(
        self, box: CameraBox, pixels: npt.NDArray[np.int64], channels: tuple[int, ...]
    ) -> sp.csr_matrix[np.float64]:
        """T in rows (channel, camera pixel of the box) and columns (channel, projector pixel), as a sparse matrix.

        ``pixels`` (n,): rising indices of pixels of all projectors; ``channels``: of the camera and of the projectors
        """

    @abstractmethod
    def arrays(self) -> dict[str, npt.NDArray[Any]]:
        """All that the products depend on, by name."""

    def with_absolute_mixing(self) -> Self:
        """T with every entry's magnitude: mixing may be slightly negative, a majoriser must not be."""
        return dataclasses.replace(self, mixing=np.abs(self.mixing))

    # what block coordinate descent needs: the camera's samples instead of its pictures

    def sensor_buffer(self) -> FloatImage:
        """The light of no projector, (samples,) float32: flat, as the camera samples it.

        A solver that changes one projector at a time adds light to buffers, and needs a picture only at its end. Here a
        buffer is a picture (3, rows, columns), flat.
        """
        return np.zeros(self.sensor_size, np.float32)

    @property
    def sensor_size(self) -> int:
        """How many samples a sensor buffer has."""
        return self.shape[0]

    def accumulate_forward(self, n: int, p: FloatImage, buffer: FloatImage) -> None:
        """Add T_n p_n to a buffer; ``p`` (3, pixels of all projectors), of which those of ``n`` are read."""
        buffer += self.forward_planes(p, projectors=(n, n + 1)).reshape(-1)

    def adjoint_of_buffer(self, n: int, buffer: FloatImage, out: FloatImage) -> None:
        """Write the transpose of ``accumulate_forward`` to the pixels of ``n`` in ``out`` (3, pixels of all)."""
        self.adjoint_planes(buffer.reshape(3, *self.camera_shape), projectors=(n, n + 1), out=out)

    def normal_residual(
        self, buffer: FloatImage, weights: FloatImage, right_hand_side: FloatImage, out: FloatImage
    ) -> None:
        """Write D' w D buffer - right_hand_side, with D making the picture of a buffer; ``weights`` (rows, columns).

        The transpose of ``accumulate_forward`` makes of it the gradient, which is the residual of the normal equations.
        """
        shape = (3, *self.camera_shape)
        residual = out.reshape(shape)
        np.multiply(buffer.reshape(shape), weights, out=residual)
        residual -= right_hand_side.reshape(shape)

    def right_hand_side(self, picture: FloatImage, weights: FloatImage) -> FloatImage:
        """D' w picture, a buffer, from (3, rows, columns), which is overwritten, and (rows, columns)."""
        return np.multiply(picture, weights, out=picture).reshape(-1)

    # SciPy's linear operator

    def _matvec(self, x: _Vector) -> _Vector:
        return _vector(self.forward_planes(_planes(x, self.pixels)), x)

    def _rmatvec(self, x: _Vector) -> _Vector:
        r = _planes(x, self.lit[0].size).reshape(3, *self.camera_shape)
        return _vector(self.adjoint_planes(r), x)

    def _checked(self, image: FloatImage) -> FloatImage:
        check_shape("camera image", image.shape, (*self.camera_shape, 3))
        return image

    def _check_frame(self, n: int, frame: FloatImage) -> None:
        wanted = (*self.sizes[n], 3)
        check_shape(f"frame of projector {n + 1}", frame.shape, wanted, "Make it as large as the projector's image.")


_Vector = npt.NDArray[np.floating]


def _planes(x: _Vector, pixels: int) -> FloatImage:
    return np.ascontiguousarray(x, np.float32).reshape(3, pixels)


def _vector(planes: FloatImage, x: _Vector) -> _Vector:
    """Flat, and in double precision where ``x`` is: norms of solvers that work in it must not overflow."""
    return planes.reshape(-1).astype(np.result_type(x, np.float32), copy=False)
