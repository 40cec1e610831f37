"""Which camera pixels see the room instead of the object: table and walls are flat, and have everything before them."""

from __future__ import annotations

from typing import Final, TypeAlias

import cv2
import numpy as np
import numpy.typing as npt

from controller.core import channels
from controller.core.arrays import FloatImage, Mask, strips
from controller.core.blur import nearest_known

Floats: TypeAlias = npt.NDArray[np.float64]

MOST_PLANES: Final = 6
TRIALS: Final = 300
APART: Final = 0.12
"""A plane is begun from three pixels this near to each other, in picture heights, then fitted to all that it holds."""
REFITS: Final = 2
POINTS: Final = 2000
"""So many points stand for all when planes are looked for."""
THICK: Final = 0.003
"""Farthest that a plane's points lie from it, in distances from the camera to the middle of what it sees."""
BEHIND: Final = 0.01
"""Share of the points that may lie behind a plane, as points that are wrong do."""
LEAST: Final = 0.03
"""Share of the points that a plane holds."""
LEAST_OBJECT: Final = 0.1
"""Share of the points that are not the room's; with fewer, the flat surfaces are themselves the object."""
PICTURE: Final = 0.5
"""Least size of a picture, in sizes of its frame; a wall that is seen between an arm and a body is smaller."""
BORDER: Final = 0.02
"""Width of the picture's border, as a share of its height."""
AT_BORDER: Final = 0.03
"""Share of the picture's border that a plane of the room takes: an object stands inside the picture."""
LOOSE: Final = 4.0
"""So many times as far from a plane of the room, a floor whose points lie in waves is found in stripes."""
FOOT: Final = 0.05
"""Of the picture's height: so far from the object's middle parts, what is near a plane is its foot."""
PART: Final = 0.02
"""A part of the object is at least this large, relative to its largest."""
SCRAP: Final = 0.005
"""Of the pixels on planes: what is smaller, beside them, is a fault of the measurement."""
GAP: Final = 0.02
"""Of the picture's height: parts so near to each other are one; contours, where points are unknown, part them."""


def room_beside_planes(points_m: FloatImage, lit: Mask) -> Mask:
    """Pixels (rows, columns) that see the room around a flat object; ``points_m``: those of its planes.

    Room is what projectors light (``lit``), lies on none of the planes, and reaches the picture's border; with it a
    strip where a plane meets a floor; and what is ``room_pixels`` of the rest.
    """
    known = channels.finite(points_m)
    disc = _disc(FOOT / 2, known.shape)
    broad = cv2.morphologyEx(known.astype(np.uint8), cv2.MORPH_OPEN, disc)
    # with the corners that a disc takes off
    flat = known & (cv2.dilate(broad, _disc(GAP / 2, known.shape)) > 0)
    beside = lit & ~flat
    _, labels, stats, _ = cv2.connectedComponentsWithStats(beside.astype(np.uint8), connectivity=4)
    large = stats[:, cv2.CC_STAT_AREA] >= SCRAP * np.count_nonzero(known)
    large[0] = False
    reaching = np.isin(labels, np.unique(labels[_border(known.shape)])) & large[labels]
    return np.asarray(reaching | room_pixels(np.where(reaching[..., None], np.float32(np.nan), points_m)))


def room_pixels(points_m: FloatImage) -> Mask:
    """Pixels (rows, columns) that see flat surfaces of the room; ``points_m``: as ``Geometry``, NaN where unknown.

    Room is also what is nearly on such a surface, as far as it reaches the border, and what is small or reaches the
    border without being the largest thing. A pixel without a point counts as its nearest neighbour with one. None is
    the room's where no plane reaches the picture's border, or where hardly anything else is seen. A picture in its
    frame is no part of the wall behind it.
    """
    known = channels.finite(points_m)
    room, loose = np.zeros_like(known), np.zeros_like(known)
    border, rng = _border(known.shape), np.random.default_rng(0)
    if np.mean(known[border]) < AT_BORDER:
        return room
    at = np.flatnonzero(known)
    everything = points_m.reshape(-1, 3)[at[rng.integers(0, at.size, POINTS)]].astype(np.float64)
    thick = THICK * float(np.median(np.linalg.norm(everything, axis=1)))
    looked_at = np.zeros_like(room)
    for _ in range(MOST_PLANES):
        left = known & ~looked_at
        plane = _plane(points_m, left, everything, thick, rng)
        if plane is None:
            break
        near = left & _near(points_m, plane, thick)
        looked_at |= near
        if np.mean(near[border]) >= AT_BORDER:
            room |= near
            loose |= _near(points_m, plane, LOOSE * thick)
    if room.any():
        room |= known & ~_things(known & ~room, loose, border)
    if not room.any() or np.count_nonzero(known & ~room) < LEAST_OBJECT * np.count_nonzero(known):
        return np.zeros_like(room)
    filled = room[nearest_known(known)[1]].astype(np.uint8)
    # the median of 25
    room = np.asarray(cv2.boxFilter(filled, -1, (5, 5), normalize=False, borderType=cv2.BORDER_REFLECT) > 12)
    return room & ~_pictures(room)


def _pictures(room: Mask) -> Mask:
    """Parts of ``room`` that are pictures in their frames: large beside these, and with no way to the border."""
    found = np.zeros_like(room)
    count, parts, stats, _ = cv2.connectedComponentsWithStats(room.astype(np.uint8), connectivity=4)
    _, around, sizes, _ = cv2.connectedComponentsWithStats((~room).astype(np.uint8), connectivity=8)
    beside = np.concatenate([parts[0], parts[-1], parts[:, 0], parts[:, -1]])
    for part in sorted(set(range(1, count)) - set(beside.tolist())):
        here = parts == part
        frame = np.unique(around[cv2.dilate(here.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0])
        if stats[part, cv2.CC_STAT_AREA] > PICTURE * sizes[frame[frame > 0], cv2.CC_STAT_AREA].sum():
            found |= here
    return found


def _things(left: Mask, loose: Mask, border: Mask) -> Mask:
    """Of the pixels ``left``, the largest joined part and others like it, with their feet.

    ``loose``: nearly on a plane of the room; there a part that reaches the ``border`` is floor or wall.
    """

    def wider(mask: Mask, share: float) -> npt.NDArray[np.uint8]:
        return np.asarray(cv2.dilate(mask.astype(np.uint8), _disc(share, mask.shape)), np.uint8)

    def joined(mask: Mask) -> npt.NDArray[np.int32]:
        return np.asarray(cv2.connectedComponents(wider(mask, GAP / 2), connectivity=8)[1] * mask, np.int32)

    near = joined(left & loose)
    floor = (near > 0) & np.isin(near, near[border])
    labels = joined(left & ~floor)
    areas = np.bincount(labels.ravel())
    areas[0] = 0
    kept = areas >= max(PART * areas.max(), 1)
    kept[labels[border]] = False
    kept[areas.argmax()] = areas.max() > 0
    things = kept[labels]
    around = wider(things, FOOT) > 0
    return np.asarray(things | (floor & around))


def _plane(
    points_m: FloatImage, left: Mask, everything: Floats, thick: float, rng: np.random.Generator
) -> Floats | None:
    """The plane (normal towards the camera, offset) that holds most pixels ``left``, with nothing behind it."""
    at = np.flatnonzero(left)
    if not at.size:
        return None
    some = points_m.reshape(-1, 3)[at[rng.integers(0, at.size, POINTS)]].astype(np.float64)
    best, most = None, LEAST * float(np.count_nonzero(np.isfinite(points_m[..., 0]))) / at.size * POINTS
    apart = round(APART * left.shape[0])
    for start in at[rng.integers(0, at.size, TRIALS)]:
        row, column = divmod(int(start), left.shape[1])
        beside = rng.integers(-apart, apart + 1, (2, 3))
        rows, columns = row + beside[0], column + beside[1]
        if rows.min() < 0 or columns.min() < 0 or rows.max() >= left.shape[0] or columns.max() >= left.shape[1]:
            continue
        three = points_m[rows, columns].astype(np.float64)
        if not left[rows, columns].all():
            continue
        plane = _through(three)
        for _ in range(REFITS):
            inliers = some[np.abs(some @ plane[:3] + plane[3]) < thick]
            if len(inliers) < 0.5 * most:
                break
            plane = _through(inliers)
        count = float(np.count_nonzero(np.abs(some @ plane[:3] + plane[3]) < thick))
        if count > most and np.mean(everything @ plane[:3] + plane[3] < -thick) < BEHIND:
            best, most = plane, count
    return best


def _near(points_m: FloatImage, plane: Floats, thick: float) -> Mask:
    """Pixels whose points lie no farther than ``thick`` from a plane."""
    near = np.empty(points_m.shape[:2], np.bool_)
    for rows in strips(len(near)):
        near[rows] = np.abs(points_m[rows] @ plane[:3] + plane[3]) < thick
    return near


def _through(points: Floats) -> Floats:
    """The plane nearest to points; the camera, at the origin, is before it."""
    middle = points.mean(axis=0)
    normal = np.linalg.eigh((points - middle).T @ (points - middle))[1][:, 0]
    normal *= -np.sign(normal @ middle) or 1.0
    return np.append(normal, -normal @ middle)


def _disc(share: float, shape: tuple[int, ...]) -> npt.NDArray[np.uint8]:
    """``share``: its radius, of the picture's height."""
    side = 2 * round(share * shape[0]) + 1
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side)), np.uint8)


def _border(shape: tuple[int, ...]) -> Mask:
    wide = max(1, round(BORDER * shape[0]))
    border = np.ones(shape, dtype=np.bool_)
    border[wide:-wide, wide:-wide] = False
    return border
