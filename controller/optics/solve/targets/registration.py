"""Where a picture of how an object should look lies on the object, as the camera sees it.

The two may differ in all their colours: a photograph of before it faded, a reconstruction. So what is compared is
structure: lightness, and the strength of edges whatever their sign, each relative to its surroundings. Features of both
(SIFT, RootSIFT) give a homography (MAGSAC). With it each feature is looked for again, near to where it should be; where
the object is not flat, those that move as their neighbours do bend the picture around it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Final, TypeAlias

import cv2
import numpy as np

from controller.core import channels
from controller.core.arrays import Float64, FloatImage, Mask, strips
from controller.core.errors import UsageError

Points: TypeAlias = Sequence[tuple[float, float, float, float]]
"""x, y in the picture, then x, y in the camera's picture, in pixels; 0, 0 is the middle of the first pixel."""

LONGEST_PX: Final = 1400
"""Longer side at which the two are compared."""
AROUND_PX: Final = 10.0
"""Sigma of the surroundings that structure is relative to."""
FAINT: Final = 0.02
"""Of the mean contrast (squared): below it is noise, which must not become structure."""
FEATURES: Final = 4000
RATIO: Final = 0.88
"""A feature counts where its nearest one is so much nearer than the next one."""
NEAR_PX: Final = 2.0
SPOT_PX: Final = 4.0
FEWEST_SPOTS: Final = 8
"""Places that agree on one homography. Two different pictures have at most 5, by chance."""
SEARCH: Final = 0.08
"""Of the object's longer side: so far from the homography a feature is looked for."""
NEIGHBOURS: Final = 8
FLAT_PX: Final = 0.5
"""So far from the homography are the places of a flat object, by noise."""
FEWEST_IN_BLOCK: Final = 3
HALVES_AGREE: Final = 0.5
FEWEST_BENT: Final = 16
REACH: Final = 0.08
"""Of the object's longer side: so far from the next feature a bent picture is believed."""
BLOCKS: Final = 24
SMOOTHING: Final = 3e-3
NODE_PX: Final = 8
MEASURED: Final = 0.04
"""Of the object's longer side: so far from the next feature the residual is measured."""
FEWEST_POINTS: Final = 4
ON_A_LINE: Final = 0.01
"""Of four points as far apart as they can be: below it, they are as good as on a line."""


@dataclass(frozen=True, slots=True)
class Registration:
    """Where each camera pixel lies in a picture.

    ``position_px`` (rows, columns, 2) float32: x, y in the picture
    ``inside`` (rows, columns) bool: on the picture, where it is known
    ``matched`` (rows, columns) bool: and near enough to what both have in common
    ``residual_px`` (rows, columns) float32: by how many camera pixels structure lies beside its place; NaN where the
        two have none in common
    ``turned_degrees``: by so much the picture is turned, clockwise, to lie on the object; -180 to 180
    ``by_points``: by the given points alone, because the two have too little in common
    """

    position_px: FloatImage
    inside: Mask
    matched: Mask
    residual_px: FloatImage
    turned_degrees: float
    by_points: bool


def register(picture: FloatImage, own: FloatImage, points: Points = ()) -> Registration:
    """Lay ``picture`` (height, width, 3) on the object, whose own reflectance is ``own`` (rows, columns, 3).

    Both are linear light of any colours, NaN where there is nothing. ``points``, at least four, go before what both
    have in common; that makes them more exact. Raises UsageError("restoration-not-matched", "restoration-mirrored",
    "restoration-points").
    """
    scan, body = _look(picture), _look(own)
    there, here = _features(scan), _features(body)
    if points:
        homography = _inverse(scan.to_whole) @ _by_points(points, picture.shape, own.shape) @ body.to_whole
    else:
        homography = _by_features(scan, there, here)
    near_px = SEARCH * max(body.known.shape)
    exact, spots = _agreed(_pairs(there, here, homography, near_px))
    by_points = exact is None or spots < FEWEST_SPOTS
    if exact is None or by_points:
        ends = zip((body, scan), _ends(points), strict=True)
        pairs = np.hstack([_moved_by(_inverse(look.to_whole), at) for look, at in ends]).astype(np.float32)
    else:
        homography = exact
        pairs = _pairs(there, here, homography, near_px)
    at = pairs[:, :2].astype(np.float64)
    off = _moved_by(_inverse(homography), pairs[:, 2:]) - at
    if not by_points:
        alike = _like_neighbours(at, off)
        at, off = at[alike], off[alike]
    return _laid(scan, body, own.shape[:2], _Fit(homography, at, off, by_points))


def carried(registration: Registration, places_px: FloatImage) -> Registration:
    """The same from another place, whose pixels lie at ``places_px`` (rows, columns, 2) in this camera's picture.

    NaN: this camera does not see what lies there, so it is not on the picture.
    """
    x, y = np.moveaxis(np.nan_to_num(places_px, nan=-9.0).astype(np.float32), 2, 0)
    position = cv2.remap(registration.position_px, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    inside, matched, residual = (
        cv2.remap(image.astype(np.float32), x, y, cv2.INTER_NEAREST)
        for image in (registration.inside, registration.matched, registration.residual_px)
    )
    there = np.isfinite(places_px[..., 0])
    residual_px = np.where(matched > 0, residual, np.nan).astype(np.float32)
    return replace(registration, position_px=np.asarray(position, np.float32), inside=there & (inside > 0),
                   matched=there & (matched > 0), residual_px=np.asarray(residual_px, np.float32))  # fmt: skip


@dataclass(frozen=True, slots=True)
class _Look:
    """A picture at the size at which it is compared.

    ``kinds``: its structure (rows, columns) by lightness and by edges; ``known`` (rows, columns)
    ``to_whole`` (3, 3): its pixels to those of the whole picture
    """

    kinds: tuple[FloatImage, FloatImage]
    known: Mask
    to_whole: Float64


_Features: TypeAlias = list[tuple[FloatImage, FloatImage]]
"""Positions (n, 2) and unit descriptors (n, 128) of each kind of structure."""


def _look(image: FloatImage) -> _Look:
    known = channels.finite(image)
    if not known.any():
        raise _not_matched("There is nothing to compare")
    rows, columns = (np.flatnonzero(known.any(axis=axis)) for axis in (1, 0))
    box = slice(int(rows[0]), int(rows[-1]) + 1), slice(int(columns[0]), int(columns[-1]) + 1)
    cut, known = image[box], known[box]
    height, width = known.shape
    by = min(1.0, LONGEST_PX / max(known.shape))
    size_px = (max(8, round(width * by)), max(8, round(height * by)))
    encoded = np.sqrt(np.where(known[..., None], np.maximum(cut, 0), 0)).astype(np.float32)
    encoded = np.asarray(cv2.resize(encoded, size_px, interpolation=cv2.INTER_AREA), np.float32)
    share = np.asarray(cv2.resize(known.astype(np.float32), size_px, interpolation=cv2.INTER_AREA), np.float32)
    known = share > 0.999
    across, down = width / size_px[0], height / size_px[1]
    left, top = box[1].start + (across - 1) / 2, box[0].start + (down - 1) / 2
    smooth = cv2.GaussianBlur(encoded, (0, 0), 1.0)
    slopes = [cv2.Sobel(smooth, cv2.CV_32F, *axis) for axis in ((1, 0), (0, 1))]
    edges = np.sqrt(channels.length(np.asarray(np.hypot(*slopes), np.float32)))
    kinds = _relative(channels.mean(encoded), known), _relative(edges.astype(np.float32), _inside(known, 5))
    return _Look(kinds, known, np.array([[across, 0, left], [0, down, top], [0, 0, 1]]))


def _relative(values: FloatImage, known: Mask) -> FloatImage:
    """Less the mean of its surroundings, over their contrast; 0 where nothing is known."""
    weight = known.astype(np.float32)
    total = np.maximum(_blurred(weight), np.float32(1e-3))
    off = np.asarray((values - _blurred(values * weight) / total) * weight, np.float32)
    contrast = _blurred(off * off) / total
    faint = FAINT * float(contrast[known].mean()) if known.any() else 0.0
    return np.asarray(off / np.sqrt(contrast + faint + 1e-8), np.float32)


def _blurred(values: FloatImage) -> FloatImage:
    return np.asarray(cv2.GaussianBlur(values, (0, 0), AROUND_PX), np.float32)


def _inside(known: Mask, window_px: int) -> Mask:
    return np.asarray(cv2.erode(known.astype(np.uint8), np.ones((window_px, window_px), np.uint8)) > 0)


def _features(look: _Look) -> _Features:
    # without it, all features lie a quarter of a pixel right and below of where they are
    sift = cv2.SIFT.create(nfeatures=FEATURES, contrastThreshold=0.02, enable_precise_upscale=True)
    found = []
    for kind in look.kinds:
        levels = np.clip(np.rint(128 + 45 * kind), 0, 255).astype(np.uint8)
        keys, described = sift.detectAndCompute(levels, _inside(look.known, 9).astype(np.uint8))
        at = np.array([key.pt for key in keys], np.float32).reshape(-1, 2)
        values = np.zeros((0, 128), np.float32) if described is None else np.asarray(described, np.float32)
        found.append((at, np.sqrt(values / np.maximum(values.sum(axis=1, keepdims=True), 1e-9))))
    return found


def _pairs(there: _Features, here: _Features, homography: Float64 | None = None, near_px: float = 0.0) -> FloatImage:
    """(n, 4) positions of features on the object, and of the nearest ones in the picture; with a ``homography`` of
    those that lie within ``near_px`` of where it puts them.
    """
    pairs = [np.zeros((0, 4), np.float32)]
    for (at, described), (wanted_at, wanted) in zip(there, here, strict=True):
        if len(at) < FEWEST_POINTS or len(wanted_at) < FEWEST_POINTS:
            continue
        alike = wanted @ described.T
        if homography is not None:
            expected = _moved_by(_inverse(homography), at).astype(np.float32)
            for row, position in zip(alike, wanted_at, strict=True):
                row[np.abs(expected - position).max(axis=1) > near_px] = -1
        rows = np.arange(len(alike))
        best = alike.argmax(axis=1)
        nearest = alike[rows, best].copy()
        alike[rows, best] = -1
        distance, next_one = (np.sqrt(np.maximum(2 - 2 * cosine, 0)) for cosine in (nearest, alike.max(axis=1)))
        good = (nearest > 0) & (distance < RATIO * next_one)
        pairs.append(np.hstack([wanted_at[good], at[best[good]]]))
    return np.concatenate(pairs)


def _agreed(pairs: FloatImage) -> tuple[Float64 | None, int]:
    """The homography (3, 3), object to picture, on which most pairs agree, and at how many places they do."""
    if len(pairs) < FEWEST_POINTS:
        return None, 0
    # in the object's pixels: those of the picture may be of any size
    found, agree = cv2.findHomography(
        pairs[:, 2:], pairs[:, :2], cv2.USAC_MAGSAC, NEAR_PX, confidence=0.9999, maxIters=20_000
    )
    if found is None:
        return None, 0
    homography, agreed = np.asarray(found, np.float64), pairs[np.asarray(agree)[:, 0] > 0]
    if not _upright(homography, agreed[:, 2:]):
        return None, 0
    return _inverse(homography), len(np.unique(np.round(agreed[:, :2] / SPOT_PX), axis=0))


def _upright(homography: Float64, at: FloatImage | Float64) -> bool:
    """Whether it neither mirrors nor folds what lies at ``at`` (n, 2)."""
    if not np.isfinite(homography).all() or np.linalg.cond(homography) > 1e12:
        return False
    depth = np.hstack([at, np.ones((len(at), 1))]) @ homography[2]
    return bool((np.linalg.det(homography) * depth**3 > 0).all())


def _by_features(scan: _Look, there: _Features, here: _Features) -> Float64:
    found, spots = _agreed(_pairs(there, here))
    if found is not None and spots >= FEWEST_SPOTS:
        return found
    mirrored = _Look((scan.kinds[0][:, ::-1].copy(), scan.kinds[1][:, ::-1].copy()), scan.known[:, ::-1], scan.to_whole)
    if _agreed(_pairs(_features(mirrored), here))[1] >= FEWEST_SPOTS:
        raise UsageError(
            "restoration-mirrored",
            what="The picture is the mirror image of the object.",
            remedy="Mirror it in an image editor, and save it again.",
        )
    raise _not_matched(f"The picture and the object have {spots} places in common, and {FEWEST_SPOTS} are needed")


def _not_matched(why: str) -> UsageError:
    return UsageError(
        "restoration-not-matched",
        what=f"The picture does not fit the object. {why}.",
        remedy="Give the picture of this object, or at least four points that picture and object have in common.",
    )


def _ends(points: Points) -> tuple[Float64, Float64]:
    """(n, 2) on the object, and in the picture."""
    given = np.asarray(points, np.float64).reshape(-1, 4)
    return given[:, 2:], given[:, :2]


def _by_points(points: Points, picture: tuple[int, ...], own: tuple[int, ...]) -> Float64:
    """(3, 3) camera to picture. Raises UsageError("restoration-points")."""
    here, there = _ends(points)
    if len(here) < FEWEST_POINTS:
        raise _wrong_points(f"{len(here)} points are given")
    for at, (rows, columns, *_), name in ((there, picture, "picture"), (here, own, "camera's picture")):
        outside = ((at < -0.5) | (at > (columns - 0.5, rows - 0.5)) | ~np.isfinite(at)).any(axis=1)
        if outside.any():
            x, y = at[outside][0]
            raise _wrong_points(f"The point {x:g}, {y:g} is outside the {name} of {columns} x {rows} pixels")
    if min(_spread(here), _spread(there)) < ON_A_LINE:
        raise _wrong_points("The points lie on a line")
    found, _ = cv2.findHomography(here, there)
    homography = np.zeros((3, 3)) if found is None else np.asarray(found, np.float64)
    if not _upright(homography, here):
        raise _wrong_points("The points lie in another order on the object than in the picture")
    return homography


def _spread(at: Float64) -> float:
    """How well points (n, 2) fix a homography: 0 where all, or all but one, lie on a line."""
    centred = at - at.mean(axis=0)
    x, y = (centred / max(float(np.abs(centred).max()), 1e-9)).T
    rows = np.stack([x, y, np.ones_like(x)], axis=1)
    # a homography of the points onto themselves: its equations have one solution alone
    equations = np.concatenate([
        np.hstack([rows, 0 * rows, -x[:, None] * rows]), np.hstack([0 * rows, rows, -y[:, None] * rows])
    ])  # fmt: skip
    return float(np.linalg.svd(equations, compute_uv=False)[7])


def _wrong_points(what: str) -> UsageError:
    return UsageError(
        "restoration-points",
        what=f"{what}.",
        remedy="Give at least four points, in the same order in both, far apart, and no three of four on a line.",
    )


def _inverse(homography: Float64) -> Float64:
    return np.asarray(np.linalg.inv(homography), np.float64)


def _moved_by(homography: Float64, at: FloatImage | Float64) -> Float64:
    """Positions (n, 2) moved by a homography (3, 3)."""
    if len(at) == 0:
        return np.zeros((0, 2))
    return np.asarray(cv2.perspectiveTransform(at.reshape(-1, 1, 2).astype(np.float64), homography)[:, 0], np.float64)


def _like_neighbours(at: Float64, off: Float64) -> Mask:
    """(n,): features at ``at`` that lie beside their place as most of the nearest ones do; ``off`` (n, 2)."""
    from scipy.spatial import KDTree

    nearest = np.asarray(KDTree(at).query(at, k=min(NEIGHBOURS + 1, len(at)))[1])[:, 1:]
    apart = np.hypot(*np.moveaxis(off[nearest] - off[:, None], 2, 0))
    return np.asarray((apart < 2 * NEAR_PX).mean(axis=1) > 0.5)


@dataclass(frozen=True, slots=True)
class _Fit:
    """A homography, object to picture, and by how much ``off`` (n, 2) pixels of the object the features at ``at``
    (n, 2) lie beside it.
    """

    homography: Float64
    at: Float64
    off: Float64
    by_points: bool

    def blocks(self, size_px: float) -> tuple[Float64, Float64]:
        """Medians of ``at`` and ``off`` by squares of the object, where enough features are; of points, each one."""
        if self.by_points:
            return self.at, self.off
        _, block, count = np.unique(self.at // (size_px / BLOCKS), axis=0, return_inverse=True, return_counts=True)
        parts = [block.ravel() == n for n in np.flatnonzero(count >= FEWEST_IN_BLOCK)]
        at, off = ([np.median(values[part], axis=0) for part in parts] for values in (self.at, self.off))
        return np.array(at).reshape(-1, 2), np.array(off).reshape(-1, 2)


def _laid(scan: _Look, body: _Look, shape: tuple[int, int], fit: _Fit) -> Registration:
    size_px = max(body.known.shape)
    bend = _bend(*fit.blocks(size_px), size_px)
    nodes = _nodes(fit, body.known.shape, bend)
    from_whole, to_picture = _inverse(body.to_whole), scan.to_whole @ fit.homography
    position, residual = np.empty((*shape, 2), np.float32), np.empty(shape, np.float32)
    near: Mask = np.ones(shape, np.bool_)
    for rows in strips(shape[0]):
        y, x = np.mgrid[rows, : shape[1]]
        at = _moved_by(from_whole, np.stack([x.ravel(), y.ravel()], axis=1))
        right, down, beside, distance = _sampled(nodes, at)
        position[rows] = _moved_by(to_picture, at + np.stack([right, down], axis=1)).reshape(*x.shape, 2)
        residual[rows] = (body.to_whole[0, 0] * beside).reshape(x.shape)
        if bend is not None:
            near[rows] = (distance <= REACH * size_px).reshape(x.shape)
    inside = _in_picture(position, scan)
    matched = near & inside
    if not matched.any():
        raise _not_matched("It lies beside the object")
    middle = _moved_by(_inverse(to_picture), np.median(position[matched], axis=0) + np.eye(2)[[0]] * [[0], [1]])
    right_px, down_px = middle[1] - middle[0]
    turned = float(np.degrees(np.arctan2(down_px, right_px)))
    return Registration(position, inside, matched, np.where(matched, residual, np.nan), turned, fit.by_points)


_Bend: TypeAlias = Callable[[Float64], Float64]
"""By how much (n, 2) the picture is bent at (n, 2), in pixels of the object."""


def _bend(at: Float64, off: Float64, size_px: float) -> _Bend | None:
    """Smooth through ``off`` (n, 2), by which the picture lies beside the object at ``at``; None for a flat object.

    What two halves of them say has to agree: noise is no bend.
    """
    from scipy.interpolate import RBFInterpolator

    def through(use: slice) -> _Bend:
        smooth = RBFInterpolator(at[use] / size_px, off[use], smoothing=SMOOTHING)
        return lambda where: np.asarray(smooth(where / size_px), np.float64)

    typical = float(np.median(np.hypot(*off.T))) if len(off) >= FEWEST_BENT else 0.0
    if typical < FLAT_PX:
        return None
    missed = through(np.s_[::2])(at[1::2]) - off[1::2]
    return through(np.s_[:]) if float(np.median(np.hypot(*missed.T))) < HALVES_AGREE * typical else None


def _nodes(fit: _Fit, shape: tuple[int, ...], bend: _Bend | None) -> FloatImage:
    """(4, rows, columns) at every so many pixels of the object: by how much the picture is bent there, right and down;
    how far features lie beside their place then, NaN without any near; and the distance to the nearest one.
    """
    from scipy.spatial import KDTree

    y, x = np.mgrid[0 : shape[0] + NODE_PX : NODE_PX, 0 : shape[1] + NODE_PX : NODE_PX]
    at_nodes = np.stack([x.ravel(), y.ravel()], axis=1).astype(np.float64)
    nodes = np.zeros((4, *x.shape), np.float32)
    nodes[2], nodes[3] = np.nan, np.inf
    if not len(fit.at):
        return nodes
    left, size_px = fit.off, max(shape)
    if bend is not None:
        nodes[:2] = bend(at_nodes).T.reshape(2, *x.shape)
        left = fit.off - bend(fit.at)
    found = KDTree(fit.at).query(at_nodes, k=range(1, min(NEIGHBOURS, len(fit.at)) + 1))
    distance, nearest = np.asarray(found[0]), np.asarray(found[1])
    nodes[3] = distance[:, 0].reshape(x.shape)
    beside = np.median(np.hypot(*left.T)[nearest], axis=1).reshape(x.shape)
    nodes[2] = np.where(nodes[3] <= MEASURED * size_px, beside, np.nan)
    return nodes


def _sampled(nodes: FloatImage, at: Float64) -> list[FloatImage]:
    from scipy.ndimage import map_coordinates

    where = at[:, ::-1].T / NODE_PX
    return [map_coordinates(plane, where, np.float32, order=1, mode="nearest") for plane in nodes]


def _in_picture(position: FloatImage, scan: _Look) -> Mask:
    """(rows, columns): inside the picture, where it is known."""
    at = _moved_by(_inverse(scan.to_whole), position.reshape(-1, 2)).reshape(position.shape).astype(np.float32)
    known = scan.known.astype(np.uint8)
    return np.asarray(cv2.remap(known, at[..., 0], at[..., 1], cv2.INTER_NEAREST) > 0)
