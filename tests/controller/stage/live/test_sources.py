"""Streams of pictures: what is due, what is too late, what is not yet whole."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import cv2
import numpy as np
import pytest

from controller.core.arrays import ByteImage
from controller.core.errors import UsageError
from controller.stage.live import FolderSource, VideoSource, open_source


def grey(value: int) -> ByteImage:
    return np.full((48, 64, 3), value, np.uint8)


def video(path: Path, values: list[int], rate: float = 10.0) -> Path:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), rate, (64, 48))
    for value in values:
        writer.write(grey(value))
    writer.release()
    return path


def write(folder: Path, name: str, value: int) -> None:
    assert cv2.imwrite(str(folder / name), grey(value))


def test_a_video_gives_the_frame_that_is_due_and_counts_those_it_passed_over(tmp_path: Path) -> None:
    source = VideoSource(video(tmp_path / "v.avi", [10, 60, 110, 160, 210]), loop=False)
    first = source.next(0.05)
    assert first is not None
    assert (first.number, first.skipped) == (0, 0)
    assert abs(int(first.pixels.mean()) - 10) < 4
    assert source.next(0.06) is None
    later = source.next(0.35)
    assert later is not None
    assert (later.number, later.skipped) == (3, 2)
    assert abs(int(later.pixels.mean()) - 160) < 4
    last = source.next(0.9)
    assert last is not None, "the last one is shown, however late"
    assert (last.number, last.skipped) == (4, 0)
    assert not source.ended
    assert source.next(0.95) is None
    assert source.ended
    source.close()


def seconds_of(path: Path, parts: list[tuple[int, int]], *options: str) -> Path:
    """A video of one second for each of ``parts``: a grey value, and how many frames that second has."""
    inputs = [
        part for value, rate in parts
        for part in ("-f", "lavfi", "-t", "1", "-i", f"color=c=0x{value:02x}{value:02x}{value:02x}:s=64x48:r={rate}")
    ]  # fmt: skip
    joined = "".join(f"[{n}:v]settb=1/1000[p{n}];" for n in range(len(parts)))
    joined += "".join(f"[p{n}]" for n in range(len(parts))) + f"concat=n={len(parts)}:v=1"
    subprocess.run(
        [
            "ffmpeg",
            "-nostdin",
            "-loglevel",
            "error",
            *inputs,
            "-filter_complex",
            joined,
            "-fps_mode",
            "vfr",
            *options,
            path,
        ],
        check=True,
    )
    return path


@pytest.mark.skipif(shutil.which("ffmpeg") is None, reason="needs ffmpeg (a package of the test set-up)")
@pytest.mark.parametrize("name", ["v.mp4", "v.mkv"])
@pytest.mark.parametrize("rates", [(2, 30, 2, 30), (30, 2, 10, 5)])
def test_a_video_of_changing_rate_shows_each_second_in_its_second(
    tmp_path: Path, name: str, rates: tuple[int, ...]
) -> None:
    values = (40, 90, 140, 190)
    path = seconds_of(tmp_path / name, list(zip(values, rates, strict=True)), "-c:v", "libx264", "-bf", "2")
    for loop in (False, True):
        source = VideoSource(path, loop=loop)
        shown: list[tuple[float, int]] = []
        value, number = 0, -1
        for at_s in np.arange(0.0, 8.0 if loop else 4.0, 0.05):
            picture = source.next(float(at_s))
            if picture is not None:
                value = int(picture.pixels.mean())
                assert picture.number - picture.skipped == number + 1
                number = picture.number
            shown.append((float(at_s), value))
        wrong = [at_s for at_s, value in shown if abs(value - values[int(at_s % 4)]) > 6 and 0.06 < at_s % 1 < 0.94]
        assert not wrong
        assert number >= (2 if loop else 1) * sum(rates) - 3
        source.close()


@pytest.mark.skipif(shutil.which("ffmpeg") is None, reason="needs ffmpeg (a package of the test set-up)")
@pytest.mark.parametrize(
    ("name", "primaries", "curve", "matrix", "refused"),
    [
        ("v.mp4", 9, 14, 9, "BT.2020, BT.2020"),
        ("v.mkv", 9, 16, 9, "PQ"),
        ("v.mp4", 9, 18, 9, "HLG"),
        ("v.mp4", 2, 2, 9, "BT.2020 non-constant"),
        ("v.mov", 12, 13, 1, "P3"),
        ("v.mp4", 1, 1, 1, ""),
        ("v.mkv", 6, 6, 6, ""),
        ("v.avi", 2, 2, 2, ""),
    ],
)
def test_a_video_whose_colours_are_not_those_of_srgb_is_refused_by_their_names(
    tmp_path: Path, name: str, primaries: int, curve: int, matrix: int, refused: str
) -> None:
    codes = f"colour_primaries={primaries}:transfer_characteristics={curve}:matrix_coefficients={matrix}"
    path = seconds_of(tmp_path / name, [(90, 5)], "-c:v", "libx264", "-bsf:v", f"h264_metadata={codes}")
    if refused:
        with pytest.raises(UsageError, match=refused) as error:
            VideoSource(path, loop=False)
        assert error.value.code == "live-source-unreadable"
    else:
        VideoSource(path, loop=False).close()


def test_a_video_whose_name_is_not_utf_8_plays_again_and_again(tmp_path: Path) -> None:
    folder = tmp_path / os.fsdecode(b"b\xfchne")
    folder.mkdir()
    source = VideoSource(video(tmp_path / "v.avi", [10, 200]).rename(folder / os.fsdecode(b"\xe9t\xe9.avi")), loop=True)
    shown = [source.next(at_s) for at_s in (0.01, 0.11, 0.21, 0.31)]
    assert [picture is not None and picture.pixels.mean() > 100 for picture in shown] == [False, True, False, True]
    source.close()


def test_a_folder_that_is_gone_is_told_of_once_then_black_and_comes_back(tmp_path: Path) -> None:
    folder = tmp_path / "stick"
    folder.mkdir()
    write(folder, "a.png", 120)
    for loop in (False, True):
        source = FolderSource(folder, loop=loop, rate_hz=10)
        first = source.next(0.0)
        assert first is not None
        folder.rename(tmp_path / "away")
        with pytest.raises(UsageError, match="stays for 30 s") as gone:
            source.next(1.0)
        assert gone.value.code == "live-source-gone"
        assert source.next(30.9) is None
        black = source.next(31.0)
        assert black is not None
        assert not black.pixels.any()
        assert source.next(40.0) is None
        (tmp_path / "away").rename(folder)
        again = source.next(50.0)
        assert again is not None
        np.testing.assert_array_equal(again.pixels, first.pixels)
        folder.rename(tmp_path / "away")
        with pytest.raises(UsageError, match="can't be read"):
            source.next(51.0)
        (tmp_path / "away").rename(folder)
        assert not source.ended


def test_a_looping_video_begins_again(tmp_path: Path) -> None:
    source = VideoSource(video(tmp_path / "v.avi", [10, 110, 210]), loop=True)
    seen = [source.next(0.05 + 0.1 * n) for n in range(8)]
    values = [int(one.pixels.mean()) for one in seen if one is not None]
    assert np.allclose(values, [10, 110, 210, 10, 110, 210, 10, 110], atol=4)
    assert not source.ended
    source.close()


def test_a_folder_that_fills_gives_its_newest_picture_once_and_counts_the_others(tmp_path: Path) -> None:
    source = FolderSource(tmp_path, loop=False, rate_hz=25)
    assert source.next(0.0) is None
    write(tmp_path, "0001.png", 50)
    (tmp_path / "notes.txt").write_text("no picture")
    first = source.next(0.1)
    assert first is not None
    assert int(first.pixels.mean()) == 50
    assert source.next(0.2) is None
    for number, value in ((2, 60), (3, 70), (4, 80)):
        write(tmp_path, f"000{number}.png", value)
    newest = source.next(0.3)
    assert newest is not None
    assert (int(newest.pixels.mean()), newest.skipped) == (80, 2)


def test_a_picture_that_is_written_over_is_shown_again(tmp_path: Path) -> None:
    source = FolderSource(tmp_path, loop=False, rate_hz=25)
    write(tmp_path, "render.png", 50)
    assert source.next(0.0) is not None
    write(tmp_path, "render.png", 90)
    os.utime(tmp_path / "render.png", ns=(10**18, 10**18))
    again = source.next(0.1)
    assert again is not None
    assert int(again.pixels.mean()) == 90


def test_a_half_written_picture_waits_and_a_damaged_one_is_told_of(tmp_path: Path) -> None:
    write(tmp_path, "a.png", 50)
    whole = (tmp_path / "a.png").read_bytes()
    (tmp_path / "a.png").write_bytes(whole[: len(whole) // 2])
    written_s = (tmp_path / "a.png").stat().st_mtime
    now = [written_s + 0.01]
    source = FolderSource(tmp_path, loop=False, rate_hz=25, clock=lambda: now[0])
    assert source.next(0.0) is None
    now[0] += 10
    with pytest.raises(UsageError) as refused:
        source.next(0.1)
    assert refused.value.code == "target-unreadable"


@pytest.mark.parametrize("loop", [False, True])
def test_a_picture_that_is_gone_when_it_is_looked_at_is_passed_over(tmp_path: Path, *, loop: bool) -> None:
    source = FolderSource(tmp_path, loop=loop, rate_hz=10)
    (tmp_path / "1.png").symlink_to(tmp_path / "kept" / "1.png")
    assert source.next(0.0) is None
    (tmp_path / "kept").mkdir()
    write(tmp_path / "kept", "1.png", 50)
    found = source.next(0.1)
    assert found is not None
    assert int(found.pixels.mean()) == 50


def test_a_looping_folder_shows_its_pictures_in_turn(tmp_path: Path) -> None:
    for number, value in enumerate((10, 110, 210)):
        write(tmp_path, f"{number}.png", value)
    source = FolderSource(tmp_path, loop=True, rate_hz=10)
    seen = [source.next(0.05 + 0.1 * n) for n in range(5)]
    assert [int(one.pixels.mean()) for one in seen if one is not None] == [10, 110, 210, 10, 110]
    late = source.next(0.95)
    assert late is not None
    assert late.skipped == 4


@pytest.mark.parametrize("name", ["missing.mp4", "text.mp4"])
def test_what_is_no_stream_is_refused(tmp_path: Path, name: str) -> None:
    (tmp_path / "text.mp4").write_text("not a video")
    with pytest.raises(UsageError) as refused:
        open_source(tmp_path / name, loop=False, rate_hz=25)
    assert refused.value.code == "live-source-unreadable"
