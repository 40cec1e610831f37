"""The live section stands for the light transport: what is computed from it is base times scale to within a dither."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks._synthetic import synthetic_calibration, synthetic_target
from controller.bundle.reader import Bundle
from controller.bundle.writer import NewAppearance, NewLive, write_bundle
from controller.calibrate.values import Calibration
from controller.play.live_maps import LiveMaps, compensate, light_table
from controller.session import live_parts
from controller.session.live_parts import footprints, live_model, named_arrays
from controller.solve.appearance import Base, base_image, scale_frames, solve_base
from controller.solve.dither import to_light
from controller.solve.targets_values import linear_to_srgb
from controller.transport import LightTransport


@pytest.fixture(scope="module")
def stage() -> tuple[Calibration, LightTransport, Base]:
    calibration = synthetic_calibration(projector=(52, 70), camera=(130, 194))
    transport = LightTransport.build(calibration)
    base = solve_base(transport, base_image(calibration, "minimum"), calibration.black, tolerance=1e-2)
    return calibration, transport, base


def test_centres_and_spreads_are_those_of_the_transport(stage: tuple[Calibration, LightTransport, Base]) -> None:
    _, transport, _ = stage
    centre, sigma, correlation = footprints(transport, 1)
    y, x = np.mgrid[0 : transport.shape[0], 0 : transport.shape[1]].astype(np.float64)
    lit = np.flatnonzero(sigma[:, 0] > 0)
    assert len(lit) > 3000
    for pixel in np.random.default_rng(1).choice(lit, 12, replace=False):
        one = np.zeros((3, transport.pixels), np.float32)
        one[:, pixel] = 1
        # The rows of T' in the mean of all channels, light of each camera pixel left out.
        seen = transport.forward_planes(one).astype(np.float64).sum(axis=0)
        white = transport.forward_planes(np.ones((3, transport.pixels), np.float32)).sum(axis=0)
        weight = np.divide(seen, white, out=np.zeros_like(seen), where=white > 0)
        weight /= weight.sum()
        mean = (weight * x).sum(), (weight * y).sum()
        spread = np.sqrt([(weight * (x - mean[0]) ** 2).sum(), (weight * (y - mean[1]) ** 2).sum()])
        assert np.hypot(*(centre[pixel] - mean)) < 0.25
        np.testing.assert_allclose(sigma[pixel], np.maximum(spread, 0.3), rtol=0.15)
        assert abs(correlation[pixel]) <= 0.95


@pytest.mark.parametrize(("largest_px", "most"), [(2048, 0.01), (100, 0.03)])
def test_live_frames_are_base_times_scale(
    tmp_path: Path,
    stage: tuple[Calibration, LightTransport, Base],
    monkeypatch: pytest.MonkeyPatch,
    largest_px: int,
    most: float,
) -> None:
    monkeypatch.setattr(live_parts, "LARGEST_TARGET_PX", largest_px)
    calibration, transport, base = stage
    outputs = [f"P{n}" for n in range(3)]
    live = named_arrays(live_model(transport, base, calibration.black), calibration, outputs)
    maps = maps_of(tmp_path / "live.vel", live, transport)
    wanted = synthetic_target(transport.shape)
    small = live_parts._reduced(wanted, -(-max(transport.shape) // largest_px))
    target = np.rint(255 * linear_to_srgb(small)).astype(np.uint8)
    brightness = 0.25 * float(np.median(base.image[transport.object_mask])) / 0.3
    shown = [
        to_light(image, part.radiometry)
        for image, part in zip(compensate(maps, target, brightness).pixels, calibration.projectors, strict=True)
    ]
    light = light_table()[np.rint(255 * linear_to_srgb(wanted)).astype(np.uint8)]
    exact = scale_frames(transport, base, light * np.float32(brightness), calibration.black)
    # As the camera sees them: dithering evens out there.
    seen, meant = transport.forward(shown), transport.forward(exact)
    mask = transport.object_mask
    assert np.sqrt(np.mean((seen - meant)[mask] ** 2) / np.mean(meant[mask] ** 2)) < most


def maps_of(path: Path, live: NewLive, transport: LightTransport) -> LiveMaps:
    sizes = [(f"P{n}", columns, rows) for n, (rows, columns) in enumerate(transport.sizes)]
    frames = {name: np.zeros((rows, columns, 3), np.uint8) for name, columns, rows in sizes}
    write_bundle(path, stage="s", calibration="c", created_unix_s=0, outputs=sizes,
                 appearances=[NewAppearance("a", frames)], live=live)  # fmt: skip
    with Bundle.open(path, allow_unsigned=True) as bundle:
        bundle.verify()
        return LiveMaps.read(bundle)
