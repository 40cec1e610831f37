"""A codec that is compared must give back what it was given."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lab.timings.playing.bundle import Codec, _codecs


@pytest.mark.parametrize("codec", _codecs(), ids=lambda codec: codec.name)
@settings(max_examples=15, deadline=None)
@given(rows=st.integers(1, 40), columns=st.integers(1, 40), seed=st.integers(0, 99))
def test_images_come_back_unchanged(codec: Codec, rows: int, columns: int, seed: int) -> None:
    image = np.random.default_rng(seed).integers(0, 256, (rows, columns, 3), dtype=np.uint8)
    np.testing.assert_array_equal(codec.unpack(codec.pack(image), image.shape), image)
