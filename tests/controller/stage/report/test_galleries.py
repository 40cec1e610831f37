"""What a report says and shows of light that other surfaces throw back."""

from __future__ import annotations

import numpy as np

from controller.core.arrays import ByteImage
from controller.optics.calibrate.values import Calibration, Metapixels, ProjectorCalibration, Radiometry
from controller.stage.report.galleries import light_gallery
from controller.stage.report.pictures import Crop

SIZE = (40, 60)


def stage(percent: float | None, left: int = 0) -> Calibration:
    """One projector; so much of its light comes from other surfaces, and a quarter of that in ``left`` columns."""
    white = np.ones((*SIZE, 3), np.float32)
    indirect = None
    if percent is not None:
        share = np.full(SIZE, percent / 100, np.float32)
        share[:, :left] /= 4
        white, indirect = ((1 - share)[..., None] * white, share[..., None] * white)
    nowhere = Metapixels(np.zeros((*SIZE, 2), np.float32), np.ones((*SIZE, 3), np.float32), np.ones(SIZE, np.bool_))
    part = ProjectorCalibration("one", nowhere, Radiometry(np.zeros((3, 256)), np.eye(3)), white, indirect=indirect)
    return Calibration((part,), np.zeros((*SIZE, 3), np.float32), np.ones(SIZE, np.bool_), np.eye(3))


def shown(percent: float) -> dict[str, ByteImage]:
    ((_, _, pictures),) = light_gallery(stage(percent), Crop(slice(0, SIZE[0]), slice(0, SIZE[1])))
    return {picture.caption: picture.image for picture in pictures}


def test_it_says_how_much_of_the_light_is_indirect() -> None:
    ((_, text, _),) = light_gallery(stage(40.0, 40), Crop(slice(0, SIZE[0]), slice(0, SIZE[1])))
    assert "10 % of the object's light at the median, 40 % at the 95th percentile" in text


def test_shares_are_told_apart_up_to_a_half() -> None:
    maps = [shown(percent)["Share of indirect light"].tobytes() for percent in (20.0, 40.0, 49.5, 50.5, 60.0)]
    assert len(set(maps)) == 4
    assert maps[3] == maps[4]


def test_indirect_light_is_brightened_to_be_seen() -> None:
    pictures = shown(20.0)
    direct, indirect = (pictures[name].astype(int) for name in ("Direct light", "Indirect light"))
    assert abs(int(direct[20, 50, 1]) - int(indirect[20, 50, 1])) <= 1, "four fifths, and four times a fifth"


def test_nothing_is_shown_where_none_was_found() -> None:
    assert light_gallery(stage(None), Crop(slice(0, SIZE[0]), slice(0, SIZE[1]))) == ()
