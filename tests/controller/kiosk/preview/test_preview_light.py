"""What a preview calculates at some pixels is what a computation calculates there."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from controller.core.arrays import FloatImage
from controller.kiosk.preview import preview_light as module
from controller.kiosk.preview.preview_light import PreviewLight, preview_light, sampled
from controller.optics.solve.reach.drive_levels import DriveLevels
from controller.optics.solve.request import Aim, SolveOptions, aim_at
from controller.optics.transport import build_transport
from controller.optics.transport.indirect.indirect_light import IndirectLight
from tests.controller.optics.solve.conftest import plane_calibration

STEP = 4


@pytest.fixture(scope="module")
def calibrated() -> Any:
    """A wide stage whose previews have every fourth pixel, with a little indirect light and one white segment."""
    calibration = plane_calibration(projector=(30, 240), camera=(120, 1920))
    first, *others = calibration.projectors
    first = dataclasses.replace(first, radiometry=dataclasses.replace(first.radiometry, segment=0.2))
    calibration = dataclasses.replace(calibration, projectors=(first, *others))
    transport = build_transport(calibration)
    side, grid = 40, (3, 48)
    factors = np.full((144, 144), 0.1 / 144, np.float32) + 0.05 * np.eye(144, dtype=np.float32)
    scale = np.full((120, 1920, 3), 0.5, np.float32)
    indirect = IndirectLight(factors, scale, transport.object_mask, grid, side)
    drive = DriveLevels.of_transport(transport)
    return SimpleNamespace(calibration=calibration, transport=transport, indirect=indirect, drive=drive)


def picture(shape: tuple[int, ...]) -> FloatImage:
    y, x = np.mgrid[0 : shape[0], 0 : shape[1]] / np.array(shape[:2])[:, None, None]
    return np.asarray(0.5 + 0.4 * np.stack([np.sin(9 * x), np.cos(7 * y), np.sin(6 * x * y)], -1), np.float32)


def aimed(light: Any, black: FloatImage, image: FloatImage) -> Aim:
    return aim_at(light.drive, black, light.indirect, image, SolveOptions(0.9, 0.001, adapt=0.0))


def test_a_preview_aims_at_what_a_computation_aims_at(calibrated: Any) -> None:
    light = sampled(calibrated)
    assert light.step == STEP
    kept = np.s_[STEP // 2 :: STEP, STEP // 2 :: STEP]
    image = picture(calibrated.transport.camera_shape)
    whole = aimed(calibrated, calibrated.calibration.black, image)
    few = aimed(light, light.black, np.ascontiguousarray(image[kept]))
    assert few.exposure == pytest.approx(whole.exposure, rel=0.01)
    np.testing.assert_allclose(few.direct / few.exposure, whole.direct[kept] / whole.exposure, atol=4e-3)
    levels = calibrated.drive.of(whole.direct)[kept]
    np.testing.assert_allclose(light.drive.of(np.ascontiguousarray(whole.direct[kept])), levels, rtol=1e-5, atol=1e-6)


def test_what_a_preview_needs_is_kept_and_made_again_where_it_is_damaged(
    calibrated: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    read: list[Path] = []

    def of_run(run: Path, names: tuple[str, ...]) -> Any:
        read.append(run)
        return calibrated

    monkeypatch.setattr("controller.stage.artefacts.calibrated.Calibrated", of_run)
    monkeypatch.setattr(module, "_in_white", lambda calibrated: b"a picture")

    def known() -> PreviewLight:
        module._known.clear()
        return preview_light(tmp_path, tmp_path / "runs" / "one", ("left", "right"))

    first, again = known(), known()
    assert len(read) == 1
    for name in ("mask", "matrices", "segment_share"):
        np.testing.assert_array_equal(getattr(first.drive, name), getattr(again.drive, name))
    image = picture(first.black.shape)
    np.testing.assert_array_equal(aimed(first, first.black, image).direct, aimed(again, again.black, image).direct)
    (file,) = (tmp_path / module.FOLDER).glob("*.npz")
    file.write_bytes(file.read_bytes()[:-1000])
    known()
    assert len(read) == 2
