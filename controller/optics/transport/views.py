"""T of several cameras, or of one camera at several places: the rows of each view's T, over the same frames.

The pictures of all views lie below each other on one sheet, so that whatever works on the picture of one camera works
on that of all. Where no view has a pixel, the sheet is off the object. Solvers see the views' sensor buffers joined end
to end (docs/decisions/0005).

What several views see counts once. A pixel's share is its view's samples of the surface there, of those of all views:
samples lie closer where a camera is nearer, has more pixels, or looks less from the side. They are counted on the
projectors' pixels, each of which lights one place of the surface, so no shape is needed.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final, Self

import cv2
import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from controller.core.arrays import FloatImage, Mask
from controller.core.errors import UsageError
from controller.optics.transport.indirect.indirect_light import IndirectLight
from controller.optics.transport.operator import LightTransport
from controller.optics.transport.planes import CameraBox
from controller.optics.transport.windows.transport import borrow

ALIGNED: Final = 8
"""Rows and columns of each view's part are multiples of it, so that blocks of pixels have one view."""
APART_PX: Final = 8
"""Between views."""
SMOOTH_PX: Final = 9
"""Projector pixels over which samples are counted: the shares of two views change slowly into each other."""
LEAST_SHARE: Final = 0.05
"""What a view says of a place counts above it."""
MOSTLY: Final = 0.7
"""A mean says something where more than this share of it is known."""


@dataclass(frozen=True, slots=True)
class Sheet:
    """Where the views' pictures lie on the sheet; ``sizes``: (rows, columns) of each view's picture."""

    sizes: tuple[tuple[int, int], ...]

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, columns) of the sheet."""
        tops = self._tops()
        return tops[-1], max(_aligned(columns) for _, columns in self.sizes)

    def boxes(self) -> list[CameraBox]:
        """The part of each view."""
        places = zip(self._tops(), self.sizes, strict=False)
        return [CameraBox(top, 0, top + rows, columns) for top, (rows, columns) in places]

    def joined(self, parts: Sequence[npt.NDArray[Any]], beside: float = 0) -> npt.NDArray[Any]:
        """One sheet (rows, columns, ...) of the views' images; ``beside``: what it has where no view has a pixel."""
        sheet = np.full((*self.shape, *parts[0].shape[2:]), beside, np.result_type(*parts))
        for box, part in zip(self.boxes(), parts, strict=True):
            sheet[box.window] = part
        return sheet

    def parts(self, sheet: npt.NDArray[Any]) -> list[npt.NDArray[Any]]:
        """Each view's own part of a sheet (rows, columns, ...)."""
        return [sheet[box.window] for box in self.boxes()]

    def _tops(self) -> list[int]:
        heights = [_aligned(rows) + APART_PX for rows, _ in self.sizes]
        return [sum(heights[:n]) for n in range(len(heights) + 1)]


def _aligned(pixels: int) -> int:
    return -(-pixels // ALIGNED) * ALIGNED


@dataclass(frozen=True, eq=False, repr=False)
class ViewsTransport(LightTransport):
    """T of several views.

    Their light is in the same units (``calibrate.photometry.view_colours``). ``mixing`` is that of the first view; each
    part of T has its own.

    ``views``: T of each; ``sheet``: where their pictures lie
    ``shares`` (rows, columns) float32: how much each pixel counts, 0 to 1; a place's own views add up to 1
    ``trust`` (views, pixels) float32: by how much each view judges a projector pixel's light; adds up to 1, or is 0
    """

    views: tuple[LightTransport, ...]
    sheet: Sheet
    shares: FloatImage
    trust: FloatImage

    @classmethod
    def of(cls, views: Sequence[LightTransport]) -> Self:
        """Of at least one view. Raises UsageError("views-differ") where their projectors' pictures do."""
        first = views[0]
        if any(view.sizes != first.sizes for view in views):
            raise UsageError(
                "views-differ",
                what="The views were calibrated with projectors of different numbers or sizes.",
                remedy="Calibrate all views again with the projectors that the stage has now.",
            )
        sheet = Sheet(tuple(view.camera_shape for view in views))
        samples = np.stack([_samples(view) for view in views])
        total = samples.sum(axis=0)
        own = np.divide(samples, total, out=np.zeros_like(samples), where=total > 0)
        shares = [_seen(view, [share])[0] * view.object_mask for view, share in zip(views, own, strict=True)]
        weight = own * samples
        total = weight.sum(axis=0)
        trust = np.divide(weight, total, out=np.zeros_like(weight), where=total > 0)
        lit = np.stack([sheet.joined([view.lit[n] for view in views]) for n in range(len(first.lit))])
        direct = sum(np.where(view.per_weight > 0, 1 / np.maximum(view.per_weight, 1e-30), 0) for view in views)
        per_weight = np.divide(1, direct, out=np.zeros_like(first.per_weight), where=np.asarray(direct) > 0)
        parts = (tuple(views), sheet, sheet.joined(shares), trust)
        return cls(first.mixing, lit, per_weight, first.sizes, *parts, segments=first.segments, beside=_beside(views))

    def counts(self) -> FloatImage:
        return self.shares.copy()

    def mixing_of(self, n: int) -> FloatImage:
        by_row = np.zeros((3, 3, self.camera_shape[0], 1), np.float32)
        for view, box in zip(self.views, self.sheet.boxes(), strict=True):
            by_row[:, :, box.top : box.bottom] = view.mixing_of(n)
        return by_row

    def by_places(
        self, image: FloatImage, mask: Mask, smooth_px: int = SMOOTH_PX
    ) -> tuple[FloatImage, FloatImage, Mask]:
        """How views differ in an ``image`` of the sheet (rows, columns, 3), known in ``mask``: as the pixel's own view
        has it, as others have it by their ``trust``, and (rows, columns) which pixels' places others see.

        Both are means over ``smooth_px`` projector pixels, so that no view differs by its sharpness.
        """
        planes = np.ascontiguousarray(np.where(mask[..., None], image, 0).transpose(2, 0, 1), np.float32)
        known = np.ascontiguousarray(np.broadcast_to(mask, planes.shape), np.float32)
        means = []
        for (view, part), (_, there) in zip(self._parts(planes), self._parts(known), strict=True):
            image_mean, share = (view.gaussian_mean_planes(np.ascontiguousarray(one)) for one in (part, there))
            means.append(np.stack([_smooth(view, plane, smooth_px) for plane in (*image_mean, share[0])]))
        total = np.sum([trust * own for trust, own in zip(self.trust, means, strict=True)], axis=0)
        seen = []
        for trust, own, view in zip(self.trust, means, self.views, strict=True):
            others = (total - trust * own) / np.maximum(1 - trust, LEAST_SHARE)
            counts = (trust < 1 - LEAST_SHARE) & (trust > LEAST_SHARE) & (own[3] > MOSTLY) & (others[3] > MOSTLY)
            values = [
                np.where(counts, one[c] / np.maximum(one[3], MOSTLY), 0) for one in (own, others) for c in range(3)
            ]
            seen.append(np.stack(_seen(view, [*values, counts.astype(np.float32)]), axis=-1))
        sheet = self.sheet.joined(seen)
        share = np.maximum(sheet[..., 6:], MOSTLY)
        return sheet[..., :3] / share, sheet[..., 3:6] / share, np.asarray(mask & (sheet[..., 6] > MOSTLY))

    # planes

    def forward_planes(
        self, p: FloatImage, *, projectors: tuple[int, int] | None = None, out: FloatImage | None = None
    ) -> FloatImage:
        image = np.empty((3, *self.camera_shape), np.float32) if out is None else out
        image[:] = 0
        for view, part in self._parts(image):
            part[:] = view.forward_planes(p, projectors=projectors)
        return image

    def adjoint_planes(
        self, r: FloatImage, *, projectors: tuple[int, int] | None = None, out: FloatImage | None = None
    ) -> FloatImage:
        out = np.zeros((3, self.pixels), np.float32) if out is None else out
        span = self._span(projectors)
        out[:, span] = 0
        for view, part in self._parts(r):
            out[:, span] += view.adjoint_planes(np.ascontiguousarray(part), projectors=projectors)[:, span]
        return out

    def gaussian_mean_planes(self, image: FloatImage, *, projectors: tuple[int, int] | None = None) -> FloatImage:
        means = np.zeros((3, self.pixels), np.float32)
        span = self._span(projectors)
        for v, (view, part) in enumerate(self._parts(image)):
            own = view.gaussian_mean_planes(np.ascontiguousarray(part), projectors=projectors)
            means[:, span] += self.trust[v, span] * own[:, span]
        return means

    def submatrix(
        self, box: CameraBox, pixels: npt.NDArray[np.int64], channels: tuple[int, ...]
    ) -> sp.csr_matrix[np.float64]:
        width, count = box.right - box.left, (box.bottom - box.top) * (box.right - box.left)
        total = sp.csr_matrix((count * len(channels), pixels.size * len(channels)))
        for view, own in zip(self.views, self.sheet.boxes(), strict=True):
            top, bottom = max(box.top, own.top), min(box.bottom, own.bottom)
            right = min(box.right, own.right)
            if top >= bottom or box.left >= right:
                continue
            rows = view.submatrix(CameraBox(top - own.top, box.left, bottom - own.top, right), pixels, channels)
            y, x = np.mgrid[top - box.top : bottom - box.top, : right - box.left]
            places = (np.arange(len(channels))[:, None] * count + (y * width + x).ravel()).ravel()
            spread = sp.csr_matrix(
                (np.ones(places.size), (places, np.arange(places.size))), (total.shape[0], places.size)
            )
            total = total + spread @ rows
        return sp.csr_matrix(total)

    def arrays(self) -> dict[str, npt.NDArray[Any]]:
        own = {f"{v}-{name}": array for v, view in enumerate(self.views) for name, array in view.arrays().items()}
        return own | {"shares": self.shares, "trust": self.trust}

    def with_absolute_mixing(self) -> Self:
        views = tuple(view.with_absolute_mixing() for view in self.views)
        return dataclasses.replace(self, mixing=views[0].mixing, views=views)

    # sensor buffers

    def sensor_buffer(self) -> FloatImage:
        return np.zeros(self._ends[-1], np.float32)

    def accumulate_forward(self, n: int, p: FloatImage, buffer: FloatImage) -> None:
        for view, own in self._buffers():
            view.accumulate_forward(n, p, buffer[own])

    def adjoint_of_buffer(self, n: int, buffer: FloatImage, out: FloatImage) -> None:
        span = self.span(n)
        (first, own), *others = self._buffers()
        first.adjoint_of_buffer(n, buffer[own], out)
        with borrow(out.shape) as more:
            for view, own in others:
                view.adjoint_of_buffer(n, buffer[own], more)
                out[:, span] += more[:, span]

    def normal_residual(
        self, buffer: FloatImage, weights: FloatImage, right_hand_side: FloatImage, out: FloatImage
    ) -> None:
        for (view, own), part in zip(self._buffers(), self.sheet.parts(weights), strict=True):
            view.normal_residual(buffer[own], np.ascontiguousarray(part), right_hand_side[own], out[own])

    def right_hand_side(self, picture: FloatImage, weights: FloatImage) -> FloatImage:
        out = self.sensor_buffer()
        weighed = zip(self._parts(picture), self._buffers(), self.sheet.parts(weights), strict=True)
        for (view, part), (_, own), weight in weighed:
            out[own] = view.right_hand_side(part.copy(), np.ascontiguousarray(weight))
        return out

    @property
    def _ends(self) -> list[int]:
        return [int(end) for end in np.cumsum([view.sensor_size for view in self.views])]

    def _buffers(self) -> list[tuple[LightTransport, slice]]:
        ends = self._ends
        spans = (slice(start, end) for start, end in zip([0, *ends], ends, strict=False))
        return list(zip(self.views, spans, strict=True))

    def _parts(self, planes: FloatImage) -> list[tuple[LightTransport, FloatImage]]:
        """Each view and its part of (3, rows, columns), not a copy."""
        return [(view, planes[:, *box.window]) for view, box in zip(self.views, self.sheet.boxes(), strict=True)]

    def _span(self, projectors: tuple[int, int] | None) -> slice:
        first, end = projectors or (0, len(self.sizes))
        return slice(self.span(first).start, self.span(end - 1).stop)


def _samples(view: LightTransport) -> FloatImage:
    """(pixels,) how many of the view's pixels see each projector pixel, as a mean over its neighbours."""
    counted = np.divide(1, view.per_weight, out=np.zeros_like(view.per_weight), where=view.per_weight > 0)
    return _smooth(view, np.minimum(counted, np.float32(view.lit[0].size)))


def _smooth(view: LightTransport, values: FloatImage, by_px: int = SMOOTH_PX) -> FloatImage:
    """(pixels,): means of ``values`` (pixels,) over the neighbours of each projector pixel."""
    return np.concatenate([
        cv2.blur(values[view.span(n)].reshape(size), (by_px, by_px), borderType=cv2.BORDER_REPLICATE).ravel()
        for n, size in enumerate(view.sizes)
    ])  # fmt: skip


def _seen(view: LightTransport, values: Sequence[FloatImage]) -> list[FloatImage]:
    """(rows, columns) each: ``values`` (pixels,) of the projector pixels that light a pixel, a mean by their light."""
    planes = np.ones((3, view.pixels), np.float32)
    light, found = view.forward_planes(planes).sum(axis=0), []
    for one in values:
        planes[:] = one
        part = view.forward_planes(planes).sum(axis=0)
        mean = np.divide(part, light, out=np.zeros_like(part), where=light > 0)
        found.append(np.asarray(np.clip(mean, one.min(), one.max())))
    return found


def _beside(views: Sequence[LightTransport]) -> npt.NDArray[np.bool_] | None:
    """Pixels that light the room for one view and the object for none."""
    room = [np.zeros(view.pixels, np.bool_) if view.beside is None else view.beside for view in views]
    on_object = [(view.per_weight > 0) & ~beside for view, beside in zip(views, room, strict=True)]
    found = np.asarray(np.any(room, axis=0) & ~np.any(on_object, axis=0))
    return found if found.any() else None


@dataclass(frozen=True, slots=True, eq=False)
class ViewsIndirect:
    """Light by way of other surfaces as each view knows it, on a sheet; None for a view without any."""

    views: tuple[IndirectLight | None, ...]
    sheet: Sheet

    def arrays(self) -> dict[str, npt.NDArray[Any]]:
        """As of ``LightTransport.arrays``."""
        own = {v: view for v, view in enumerate(self.views) if view is not None}
        return {f"{v}-{name}": array for v, view in own.items() for name, array in view.arrays().items()}

    def forward(self, direct: FloatImage, beside: FloatImage | None = None) -> FloatImage:
        """As ``IndirectLight.forward``."""
        out = np.zeros_like(direct)
        for view, box in zip(self.views, self.sheet.boxes(), strict=True):
            if view is not None:
                room = None if beside is None else beside[box.window]
                out[box.window] = view.forward(np.ascontiguousarray(direct[box.window]), room)
        return out

    def direct_target(self, total: FloatImage, *, reach: FloatImage | None = None) -> FloatImage:
        """As ``IndirectLight.direct_target``."""
        out = np.array(total, np.float32)
        for view, box in zip(self.views, self.sheet.boxes(), strict=True):
            if view is not None:
                most = None if reach is None else reach[box.window]
                out[box.window] = view.direct_target(total[box.window], reach=most)
        return out
