"""Size and decoding of the demo's kind of frames: the bundle's codec beside others that are installed."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import zstandard

from controller.bundle import format as fmt
from controller.bundle.reader import Bundle
from controller.bundle.writer import NewAppearance, NewBundle, Packing, write_bundle
from controller.core.arrays import ByteImage
from lab.timings import SIZES as BASE_SIZES
from lab.timings import Row, Timing, at_least, at_most, peak_bytes, timed
from lab.timings.tools.frames import UHD, compensation_frames

SIZES = (*BASE_SIZES, UHD)
APPEARANCES = 2
GOAL_MS = {1: 14.0, 2: 7.0}
GOAL_RATIO = 4.0


@dataclass(frozen=True, slots=True)
class Codec:
    """Another way to keep one image. ``pack`` gives bytes, ``unpack`` makes the same image of them."""

    name: str
    pack: Callable[[ByteImage], bytes]
    unpack: Callable[[bytes, tuple[int, ...]], ByteImage]


def measure(size: str) -> list[Row]:
    """Ratio and time of one swap (all outputs) from a mapped bundle on one and two threads, then of other codecs."""
    swaps = compensation_frames(size, APPEARANCES)
    solved_bytes = peak_bytes()
    paper = size == "paper"
    rows = [*_bundle(swaps, paper=paper), *_ways(swaps)]
    if size == UHD:
        return rows
    ours_ms = rows[1].value
    for codec in _codecs():
        rows += _other(codec, swaps[0], ours_ms)
    return [*rows, at_most("peak memory of the process", peak_bytes() / 1e9, None, unit="GB",
                           how=f"{solved_bytes / 1e9:.2f} GB of it before: the frames were solved here")]  # fmt: skip


def _bundle(swaps: Sequence[dict[str, ByteImage]], *, paper: bool) -> list[Row]:
    first = swaps[0]
    raw = sum(frame.nbytes for frame in first.values()) * len(swaps)
    outputs = [(name, first[name].shape[1], first[name].shape[0]) for name in first]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "bundle.vel"
        made = [NewAppearance(f"appearance-{number}", frames) for number, frames in enumerate(swaps)]

        def write() -> None:
            write_bundle(
                path,
                NewBundle(stage="timing", calibration="timing", created_unix_s=0, outputs=outputs),
                appearances=made,
            )

        writing = timed(write, repeats=3)
        ratio = raw / path.stat().st_size
        with Bundle.open(path, allow_unsigned=True) as bundle:
            times = {threads: _decoding(bundle, swaps, threads) for threads in GOAL_MS}
            chosen = f"{bundle.index.codec}, tiles {bundle.index.outputs[0].tile_width_px} pixels wide"
            opening = timed(lambda: Bundle.open(path, allow_unsigned=True).close())
    return [
        at_least(
            "smaller than raw",
            ratio,
            GOAL_RATIO,
            unit="x",
            how=f"{len(swaps)} appearances of dithered frames; {chosen}",
        ),
        *(_row(threads, time, goal=GOAL_MS[threads] if paper else None) for threads, time in times.items()),
        at_least(
            "two threads decode faster than one",
            times[1].minimum / times[2].minimum,
            None,
            unit="x",
            how="of the minima, which other work on the machine disturbs least",
        ),
        at_most("opening", 1000 * opening.median, None, unit="ms", how=f"index and checks; {opening}"),
        at_most("writing", writing.median / len(swaps), None, unit="s an appearance", how=str(writing)),
    ]


def _ways(swaps: Sequence[dict[str, ByteImage]]) -> list[Row]:
    """Processor time of a swap in each way that the format has, in one run; the first is that of version 2."""
    sizes = [(name, frame.shape[1], frame.shape[0]) for name, frame in swaps[0].items()]
    rows, first_ms = [], 0.0
    for codec in fmt.CODECS:
        for narrow in (False, True):
            layouts = tuple(fmt.tiled(*size, narrow=narrow) for size in sizes)
            ratio, spent_ms = _one_way(swaps, sizes, Packing(layouts, codec))
            first_ms = first_ms or spent_ms
            how = f"{ratio:.2f} times smaller than raw; {spent_ms / first_ms:.2f} times the first"
            tiles = "narrow" if narrow else "full width"
            rows.append(at_most(f"{codec}, {tiles}: a swap that decodes what changes", spent_ms, None,
                                unit="ms of processor time", how=how))  # fmt: skip
    return rows


def _one_way(
    swaps: Sequence[dict[str, ByteImage]], outputs: Sequence[tuple[str, int, int]], packing: Packing
) -> tuple[float, float]:
    """Raw by packed size, and the least processor time in ms of going from one appearance to the other."""
    with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor(2) as pool:
        path = Path(folder) / "bundle.vel"
        made = [NewAppearance(str(number), frames) for number, frames in enumerate(swaps)]
        write_bundle(
            path,
            NewBundle(stage="timing", calibration="timing", created_unix_s=0, outputs=outputs),
            appearances=made,
            packing=packing,
        )
        raw = sum(frame.nbytes for frames in swaps for frame in frames.values())
        buffers = {name: np.empty_like(frame) for name, frame in swaps[0].items()}
        spent = []
        with Bundle.open(path, allow_unsigned=True) as bundle:
            known = bundle.decode_into("0", buffers, pool)
            for number in range(24):
                began = time.process_time()
                known = bundle.decode_into(str((number + 1) % 2), buffers, pool, known)
                spent.append(1000 * (time.process_time() - began))
        return raw / path.stat().st_size, min(spent)


def _decoding(bundle: Bundle, swaps: Sequence[dict[str, ByteImage]], threads: int) -> Timing:
    buffers = {name: np.empty_like(frame) for name, frame in swaps[0].items()}
    with ThreadPoolExecutor(threads) as pool:
        time = timed(lambda: bundle.decode_into("appearance-0", buffers, pool if threads > 1 else None), repeats=25)
    if not all(np.array_equal(buffers[name], swaps[0][name]) for name in buffers):
        raise AssertionError("the bundle did not give back its frames")
    return time


def _row(threads: int, time: Timing, *, goal: float | None) -> Row:
    return at_most(f"decoding one swap, {threads} threads" if threads > 1 else "decoding one swap, 1 thread",
                   1000 * time.median, goal, unit="ms", how=str(time))  # fmt: skip


def _other(codec: Codec, frames: dict[str, ByteImage], ours_ms: float) -> list[Row]:
    packed = {name: codec.pack(frame) for name, frame in frames.items()}
    raw = sum(frame.nbytes for frame in frames.values())
    for name, frame in frames.items():
        if not np.array_equal(codec.unpack(packed[name], frame.shape), frame):
            raise AssertionError(f"{codec.name} did not give back its frame")
    time = timed(lambda: [codec.unpack(packed[name], frame.shape) for name, frame in frames.items()])
    ratio = raw / sum(map(len, packed.values()))
    how = f"1 thread, {1000 * time.median:.1f} ms a swap: {1000 * time.median / ours_ms:.2f} times ours; {time}"
    return [at_least(f"{codec.name}, smaller than raw", ratio, None, unit="x", how=how)]


def _codecs() -> list[Codec]:
    found = [Codec(f"zstd {level}, no differences", _zstd(level), _unzstd) for level in (1,)] + [
        Codec(f"zstd {level} on row differences, one block", _zstd_rows(level), _unzstd_rows) for level in (1, 3, 9)
    ]
    found.append(Codec("PNG (OpenCV)", _image(".png"), _unimage))
    found.append(Codec("WebP lossless (OpenCV)", _image(".webp", cv2.IMWRITE_WEBP_QUALITY, 101), _unimage))
    try:
        import lz4.frame as lz4  # type: ignore[import-not-found, unused-ignore]
    except ImportError:
        return found
    found.append(Codec("lz4", lambda image: bytes(lz4.compress(image.tobytes())), lambda data, shape: np.frombuffer(
        lz4.decompress(data), np.uint8).reshape(shape)))  # fmt: skip
    return found


def _zstd(level: int) -> Callable[[ByteImage], bytes]:
    return lambda image: zstandard.ZstdCompressor(level).compress(np.ascontiguousarray(image).tobytes())


def _unzstd(data: bytes, shape: tuple[int, ...]) -> ByteImage:
    return np.frombuffer(zstandard.ZstdDecompressor().decompress(data), np.uint8).reshape(shape)


def _zstd_rows(level: int) -> Callable[[ByteImage], bytes]:
    def pack(image: ByteImage) -> bytes:
        delta = image.copy()
        delta[1:] -= image[:-1]
        return zstandard.ZstdCompressor(level).compress(delta.tobytes())

    return pack


def _unzstd_rows(data: bytes, shape: tuple[int, ...]) -> ByteImage:
    image = np.frombuffer(bytearray(zstandard.ZstdDecompressor().decompress(data)), np.uint8).reshape(shape)
    for row in range(1, shape[0]):
        np.add(image[row], image[row - 1], out=image[row])
    return image


def _image(suffix: str, *options: int) -> Callable[[ByteImage], bytes]:
    return lambda image: cv2.imencode(suffix, image, options)[1].tobytes()


def _unimage(data: bytes, shape: tuple[int, ...]) -> ByteImage:
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    assert image is not None
    return np.asarray(image, np.uint8).reshape(shape)
