"""The light transport T of a stage: camera image = K + T p (paper 2.1, eq. 1; 4.2.3).

For projector n with frame p_n, T_n p_n = W_n (.) G_n (p_n M_n'). W_n is the projector's white image, M_n its colour
mixing, and G_n holds, for each camera pixel, the shares of its light that come from each projector pixel; they sum to
1. So T_n 1 reproduces W_n, which a plain Gaussian model counts twice where neighbours overlap, and edges of the
object's colour stay as sharp as the camera sees them.

There are two kinds. Where the phase map is known, each camera sample has its own shares (``window_transport``,
docs/decisions/0010). Where only metapixels are, the shares are their Gaussians (``patch_transport``).
"""

from __future__ import annotations

import dataclasses
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Self

import numpy as np
import numpy.typing as npt

from controller.arrays import FloatImage, Mask
from controller.calibrate.values import Calibration, Metapixels
from controller.errors import UsageError
from controller.storage import stream_atomically
from controller.transport.planes import frame_planes, image_planes, plane_frames, plane_image

if TYPE_CHECKING:
    from controller.transport.patches import Patches

VERSION: Final = 4
FAINTEST: Final = 1e-6
"""A camera pixel counts as lit by a projector above this fraction of the projector's brightest white."""


@dataclass(frozen=True, slots=True, eq=False)
class LightTransport(ABC):
    """T without its black image K, for all projectors of a stage and three channels at once.

    ``mixing`` (projectors, 3, 3) float32: camera channel by projector channel
    ``lit`` (projectors, rows, columns) bool: camera pixels on the object with shares of that projector
    ``per_weight`` (pixels,) float32: 1 / sum of a projector pixel's shares over its lit camera pixels, or 0
    ``sizes``: (rows, columns) of each projector's image
    """

    mixing: FloatImage
    lit: Mask
    per_weight: FloatImage
    sizes: tuple[tuple[int, int], ...]

    @staticmethod
    def build(calibration: Calibration, *, patches: Patches | None = None) -> LightTransport:
        """Build T from a calibration.

        Camera pixels outside ``object_mask``, or not lit by a projector, have no shares of it. Shares come from the
        phase maps where every projector has one, else from the metapixels; of these, those that are not valid, not
        finite, or larger than 255 camera pixels light nothing. ``patches`` take the place of both, for another model of
        a projector pixel (``any_weights``).

        Raises UsageError("calibration-inconsistent") when sizes differ or an image is not finite.
        """
        from controller.transport.patch_transport import PatchTransport
        from controller.transport.window_transport import WindowTransport

        check_calibration(calibration)
        if patches is None and all(part.phase_map is not None for part in calibration.projectors):
            return WindowTransport.from_calibration(calibration)
        return PatchTransport.from_calibration(calibration, patches)

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, columns) of the camera image."""
        return self.lit.shape[1], self.lit.shape[2]

    @property
    def object_mask(self) -> Mask:
        """(rows, columns): camera pixels that at least one projector lights."""
        return np.asarray(self.lit.any(axis=0))

    @property
    def pixels(self) -> int:
        """How many pixels all projectors have."""
        return sum(rows * columns for rows, columns in self.sizes)

    def span(self, n: int) -> slice:
        """The pixels of projector ``n`` among those of all projectors."""
        start = sum(rows * columns for rows, columns in self.sizes[:n])
        return slice(start, start + self.sizes[n][0] * self.sizes[n][1])

    def forward(self, p: Sequence[FloatImage]) -> FloatImage:
        """T p: (rows, columns, 3) light from one (rows, columns, 3) frame a projector; K is not in it."""
        for n, frame in enumerate(p):
            self._check_frame(n, frame)
        return plane_image(self.forward_planes(frame_planes(p)))

    def project_one(self, n: int, p: FloatImage) -> FloatImage:
        """T_n p_n: (rows, columns, 3) light from projector ``n`` alone."""
        self._check_frame(n, p)
        planes = np.zeros((3, self.pixels), np.float32)
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

    @abstractmethod
    def forward_planes(
        self, p: FloatImage, *, projectors: tuple[int, int] | None = None, out: FloatImage | None = None
    ) -> FloatImage:
        """T p on planes: (3, pixels) to (3, rows, columns), for a range of projectors or for all."""

    @abstractmethod
    def adjoint_planes(self, r: FloatImage, *, out: FloatImage | None = None) -> FloatImage:
        """T' r on planes: (3, rows, columns) to (3, pixels)."""

    def adjoint_part(self, n: int, r: FloatImage, out: FloatImage) -> None:
        """Write T_n' r, of a picture (3, rows, columns), to the pixels of ``n`` in ``out`` (3, pixels of all)."""
        out[:, self.span(n)] = self.adjoint_planes(r)[:, self.span(n)]

    def sheet(self) -> FloatImage:
        """The light of no projector, in the form that a solver keeps it in: as the camera samples it.

        A solver that changes one projector at a time adds light to sheets, and needs a picture only at its end. Here a
        sheet is a picture (3, rows, columns).
        """
        return np.zeros((3, *self.shape), np.float32)

    def add_light(self, n: int, p: FloatImage, sheet: FloatImage) -> None:
        """Add T_n p_n to a sheet; ``p`` (3, pixels of all projectors), of which those of ``n`` are read."""
        sheet += self.forward_planes(p, projectors=(n, n + 1))

    def pull(self, n: int, sheet: FloatImage, out: FloatImage) -> None:
        """Write the transpose of ``add_light`` to the pixels of ``n`` in ``out`` (3, pixels of all projectors)."""
        self.adjoint_part(n, sheet, out)

    def weigh(self, sheet: FloatImage, weights: FloatImage, aim: FloatImage, out: FloatImage) -> None:
        """Write D' w D sheet - aim, with D making the picture of a sheet; ``weights`` (rows, columns)."""
        np.multiply(sheet, weights, out=out)
        out -= aim

    def aim(self, picture: FloatImage, weights: FloatImage) -> FloatImage:
        """D' w picture: a sheet, from (3, rows, columns) and (rows, columns)."""
        return picture * weights

    @abstractmethod
    def gaussian_mean_planes(self, image: FloatImage, *, projectors: tuple[int, int] | None = None) -> FloatImage:
        """``gaussian_mean`` on planes: (3, rows, columns) to (3, pixels); pixels of other projectors are 0."""

    @abstractmethod
    def arrays(self) -> dict[str, npt.NDArray[Any]]:
        """Everything that ``restored`` needs, by name."""

    @classmethod
    @abstractmethod
    def restored(cls, arrays: dict[str, npt.NDArray[Any]], sizes: tuple[tuple[int, int], ...]) -> LightTransport:
        """From ``arrays``. Raises KeyError where one is missing."""

    @property
    def stored_bytes(self) -> int:
        """The size of what a product reads of T."""
        return sum(
            array.nbytes for name, array in self.arrays().items() if name not in ("lit", "per_weight", "per_sum")
        )

    def reach_planes(self) -> FloatImage:
        """T 1 as (3, rows, columns)."""
        return self.forward_planes(np.ones((3, self.pixels), np.float32))

    def with_absolute_mixing(self) -> Self:
        """T with every entry's magnitude: mixing may be slightly negative, a majoriser must not be."""
        return dataclasses.replace(self, mixing=np.abs(self.mixing))

    def save(self, folder: Path) -> None:
        """Write one .npy file an array; ``load`` maps them instead of reading them."""
        folder.mkdir(parents=True, exist_ok=True)
        header = folder / "header.npy"
        header.unlink(missing_ok=True)
        for name, array in self.arrays().items():
            _save(folder / f"{name}.npy", array)
        _save(folder / "sizes.npy", np.array(self.sizes, np.int64).reshape(-1, 2))
        _save(header, np.array([VERSION, _kinds().index(type(self))], np.int64))

    @staticmethod
    def load(folder: Path) -> LightTransport:
        """Map what ``save`` wrote. Raises UsageError("transport-unreadable") for anything else."""
        try:
            version, kind = (int(value) for value in np.load(folder / "header.npy", allow_pickle=False))
            if version != VERSION:
                raise ValueError(f"version {version} instead of {VERSION}")
            sizes = tuple((int(r), int(c)) for r, c in np.load(folder / "sizes.npy", allow_pickle=False))
            left_out = ("header", "sizes")
            arrays = {path.stem: _load(path) for path in sorted(folder.glob("*.npy")) if path.stem not in left_out}
            return _kinds()[kind].restored(arrays, sizes)
        except (OSError, ValueError, IndexError, KeyError, TypeError) as error:
            raise UsageError(
                "transport-unreadable",
                what=f"{folder} does not hold a light transport ({error}).",
                remedy="Remove the folder and solve again; it is rebuilt from the calibration.",
            ) from error

    def _checked(self, image: FloatImage) -> FloatImage:
        if image.shape != (*self.shape, 3):
            raise _wrong_size("camera image", image.shape, (*self.shape, 3))
        return image

    def _check_frame(self, n: int, frame: FloatImage) -> None:
        if frame.shape != (*self.sizes[n], 3):
            raise _wrong_size(f"frame of projector {n + 1}", frame.shape, (*self.sizes[n], 3))


def _kinds() -> list[type[LightTransport]]:
    from controller.transport.patch_transport import PatchTransport
    from controller.transport.window_transport import WindowTransport

    return [PatchTransport, WindowTransport]


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


def check_calibration(calibration: Calibration) -> None:
    """Raise UsageError("calibration-inconsistent") when sizes differ or an image is not finite."""
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
        elif projector.phase_map is not None and not (
            projector.phase_map.projector_px.shape == (*shape[:2], 2)
            and projector.phase_map.spread_px2.shape == (*metapixels.valid.shape, 3)
        ):
            problem = f"the phase map of {projector.name} has another size than its pictures"
    if problem is not None:
        raise UsageError(
            "calibration-inconsistent",
            what=f"The calibration can't be used: {problem}.",
            remedy="Calibrate the stage again.",
        )


def _consistent(metapixels: Metapixels) -> bool:
    shape = metapixels.valid.shape
    return metapixels.centre_px.shape == (*shape, 2) and metapixels.covariance_px2.shape == (*shape, 3)
