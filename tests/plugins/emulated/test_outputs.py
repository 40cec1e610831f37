"""The memory output as another process leaves it: whole, half-written, replaced, or nonsense."""

from __future__ import annotations

import dataclasses
import struct
import threading
import time
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from lab.emulated.outputs import SeparateOutputs
from plugins.emulated.core.truth import BenchTruth
from plugins.emulated.optics.outputs import FrameReader, VisibleFrames

WIDTH, HEIGHT = 40, 30


def memory_output(frames: dict[str, npt.NDArray[np.uint8]], sequence: int, presented_at_s: float) -> bytearray:
    """The file as its description says, byte by byte."""
    offsets, end = [], 4096
    for frame in frames.values():
        offsets.append(end)
        end += -(-frame.size // 4096) * 4096
    data = bytearray(end)
    data[0:40] = struct.pack("<8sIIQdQ", b"VELFRAME", 1, len(frames), sequence, presented_at_s, end)
    for index, ((name, frame), offset) in enumerate(zip(frames.items(), offsets, strict=True)):
        rows, columns, _ = frame.shape
        entry = struct.pack("<40sIIQQ", name.encode(), columns, rows, offset, 0)
        data[64 + 64 * index : 128 + 64 * index] = entry
        data[offset : offset + frame.size] = frame.tobytes()
    return data


def grey(value: int) -> npt.NDArray[np.uint8]:
    return np.full((HEIGHT, WIDTH, 3), value, np.uint8)


def test_frames_are_read_as_they_were_written(tmp_path: Path) -> None:
    frames = {
        "P1": np.random.default_rng(0).integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8),
        "Höhe": np.random.default_rng(1).integers(0, 256, (7, 9, 3), dtype=np.uint8),
    }
    (tmp_path / "frame").write_bytes(memory_output(frames, 6, 12.5))
    found = FrameReader(tmp_path / "frame").latest()
    assert found is not None
    assert (found.sequence, found.presented_at_s) == (6, 12.5)
    assert set(found.frames) == set(frames)
    for name, frame in frames.items():
        np.testing.assert_array_equal(found.frames[name], frame)


def test_without_a_player_there_is_no_picture(tmp_path: Path) -> None:
    assert FrameReader(tmp_path / "frame").latest() is None


def test_a_set_that_is_being_written_is_not_shown(tmp_path: Path) -> None:
    path = tmp_path / "frame"
    path.write_bytes(memory_output({"P1": grey(10)}, 2, 1.0))
    reader = FrameReader(path)
    first = reader.latest()
    path.write_bytes(memory_output({"P1": grey(20)}, 3, 2.0))
    assert reader.latest() in (first, None)
    with path.open("r+b") as file:
        file.seek(16)
        file.write(struct.pack("<Q", 4))
    found = reader.latest()
    assert found is not None
    assert found.frames["P1"].max() == 20


def test_a_writer_that_never_pauses_never_gives_a_torn_frame(tmp_path: Path) -> None:
    path = tmp_path / "frame"
    path.write_bytes(memory_output({"P1": grey(0)}, 0, 0.0))
    stopped = threading.Event()

    def write() -> None:
        with path.open("r+b", buffering=0) as file:
            for sequence in range(0, 1 << 30, 2):
                if stopped.is_set():
                    return
                file.seek(16)
                file.write(struct.pack("<Q", sequence + 1))
                file.seek(4096)
                file.write(bytes([sequence // 2 % 256]) * (WIDTH * HEIGHT * 3))
                file.seek(16)
                file.write(struct.pack("<Qd", sequence + 2, float(sequence + 2)))
                time.sleep(0.0002)

    writer = threading.Thread(target=write)
    writer.start()
    try:
        reader, seen = FrameReader(path), set[int]()
        begun_s = time.monotonic()
        while (passed_s := time.monotonic() - begun_s) < 0.5 or (len(seen) <= 5 and passed_s < 30):
            found = reader.latest()
            assert found is not None
            assert np.ptp(found.frames["P1"]) == 0
            seen.add(found.sequence)
    finally:
        stopped.set()
        writer.join()
    assert len(seen) > 5


def test_a_restarted_player_is_noticed_even_with_the_same_sequence(tmp_path: Path) -> None:
    path = tmp_path / "frame"
    path.write_bytes(memory_output({"P1": grey(10)}, 2, 1.0))
    reader = FrameReader(path)
    reader.latest()
    (tmp_path / "new").write_bytes(memory_output({"P1": grey(99)}, 2, 2.0))
    (tmp_path / "new").replace(path)
    found = reader.latest()
    assert found is not None
    assert found.frames["P1"].max() == 99


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(where=st.integers(0, 191), garbage=st.binary(min_size=1, max_size=24), cut=st.integers(0, 9000))
def test_a_damaged_file_never_gives_a_picture_of_another_size(
    tmp_path: Path, where: int, garbage: bytes, cut: int
) -> None:
    data = memory_output({"P1": grey(10), "P2": grey(20)}, 2, 1.0)
    data[where : where + len(garbage)] = garbage
    (tmp_path / "frame").write_bytes(data[: len(data) - cut])
    found = FrameReader(tmp_path / "frame").latest()
    assert found is None or all(frame.ndim == 3 and frame.shape[2] == 3 for frame in found.frames.values())


def test_a_frame_is_visible_only_after_the_displays_latency(tmp_path: Path) -> None:
    path = tmp_path / "frame"
    now = time.monotonic()
    path.write_bytes(memory_output({"P1": grey(10)}, 2, now - 1.0))
    visible = VisibleFrames(path, latency_s=0.05)
    visible.update()
    path.write_bytes(memory_output({"P1": grey(20)}, 4, now))
    assert [(share, levels(found)) for share, found in visible.during(now, now + 0.04)] == [(1.0, 10)]
    assert [levels(found) for _, found in visible.during(now + 0.06, now + 0.10)] == [20]


def test_frames_that_change_during_an_exposure_share_its_time(tmp_path: Path) -> None:
    path = tmp_path / "frame"
    path.write_bytes(memory_output({"P1": grey(10)}, 2, 100.0))
    visible = VisibleFrames(path, latency_s=0.0)
    visible.update()
    path.write_bytes(memory_output({"P1": grey(20)}, 4, 101.0))
    parts = visible.during(100.75, 101.75)
    assert [levels(found) for _, found in parts] == [10, 20]
    assert [share for share, _ in parts] == pytest.approx([0.25, 0.75])


def test_each_projector_shows_what_its_own_player_showed_so_much_earlier(
    tmp_path: Path, tiny_truth: BenchTruth
) -> None:
    own = zip(("P1", "P2", "P3"), ("", "", "own.frame"), (0.0, 0.25, 0.0), strict=True)
    projectors = tuple(
        dataclasses.replace(projector, output=output, frames=frames, late_s=late_s)
        for projector, (output, frames, late_s) in zip(tiny_truth.projectors, own, strict=True)
    )
    truth = dataclasses.replace(tiny_truth, projectors=projectors, frames="frame", latency_s=0.05)
    visible = SeparateOutputs(tmp_path, truth)
    for level, at_s in ((10, 100.0), (20, 102.0)):
        both = {"P1": grey(level), "P2": grey(level)}
        (tmp_path / "frame").write_bytes(memory_output(both, level, at_s))
        (tmp_path / "own.frame").write_bytes(memory_output({"P3": grey(level + 5)}, level, at_s + 0.5))
        found = visible.during(101.8, 102.8)
    assert [share for share, _ in found] == pytest.approx([0.25, 0.25, 0.25, 0.25])
    shown = [tuple(int(frame.max()) for frame in at.frames.values()) for _, at in found if at is not None]
    assert shown == [(10, 10, 15), (20, 10, 15), (20, 20, 15), (20, 20, 25)]


def levels(found: object) -> int:
    frames = getattr(found, "frames", {})
    return int(frames["P1"].max()) if frames else -1
