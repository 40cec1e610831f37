"""The light transport T of a stage: camera image = K + T p (paper 2.1, eq. 1; 4.2.3).

For projector n with frame p_n, T_n p_n = W_n (.) G_n (p_n M_n'). W_n is the projector's white image, M_n its colour
mixing, and G_n holds, for each camera pixel, the shares of its light that come from each projector pixel: metapixel
Gaussians, normalised to sum 1 over the projector pixels. So T_n 1 reproduces W_n, which a plain Gaussian model counts
twice where neighbours overlap, and edges of the object's colour stay as sharp as the camera sees them.

Where the camera's own blur H is known, it stands in the shares: G_n p = H (a_n (.) g_n p) / H (a_n (.) g_n 1), with g_n
the shares on the object and a_n the white image before the blur (docs/decisions/0006).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from controller.arrays import FloatImage, Mask
from controller.calibrate.values import Calibration, Metapixels
from controller.errors import UsageError
from controller.storage import stream_atomically
from controller.transport.blur import blur_planes, gaussian_taps, sharpened, without_blur
from controller.transport.patches import Patches, build_patches
from controller.transport.planes import frame_planes, image_planes, plane_frames, plane_image
from controller.transport.products import adjoint_planes, forward_planes, gaussian_sums, multiply_add

VERSION: Final = 2
FAINTEST: Final = 1e-6
"""A camera pixel counts as lit by a projector above this fraction of the projector's brightest white."""


@dataclass(frozen=True, slots=True)
class LightTransport:
    """T without its black image K, for all projectors of a stage and three channels at once.

    ``patches``: Gaussian weights of every metapixel, before normalisation
    ``gain`` (projectors, 3, rows, columns) float32: white over sum of weights, 0 where a camera pixel is not counted
    ``after`` (projectors, 3, rows, columns) float32: factor after the camera's blur; without blur (projectors, 3, 0, 0)
    ``taps`` (3, 2 r + 1) float32: the camera's blur along an axis; a single 1 where it is not modelled
    ``mixing`` (projectors, 3, 3) float32: camera channel by projector channel
    ``lit`` (projectors, rows, columns) bool: camera pixels on the object with shares of that projector
    ``per_weight`` (pixels,) float32: 1 / sum of a metapixel's weights over its lit camera pixels, or 0
    ``sizes``: (rows, columns) of each projector's image
    """

    patches: Patches
    gain: FloatImage
    mixing: FloatImage
    lit: Mask
    per_weight: FloatImage
    after: FloatImage
    taps: FloatImage
    sizes: tuple[tuple[int, int], ...]

    @classmethod
    def build(cls, calibration: Calibration, *, patches: Patches | None = None) -> LightTransport:
        """Build T from a calibration.

        Camera pixels outside ``object_mask``, or not lit by a projector, have no shares of it. Metapixels that are not
        valid, not finite, or larger than 255 camera pixels light nothing. ``patches`` replace the metapixels by another
        model of a projector pixel (``any_weights``).

        Raises UsageError("calibration-inconsistent") when sizes differ or an image is not finite.
        """
        _check(calibration)
        projectors = calibration.projectors
        shape = calibration.object_mask.shape
        blur_px = calibration.camera_blur_px
        on_object = tuple(without_blur(p.metapixels, blur_px) for p in projectors)
        if patches is None:
            patches = build_patches(on_object, (shape[0], shape[1]))
        taps = gaussian_taps(blur_px)
        blurred = taps.shape[1] > 1
        gain = np.ones((len(projectors), 3, *shape), np.float32)
        after = np.zeros((len(projectors), 3, *(shape if blurred else (0, 0))), np.float32)
        lit = np.zeros((len(projectors), *shape), np.bool_)
        ones = np.ones((3, patches.first.size), np.float32)
        plain = np.broadcast_to(np.eye(3, dtype=np.float32), (len(projectors), 3, 3)).copy()
        total = np.empty((3, *shape), np.float32)
        for n, projector in enumerate(projectors):
            forward_planes(patches, gain, plain, ones, (n, n + 1), total)
            white = projector.white
            lit[n] = calibration.object_mask & (total[0] > 0) & (white.max(axis=2) > FAINTEST * white.max(initial=0))
            inverse = np.divide(1, total[0], out=np.zeros(shape, np.float32), where=lit[n])
            planes = image_planes(white)
            colour = sharpened(planes, taps) if blurred else planes
            np.multiply(colour, inverse, out=gain[n])
            if blurred:
                _match_white(planes, np.where(lit[n], colour, 0), taps, lit[n], after[n])
        total[:] = 1
        weights = np.zeros_like(ones)
        gaussian_sums(patches, lit, total, ones[0], (0, len(projectors)), weights)
        per_weight = np.divide(1, weights[0], out=np.zeros_like(weights[0]), where=weights[0] > 0)
        mixing = np.stack([p.radiometry.mixing for p in projectors]).astype(np.float32)
        sizes = tuple((p.metapixels.valid.shape[0], p.metapixels.valid.shape[1]) for p in projectors)
        return cls(patches, gain, mixing, lit, per_weight, after, taps, sizes)

    @property
    def _blurred(self) -> bool:
        return int(self.taps.shape[1]) > 1

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, columns) of the camera image."""
        return self.lit.shape[1], self.lit.shape[2]

    @property
    def object_mask(self) -> Mask:
        """(rows, columns): camera pixels that at least one projector lights."""
        return np.asarray(self.lit.any(axis=0))

    def span(self, n: int) -> slice:
        """The pixels of projector ``n`` among those of all projectors."""
        return slice(int(self.patches.start[n]), int(self.patches.start[n + 1]))

    def forward(self, p: Sequence[FloatImage]) -> FloatImage:
        """T p: (rows, columns, 3) light from one (rows, columns, 3) frame a projector; K is not in it."""
        for n, frame in enumerate(p):
            self._check_frame(n, frame)
        return plane_image(self.forward_planes(frame_planes(p)))

    def project_one(self, n: int, p: FloatImage) -> FloatImage:
        """T_n p_n: (rows, columns, 3) light from projector ``n`` alone."""
        self._check_frame(n, p)
        planes = np.zeros((3, self.patches.first.size), np.float32)
        planes[:, self.span(n)] = frame_planes([p])
        return plane_image(self.forward_planes(planes, projectors=(n, n + 1)))

    def adjoint(self, r: FloatImage) -> list[FloatImage]:
        """T' r: one (rows, columns, 3) image a projector from a camera image (rows, columns, 3)."""
        return plane_frames(self.adjoint_planes(image_planes(self._checked(r))), self.sizes)

    def reach(self) -> FloatImage:
        """T 1: (rows, columns, 3) the light with every projector at white."""
        return plane_image(self.reach_planes())

    def share_sums(self, n: int) -> FloatImage:
        """(rows, columns): the sum of shares of projector ``n`` at each camera pixel, 1 where lit and 0 elsewhere."""
        return np.asarray(self.lit[n], np.float32)

    def gaussian_mean(self, image: FloatImage, n: int) -> FloatImage:
        """Mean of a camera image over each metapixel of projector ``n``, by its normalised Gaussian (paper 3.1, eq. 6).

        ``image`` (rows, columns, 3), finite. Returns (rows, columns, 3) of the projector, 0 where no pixel is lit.
        """
        means = self.gaussian_mean_planes(image_planes(self._checked(image)), projectors=(n, n + 1))
        (frame,) = plane_frames(means[:, self.span(n)], [self.sizes[n]])
        return frame

    def forward_planes(
        self, p: FloatImage, *, projectors: tuple[int, int] | None = None, out: FloatImage | None = None
    ) -> FloatImage:
        """T p on planes: (3, pixels) to (3, rows, columns), for a range of projectors or for all."""
        out = np.empty((3, *self.shape), np.float32) if out is None else out
        projectors = projectors or (0, len(self.sizes))
        if not self._blurred:
            forward_planes(self.patches, self.gain, self.mixing, p, projectors, out)
            return out
        out[:] = 0
        light, scratch = np.empty_like(out), np.empty_like(out)
        for n in range(*projectors):
            forward_planes(self.patches, self.gain, self.mixing, p, (n, n + 1), light)
            blur_planes(light, self.taps, scratch, light)
            multiply_add(out, self.after[n], light)
        return out

    def adjoint_planes(self, r: FloatImage, *, out: FloatImage | None = None) -> FloatImage:
        """T' r on planes: (3, rows, columns) to (3, pixels)."""
        out = np.empty((3, self.patches.first.size), np.float32) if out is None else out
        if not self._blurred:
            adjoint_planes(self.patches, self.gain, self.mixing, r, (0, len(self.sizes)), out)
            return out
        part, scratch = np.empty_like(r), np.empty_like(r)
        for n in range(len(self.sizes)):
            np.multiply(self.after[n], r, out=part)
            blur_planes(part, self.taps, scratch, part)
            adjoint_planes(self.patches, self.gain, self.mixing, part, (n, n + 1), out)
        return out

    def gaussian_mean_planes(self, image: FloatImage, *, projectors: tuple[int, int] | None = None) -> FloatImage:
        """``gaussian_mean`` on planes: (3, rows, columns) to (3, pixels); pixels of other projectors are 0."""
        out = np.zeros((3, self.patches.first.size), np.float32)
        gaussian_sums(self.patches, self.lit, image, self.per_weight, projectors or (0, len(self.sizes)), out)
        return out

    def reach_planes(self) -> FloatImage:
        """T 1 as (3, rows, columns)."""
        return self.forward_planes(np.ones((3, self.patches.first.size), np.float32))

    def with_absolute_mixing(self) -> LightTransport:
        """T with every entry's magnitude: mixing may be slightly negative, a majoriser must not be."""
        return dataclasses.replace(self, mixing=np.abs(self.mixing))

    def save(self, folder: Path) -> None:
        """Write one .npy file an array; ``load`` maps them instead of reading them."""
        folder.mkdir(parents=True, exist_ok=True)
        header = folder / "header.npy"
        header.unlink(missing_ok=True)
        arrays = self.patches._asdict() | {name: getattr(self, name) for name in _ARRAYS}
        for name, array in arrays.items():
            _save(folder / f"{name}.npy", array)
        _save(header, np.array([(VERSION, len(self.sizes)), *self.sizes], np.int64))

    @classmethod
    def load(cls, folder: Path) -> LightTransport:
        """Map what ``save`` wrote. Raises UsageError("transport-unreadable") for anything else."""
        try:
            header = np.load(folder / "header.npy", allow_pickle=False)
            if header[0, 0] != VERSION:
                raise ValueError(f"version {header[0, 0]} instead of {VERSION}")
            patches = Patches(*(_load(folder / f"{name}.npy") for name in Patches._fields))
            gain, mixing, lit, per_weight, after, taps = (_load(folder / f"{name}.npy") for name in _ARRAYS)
        except (OSError, ValueError, IndexError) as error:
            raise UsageError(
                "transport-unreadable",
                what=f"{folder} does not hold a light transport ({error}).",
                remedy="Remove the folder and solve again; it is rebuilt from the calibration.",
            ) from error
        sizes = tuple((int(rows), int(columns)) for rows, columns in header[1:])
        return cls(patches, gain, mixing, lit, per_weight, after, taps, sizes)

    def _checked(self, image: FloatImage) -> FloatImage:
        if image.shape != (*self.shape, 3):
            raise _wrong_size("camera image", image.shape, (*self.shape, 3))
        return image

    def _check_frame(self, n: int, frame: FloatImage) -> None:
        if frame.shape != (*self.sizes[n], 3):
            raise _wrong_size(f"frame of projector {n + 1}", frame.shape, (*self.sizes[n], 3))


_ARRAYS: Final = ("gain", "mixing", "lit", "per_weight", "after", "taps")


def _match_white(white: FloatImage, colour: FloatImage, taps: FloatImage, lit: Mask, after: FloatImage) -> None:
    """Write the factor that makes the blurred ``colour`` (3, rows, columns) the ``white`` image again, where lit."""
    scratch, blurred = np.empty_like(white), np.empty_like(white)
    blur_planes(colour, taps, scratch, blurred)
    np.divide(white, blurred, out=after, where=lit & (blurred > 0))


def _save(path: Path, array: npt.NDArray[Any]) -> None:
    stream_atomically(path, lambda file: np.save(file, array, allow_pickle=False))


def _load(path: Path) -> npt.NDArray[Any]:
    # Copy-on-write keeps the arrays of the type the kernels are compiled for; nobody writes to them.
    return np.asarray(np.load(path, mmap_mode="c", allow_pickle=False))


def _wrong_size(what: str, got: tuple[int, ...], wanted: tuple[int, ...]) -> UsageError:
    return UsageError(
        "image-wrong-size",
        what=f"A {what} is {' x '.join(map(str, got))} instead of {' x '.join(map(str, wanted))}.",
        remedy="Give an image of the size of this stage's camera or projector.",
    )


def _check(calibration: Calibration) -> None:
    shape = (*calibration.object_mask.shape, 3)
    problem = None
    if not calibration.projectors:
        problem = "it has no projector"
    elif calibration.black.shape != shape or not np.isfinite(calibration.black).all():
        problem = "its black image has another size than the camera's, or is not finite"
    for projector in calibration.projectors:
        white, metapixels = projector.white, projector.metapixels
        if white.shape != shape or not np.isfinite(white).all() or white.min(initial=0) < 0:
            problem = (
                f"the white image of {projector.name} has another size than the camera's, is not finite or negative"
            )
        elif not _consistent(metapixels):
            problem = f"the metapixels of {projector.name} differ in size"
    if problem is not None:
        raise UsageError(
            "calibration-inconsistent",
            what=f"The calibration can't be used: {problem}.",
            remedy="Calibrate the stage again.",
        )


def _consistent(metapixels: Metapixels) -> bool:
    shape = metapixels.valid.shape
    return metapixels.centre_px.shape == (*shape, 2) and metapixels.covariance_px2.shape == (*shape, 3)
