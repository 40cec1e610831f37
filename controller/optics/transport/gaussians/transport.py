"""The light transport where only metapixels are known: Gaussians in the camera image, normalised (paper 4.2.3).

Where the camera's own blur H is known, it stands in the shares: G_n p = H (a_n (.) g_n p) / H (a_n (.) g_n 1), with g_n
the shares on the object and a_n the white image before the blur (docs/decisions/0006).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from controller.core import channels
from controller.core.arrays import FloatImage, Mask
from controller.optics.calibrate.values import Calibration
from controller.optics.transport.camera_box import CameraBox
from controller.optics.transport.gaussians.blur import blur_planes, gaussian_taps, sharpened, without_blur
from controller.optics.transport.gaussians.matrix import patch_rows
from controller.optics.transport.gaussians.patches import Patches, build_patches
from controller.optics.transport.gaussians.products import adjoint_planes, forward_planes, gaussian_sums, multiply_add
from controller.optics.transport.operator import FAINTEST, LightTransport
from controller.optics.transport.planes import image_planes


@dataclass(frozen=True, eq=False, repr=False)
class PatchTransport(LightTransport):
    """T by metapixels.

    ``patches``: Gaussian weights of every metapixel, before normalisation
    ``gain`` (projectors, 3, rows, columns) float32: white over sum of weights, 0 where a camera pixel is not counted
    ``after`` (projectors, 3, rows, columns) float32: factor after the camera's blur; without blur (projectors, 3, 0, 0)
    ``taps`` (3, 2 r + 1) float32: the camera's blur along an axis; a single 1 where it is not modelled
    """

    patches: Patches
    gain: FloatImage
    after: FloatImage
    taps: FloatImage

    @classmethod
    def from_calibration(cls, calibration: Calibration, patches: Patches | None = None) -> PatchTransport:
        """Build T from metapixels, or from ``patches`` of another model; the calibration is consistent."""
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
            bright = channels.largest(white) > FAINTEST * white.max(initial=0)
            lit[n] = calibration.object_mask & (total[0] > 0) & bright
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
        return cls(mixing, lit, per_weight, sizes, patches, gain, after, taps)

    @property
    def _blurred(self) -> bool:
        return int(self.taps.shape[1]) > 1

    def forward_planes(
        self, p: FloatImage, *, projectors: tuple[int, int] | None = None, out: FloatImage | None = None
    ) -> FloatImage:
        """T p on planes: (3, pixels) to (3, rows, columns), for a range of projectors or for all."""
        out = np.empty((3, *self.camera_shape), np.float32) if out is None else out
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

    def adjoint_planes(
        self, r: FloatImage, *, projectors: tuple[int, int] | None = None, out: FloatImage | None = None
    ) -> FloatImage:
        """T' r on planes, as ``LightTransport.adjoint_planes``."""
        out = np.zeros((3, self.pixels), np.float32) if out is None else out
        projectors = projectors or (0, len(self.sizes))
        if not self._blurred:
            adjoint_planes(self.patches, self.gain, self.mixing, r, projectors, out)
            return out
        for n in range(*projectors):
            light, scratch = self.after[n] * r, np.empty_like(r)
            blur_planes(light, self.taps, scratch, light)
            adjoint_planes(self.patches, self.gain, self.mixing, light, (n, n + 1), out)
        return out

    def gaussian_mean_planes(self, image: FloatImage, *, projectors: tuple[int, int] | None = None) -> FloatImage:
        """``gaussian_mean`` on planes: (3, rows, columns) to (3, pixels); pixels of other projectors are 0."""
        out = np.zeros((3, self.pixels), np.float32)
        gaussian_sums(self.patches, self.lit, image, self.per_weight, projectors or (0, len(self.sizes)), out)
        return out

    def submatrix(
        self, box: CameraBox, pixels: npt.NDArray[np.int64], channels: tuple[int, ...]
    ) -> sp.csr_matrix[np.float64]:
        """A part of T as a sparse matrix, as ``LightTransport.submatrix``."""
        return patch_rows(self.patches, self.gain, self.after, self.taps, self.mixing, box, pixels, channels)

    def arrays(self) -> dict[str, npt.NDArray[Any]]:
        """All that the products depend on, by name."""
        own = ("mixing", "lit", "per_weight", "gain", "after", "taps")
        return self.patches._asdict() | {name: getattr(self, name) for name in own}


def _match_white(white: FloatImage, colour: FloatImage, taps: FloatImage, lit: Mask, after: FloatImage) -> None:
    """Write the factor that makes the blurred ``colour`` (3, rows, columns) the ``white`` image again, where lit."""
    scratch, blurred = np.empty_like(white), np.empty_like(white)
    blur_planes(colour, taps, scratch, blurred)
    np.divide(white, blurred, out=after, where=lit & (blurred > 0))
