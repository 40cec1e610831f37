"""Only tiles that change are copied, mixed and uploaded: what comes out is as if all were."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from controller.play.display.outputs import MemoryOutput, mix_sets, mixture_of
from controller.play.frames import FrameSet, OutputSize, Tiles, differing
from plugins.emulated.optics.outputs import FrameReader

SIZES = (OutputSize("P1", 23, 17), OutputSize("P2", 9, 30))
GRIDS = ((5, 4), (9, 7))
Kinds = list[int]


def made(kinds: Kinds) -> FrameSet:
    """A set whose tiles are of these kinds, in turn; 0: of unknown content, another one each time."""
    pixels, tiles, at = [], [], 0
    for size, (width, height) in zip(SIZES, GRIDS, strict=True):
        grid = -(-size.height_px // height), -(-size.width_px // width)
        content = np.array([kinds[(at + n) % len(kinds)] for n in range(grid[0] * grid[1])], np.uint64).reshape(grid)
        at += content.size
        image = np.zeros(size.shape, np.uint8)
        for row, column in np.ndindex(*grid):
            kind = int(content[row, column])
            seed = [kind, row, column] if kind else [at, *kinds, row, column]
            place = np.s_[row * height : (row + 1) * height, column * width : (column + 1) * width]
            image[place] = np.random.default_rng(seed).integers(0, 256, image[place].shape)
        pixels.append(image)
        tiles.append(Tiles(width, height, content))
    return FrameSet(tuple(pixels), tuple(tiles))


KINDS = st.lists(st.integers(0, 3), min_size=1, max_size=9)


@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(KINDS, st.booleans()), min_size=1, max_size=6))
def test_a_memory_output_shows_each_set_whole_however_little_is_copied(shown: list[tuple[Kinds, bool]]) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "out.frame"
        output, before = MemoryOutput(path, SIZES), FrameSet.black(SIZES)
        reader = FrameReader(path)
        for kinds, fades in shown:
            frames = made(kinds)
            if fades:
                output.load_fade(before, frames)
                for share in (0.3, 0.8):
                    expected = FrameSet.black(SIZES)
                    mix_sets(FrameSet(before.pixels), FrameSet(frames.pixels), share, expected)
                    output.mix(share)
                    output.flip()
                    found = reader.latest()
                    assert found is not None
                    for image, size in zip(expected.pixels, SIZES, strict=True):
                        np.testing.assert_array_equal(found.frames[size.name], image)
                output.mix(1.0)
            else:
                output.prepare(frames)
            output.flip()
            found = reader.latest()
            assert found is not None
            for image, size in zip(frames.pixels, SIZES, strict=True):
                np.testing.assert_array_equal(found.frames[size.name], image)
            before = frames
        output.close()


@settings(max_examples=60, deadline=None)
@given(KINDS, KINDS)
def test_parts_that_may_differ_hold_all_that_does_and_do_not_overlap(one: Kinds, other: Kinds) -> None:
    first, second = made(one), made(other)
    assert first.tiles is not None
    assert second.tiles is not None
    for number, size in enumerate(SIZES):
        counted = np.zeros(size.shape[:2], int)
        for part in differing(size.shape, first.tiles[number], second.tiles[number]):
            counted[part] += 1
        assert counted.max(initial=0) <= 1
        differs = (first.pixels[number] != second.pixels[number]).any(axis=-1)
        assert counted[differs].all()
    assert not any(
        differing(size.shape, tiles, tiles) for size, tiles in zip(SIZES, made([2, 1]).tiles or (), strict=True)
    )
    assert differing((600, 9, 3), None, None) == [np.s_[0:256, 0:9], np.s_[256:512, 0:9], np.s_[512:600, 0:9]]


def test_what_two_sets_share_is_not_mixed_again() -> None:
    before, after = made([1, 2]), made([1, 3])
    mixture = mixture_of(before, after, SIZES)
    shared = mixture.pixels[0].copy()
    mix_sets(before, after, 0.5, mixture)
    assert (mixture.pixels[0][:4, :5] == shared[:4, :5]).all()
    assert (mixture.pixels[0][:4, :5] == before.pixels[0][:4, :5]).all()
    assert (mixture.pixels[0][:4, 5:10] != shared[:4, 5:10]).any()
