"""The effects as a camera's picture shows them, each switched on by its level in bench.toml."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from plugins.emulated.core.truth import BenchTruth, Dithering, Subsurface, Varnish, read_truth, write_truth
from plugins.emulated.optics.objects import StageObject
from plugins.emulated.optics.rays import Samples, cast
from plugins.emulated.optics.render import Renderer, Shutter

LAMP = ((612.0, 22.0), (541.0, 27.0), (457.0, 17.0))
FILTERS = ((598.0, 38.0), (538.0, 42.0), (462.0, 30.0))


def with_object(truth: BenchTruth, **changes: Any) -> BenchTruth:
    return dataclasses.replace(truth, object=dataclasses.replace(truth.object, **changes))


def with_camera(truth: BenchTruth, **changes: Any) -> BenchTruth:
    return dataclasses.replace(truth, camera=dataclasses.replace(truth.camera, **changes))


def with_projectors(truth: BenchTruth, **changes: Any) -> BenchTruth:
    return dataclasses.replace(truth, projectors=tuple(dataclasses.replace(p, **changes) for p in truth.projectors))


def with_bands(truth: BenchTruth) -> BenchTruth:
    lit = tuple(
        dataclasses.replace(p, light=dataclasses.replace(p.light, bands_nm=LAMP)) for p in truth.projectors
    )  # fmt: skip
    return with_camera(dataclasses.replace(truth, projectors=lit), bands_nm=FILTERS)


def everything(truth: BenchTruth) -> BenchTruth:
    truth = with_object(truth, varnish=Varnish(1.0, 0.3, 1.5), subsurface=Subsurface(0.4, 0.003))
    return with_bands(with_camera(with_projectors(truth, dithering=Dithering(64, 4)), focus_m=1.1))


@pytest.fixture(scope="module")
def rays(tiny_truth: BenchTruth, vase_and_bust: StageObject) -> Samples:
    """Cast once, with all that any effect needs."""
    return cast(everything(tiny_truth), vase_and_bust, lambda share: None)


def seen(truth: BenchTruth, rays: Samples, value: int = 255, shutter: Shutter = Shutter()) -> npt.NDArray[np.float64]:  # noqa: B008
    if truth.object.varnish.strength == 0.0:
        rays = dataclasses.replace(rays, gloss=np.zeros((len(rays.gain), 0), np.float32))
    frames = [np.full((*p.lens.size_px[::-1], 3), value, np.uint8) for p in truth.projectors]
    for frame in frames:
        frame[::7] = 0
    return np.asarray(Renderer(truth, rays).light(frames, [1.0] * len(frames), shutter), np.float64)


def test_levels_are_written_and_read(tiny_truth: BenchTruth, tmp_path: Path) -> None:
    write_truth(tmp_path, everything(tiny_truth))
    assert read_truth(tmp_path) == everything(tiny_truth)


def test_varnish_adds_light_and_more_where_light_grazes(tiny_truth: BenchTruth, rays: Samples) -> None:
    added = seen(with_object(tiny_truth, varnish=Varnish(1.0, 0.3, 1.5)), rays) - seen(tiny_truth, rays)
    assert added.min() > -1e-5
    assert added.max() > 0.01


def test_light_below_the_surface_blurs_stripes_and_keeps_their_light(tiny_truth: BenchTruth, rays: Samples) -> None:
    sharp, soft = seen(tiny_truth, rays), seen(with_object(tiny_truth, subsurface=Subsurface(0.9, 0.004)), rays)
    lit = sharp.min(axis=2) > 0.02
    assert np.abs(np.diff(soft, axis=0))[lit[1:]].mean() < 0.95 * np.abs(np.diff(sharp, axis=0))[lit[1:]].mean()
    assert soft.sum() == pytest.approx(sharp.sum(), rel=0.05)


def test_light_below_the_surface_of_the_object_does_not_come_out_of_the_room(
    tiny_truth: BenchTruth, rays: Samples
) -> None:
    width = tiny_truth.camera.lens.size_px[0]
    half = dataclasses.replace(rays, on_object=rays.pixels % width < width // 2)
    sharp, soft = (
        seen(with_object(tiny_truth, subsurface=Subsurface(share, 0.01)), half) for share in (0.0, 0.9)
    )  # fmt: skip
    # The camera's lens blurs over the border between them.
    assert np.abs(soft - sharp)[:, width // 2 + 4 :].max() < 1e-5
    beside = np.s_[:, width // 2 - 8 : width // 2]
    assert soft[beside].sum() == pytest.approx(sharp[beside].sum(), rel=0.05)


def test_a_wider_aperture_blurs_what_is_out_of_focus(tiny_truth: BenchTruth, rays: Samples) -> None:
    near = with_camera(tiny_truth, focus_m=0.6)
    slopes = [
        np.abs(np.diff(seen(near, rays, shutter=Shutter(aperture_f=f)), axis=0)).mean() for f in (2.0, 5.6, 22.0)
    ]  # fmt: skip
    assert slopes[0] < 0.97 * slopes[1] < slopes[2]
    sums = [seen(near, rays, shutter=Shutter(aperture_f=f)).sum() for f in (5.6, 22.0)]
    assert sums[0] == pytest.approx(sums[1], rel=0.03)


def test_dithering_shows_in_short_exposures_alone(tiny_truth: BenchTruth, rays: Samples) -> None:
    dithered = with_projectors(tiny_truth, dithering=Dithering(16, 16, 1 / 60))
    wanted = seen(tiny_truth, rays, 90)
    long, short = (seen(dithered, rays, 90, Shutter(0.3, s)) for s in (16 / 60, 0.5 / 60))
    lit = wanted.min(axis=2) > 0.02
    off = [float(np.abs(one / np.maximum(wanted, 1e-6) - 1)[lit].mean()) for one in (long, short)]
    assert off[0] < 0.02
    assert off[1] > 2 * off[0]


def test_spectra_keep_white_and_change_the_mixing_by_the_paint(tiny_truth: BenchTruth, rays: Samples) -> None:
    spectral = with_bands(tiny_truth)
    red = [np.zeros((*p.lens.size_px[::-1], 3), np.uint8) for p in tiny_truth.projectors]
    for frame in red:
        frame[..., 0] = 255
    levels = [1.0, 0.0, 0.0]
    ratios = []
    for truth in (tiny_truth, spectral):
        bare = dataclasses.replace(rays, gloss=np.zeros((len(rays.gain), 0), np.float32))
        renderer = Renderer(truth, bare)
        whole, part = renderer.light([np.full_like(f, 255) for f in red], levels), renderer.light(red, levels)
        lit = whole.min(axis=2) > 0.05
        ratios.append((part[lit] / whole[lit])[:, 1])
    assert np.ptp(np.percentile(ratios[0], [10, 90])) < 0.01
    assert np.ptp(np.percentile(ratios[1], [10, 90])) > 0.01
