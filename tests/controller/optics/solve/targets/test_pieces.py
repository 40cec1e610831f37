"""Objects that stand apart in the image are distinguished, and slivers belong to one of them."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from controller.core.arrays import Mask
from controller.optics.solve.targets.values import Target, on_each, pieces


def two_discs() -> Mask:
    row, column = np.mgrid[0:60, 0:100]
    discs = [(row - 30) ** 2 + (column - middle) ** 2 < radius**2 for middle, radius in ((25, 20), (75, 15))]
    mask: Mask = discs[0] | discs[1]
    return mask


def test_two_objects_are_two_pieces_the_larger_first() -> None:
    left, right = pieces(two_discs())
    assert left[30, 25]
    assert right[30, 75]
    assert left.sum() > right.sum()


def test_a_sliver_belongs_to_the_nearest_object() -> None:
    mask = two_discs()
    mask[30, 95] = True
    _, right = pieces(mask)
    assert right[30, 95]


@given(arrays(np.bool_, (12, 15), elements=st.booleans()))
def test_pieces_cover_the_mask_and_do_not_overlap(mask: Mask) -> None:
    parts = pieces(mask)
    assert np.array_equal(sum((part.astype(int) for part in parts), start=np.zeros(mask.shape, int)), mask.astype(int))


def test_each_object_gets_its_own_target() -> None:
    mask = two_discs()

    def make(piece: Mask) -> Target:
        image = np.zeros((*piece.shape, 3), np.float32)
        image[piece] = piece.sum() / mask.sum()
        return Target(image, piece)

    made = on_each(mask, make)
    assert made.image[30, 25, 0] > made.image[30, 75, 0] > 0
    assert np.array_equal(made.mask, mask)
