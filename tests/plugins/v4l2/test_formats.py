"""What the driver ``v4l2`` takes from stage.toml, and its files; the camera itself: ``tests/real_kernel``."""

from __future__ import annotations

import ctypes
import io
import re
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from hal.errors import PluginError
from hal.registry import OpenContext, check_device
from plugins.v4l2 import kernel
from plugins.v4l2.camera import DRIVER
from plugins.v4l2.formats import code_of, is_complete_jpeg, jpeg_file, number_of, rank, video_format


@pytest.mark.parametrize(
    "wrong",
    [{"format": "Y10P"}, {"format": "RG12x"}, {"size": [640]}, {"size": [640, "480"]}, {"bits": 8}, {"bits": 17},
     {"skip_frames": 0}, {"exposure_step_s": -1.0}, {"exposure_step_s": float("nan")}, {"black_level": -1},
     {"address": 3}],
)  # fmt: skip
def test_wrong_settings_are_refused_before_the_camera_is_used(wrong: dict[str, object]) -> None:
    with pytest.raises(PluginError):
        check_device(DRIVER, wrong, OpenContext(Path()))


def test_sound_settings_are_taken() -> None:
    check_device(DRIVER, {"format": "Y16", "size": [640, 480], "bits": 12, "skip_frames": 3}, OpenContext(Path()))


def test_the_best_format_is_a_mosaic_then_grey_then_what_is_least_compressed() -> None:
    codes = ["MJPG", "YUYV", "GREY", "Y16 ", "BA81", "RG12"]
    known = [video_format(code) for code in codes]
    ranks = [rank(one) for one in known if one is not None]
    assert ranks == sorted(ranks)
    assert len(set(ranks)) == len(codes)


def test_codes_of_packed_and_big_endian_formats_are_not_read() -> None:
    assert code_of(number_of("Y16 ") | 1 << 31) == ""
    assert [video_format(code) for code in ("Y10P", "pRAA", "NV12", "")] == [None] * 4


def test_structures_have_the_sizes_of_the_kernels() -> None:
    sizes = {kernel.Capability: 104, kernel.FormatDescription: 64, kernel.Format: 208, kernel.FrameSize: 44,
             kernel.FrameInterval: 52, kernel.Parameters: 204, kernel.Buffers: 20, kernel.Buffer: 88,
             kernel.ControlQuery: 68, kernel.Control: 8}  # fmt: skip
    assert {kind: ctypes.sizeof(kind) for kind in sizes} == sizes


def test_motion_jpeg_gets_the_tables_that_it_left_out() -> None:
    file = io.BytesIO()
    Image.fromarray(np.full((32, 32, 3), (200, 60, 20), np.uint8)).save(file, "JPEG")
    bare = file.getvalue()
    while (found := re.search(rb"\xff\xc4", bare)) is not None:
        bare = bare[: found.start()] + bare[found.end() + int.from_bytes(bare[found.end() :][:2], "big") :]
    whole = jpeg_file(bare + bytes(64), (32, 32), "MJPG")
    assert is_complete_jpeg(bare + bytes(64))
    assert whole.count(b"\xff\xc4") == 4
    with Image.open(io.BytesIO(whole)) as picture:
        np.testing.assert_allclose(np.asarray(picture).mean(axis=(0, 1)), (200, 60, 20), atol=4)
    assert jpeg_file(file.getvalue(), (32, 32), "MJPG") == file.getvalue()


@pytest.mark.parametrize("data", [b"", b"\xff\xd8", b"\xff\xd8\xff", b"\0" * 40, b"\xff\xd8" + bytes(40)])
def test_a_frame_that_is_cut_is_no_whole_jpeg(data: bytes) -> None:
    assert not is_complete_jpeg(data)


@pytest.mark.parametrize("code", ["YUYV", "UYVY", "RGB3", "BGR3"])
def test_finished_pictures_keep_their_colours(code: str) -> None:
    rgb = np.zeros((16, 16, 3), np.uint8)
    rgb[:] = (180, 90, 40)
    y, u, v = cv2.cvtColor(rgb, cv2.COLOR_RGB2YUV_I420)[[0, 16, 20], 0]
    pairs = {"YUYV": (y, u, y, v), "UYVY": (u, y, v, y)}
    if code in pairs:
        data = np.tile(np.array(pairs[code], np.uint8), 16 * 8).tobytes()
    else:
        data = (rgb if code == "RGB3" else rgb[..., ::-1]).tobytes()
    with Image.open(io.BytesIO(jpeg_file(data, (16, 16), code))) as picture:
        np.testing.assert_allclose(np.asarray(picture).mean(axis=(0, 1)), (180, 90, 40), atol=4)
