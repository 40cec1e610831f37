"""Live frames by shaders equal the numpy reference, and what they equal is base times scale.

Needs software OpenGL (libgl1-mesa-dri, libegl1); a machine without it fails here.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from controller.bundle.live_maps import LiveMaps, compensate, light_table, sigma_table
from controller.bundle.reader import Bundle
from controller.bundle.writer import NewAppearance, NewBundle, NewLive, write_bundle
from controller.core.errors import BundleError

ROOT = Path(__file__).parents[4]
OUTPUTS = (("P1", 37, 29), ("P2", 30, 41))
TARGET = (53, 47)

Arrays = dict[str, npt.NDArray[Any]]


def rising(random: np.random.Generator) -> npt.NDArray[np.float32]:
    curves = np.cumsum(random.random((3, 256)) ** 4, axis=1)
    return ((curves - curves[:, :1]) / (curves[:, -1:] - curves[:, :1])).astype(np.float32)


def random_live(seed: int) -> Arrays:
    random = np.random.default_rng(seed)
    width, height = TARGET
    bare = random.random((height, width)) < 0.1
    arrays: Arrays = {
        "gain": np.where(bare[..., None], 0, random.random((height, width, 3)) * 3).astype(np.float16),
        "offset": (0.1 * random.random((height, width, 3)) * ~bare[..., None]).astype(np.float16),
        "present": np.where(bare, 0, random.integers(1, 256, (height, width))).astype(np.uint8),
        "unit": np.array([0.7], np.float32),
        "noise": ((random.permutation(4096) + 0.5) / 4096).reshape(64, 64).astype(np.float32),
    }
    for name, columns, rows in OUTPUTS:
        spread = random.integers(30, 190, (rows, columns, 2))
        correlation = random.integers(1, 256, (rows, columns, 1))
        lit = random.random((rows, columns, 1)) < 0.9
        arrays |= {
            f"{name}.base": random.integers(0, 65536, (rows, columns, 3), dtype=np.uint16),
            f"{name}.range": np.array([-0.02, 1.1], np.float32),
            f"{name}.centre": random.integers(0, 65536, (rows, columns, 2), dtype=np.uint16),
            f"{name}.shape": (np.concatenate([spread, correlation], -1) * lit).astype(np.uint8),
            f"{name}.unmix": (np.eye(3) + 0.1 * random.normal(size=(3, 3))).astype(np.float32),
            f"{name}.response": rising(random),
            f"{name}.dither": random.integers(0, 64, 2).astype(np.uint16),
        }
    return arrays


def random_indirect(seed: int) -> Arrays:
    """Light by way of other surfaces on 3 x 4 blocks, a third of what is wanted."""
    random = np.random.default_rng(seed)
    width, height = TARGET
    places = random.integers(0, (height, width), (64, 12, 2))
    sampled = np.stack([random.random((64, 12, 3)), 0.02 * random.random((64, 12, 3)), 2 * random.random((64, 12, 3))])
    return {
        "indirect.factors": (random.random((12, 12)) / 20).astype(np.float32),
        "indirect.grid": np.array([3, 4], np.uint16),
        "indirect.side": np.array([16.5], np.float32),
        "indirect.places": places.astype(np.uint16),
        "indirect.sampled": sampled.astype(np.float32),
        "indirect.surface": random.random((height, width, 3)).astype(np.float16),
    }


def random_paint(seed: int) -> Arrays:
    """Colours that depend on the paint."""
    width, height = TARGET
    return {"paint": np.random.default_rng(seed).normal(0, 0.2, (height, width, 3, 3)).astype(np.float16)}


def segments(*shares: float) -> Arrays:
    """White segments of the outputs."""
    named = zip(OUTPUTS, shares, strict=True)
    return {f"{name}.segment": np.array([share], np.float32) for (name, _, _), share in named}


def write(path: Path, arrays: Arrays) -> Path:
    frames = {name: np.zeros((rows, columns, 3), np.uint8) for name, columns, rows in OUTPUTS}
    write_bundle(
        path,
        NewBundle(stage="s", calibration="c", created_unix_s=0, outputs=OUTPUTS, live=NewLive(TARGET, arrays)),
        appearances=[NewAppearance("a", frames)],
    )
    return path


def maps_of(path: Path) -> LiveMaps:
    with Bundle.open(path, allow_unsigned=True) as bundle:
        return LiveMaps.read(bundle)


@pytest.mark.parametrize(
    ("seed", "more"),
    [
        (1, {}),
        (2, random_indirect(2)),
        (3, random_paint(3)),
        (4, random_indirect(4) | random_paint(4)),
        (5, segments(0.2, 0.55)),
    ],
    ids=["direct", "indirect", "paint", "both", "white segments"],
)
def test_frames_by_shaders_are_those_of_the_reference_to_one_device_value(
    tmp_path: Path, seed: int, more: Arrays
) -> None:
    bundle = write(tmp_path / "live.vel", random_live(seed) | more)
    target = np.random.default_rng(seed).integers(0, 256, (*TARGET[::-1], 3), dtype=np.uint8)
    np.savez(tmp_path / "asked.npz", target=target, brightness=1.3)
    subprocess.run(
        [sys.executable, str(Path(__file__).with_name("live_check.py")), bundle, tmp_path / "asked.npz",
         tmp_path / "out.npz"],
        check=True, timeout=60, env={**os.environ, "PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    wanted = compensate(maps_of(bundle), target, 1.3)
    with np.load(tmp_path / "out.npz") as found:
        assert found["same"], "the same target gives the same frames, whatever was drawn between"
        assert int(found["error"]) == 0
        for number, image in enumerate(wanted):
            drawn = found[str(number)]
            assert len(np.unique(image)) > 100
            away = np.abs(drawn.astype(int) - image)
            assert away.max() <= 1
            assert np.mean(away > 0) < 0.002, "only at the edge of a dithering threshold"


def test_the_reference_is_the_weighted_mean_written_down_pixel_by_pixel(tmp_path: Path) -> None:
    shares = {"P1": 0.0, "P2": 0.3}
    arrays = random_live(3) | segments(*shares.values())
    maps = maps_of(write(tmp_path / "live.vel", arrays))
    target = np.random.default_rng(3).integers(0, 256, (*TARGET[::-1], 3), dtype=np.uint8)
    frames = compensate(maps, target, 0.9)
    gain, offset = arrays["gain"].astype(float), arrays["offset"].astype(float)
    scale = np.maximum(light_table()[target].astype(float) * gain * (0.9 / 0.7) - offset, 0)
    y, x = np.mgrid[0 : TARGET[1], 0 : TARGET[0]]
    for number, (name, columns, rows) in enumerate(OUTPUTS):
        for row, column in np.random.default_rng(4).integers(0, (rows, columns), (60, 2)):
            shape = arrays[f"{name}.shape"][row, column]
            if shape[0] == 0:
                assert frames[number][row, column].max() <= 1
                continue
            cx, cy = arrays[f"{name}.centre"][row, column] / 65535 * (np.array(TARGET) - 1)
            sx, sy = sigma_table()[shape[:2]]
            r = np.clip((float(shape[2]) - 128) / 127, -0.96, 0.96)
            inverse = np.linalg.inv([[sx * sx, r * sx * sy], [r * sx * sy, sy * sy]])
            d = np.stack([x - cx, y - cy], -1)
            weight = np.exp(-0.5 * np.einsum("...i,ij,...j", d, inverse, d))
            for apart, sigma in ((d[..., 0], sx), (d[..., 1], sy)):
                weight[np.abs(apart) > np.clip(3 * sigma, 0.5, 12)] = 0
            below = (weight * arrays["present"] / 255).sum()
            mean = (weight[..., None] * scale).sum(axis=(0, 1)) / below if below > 0 else np.zeros(3)
            low, high = arrays[f"{name}.range"]
            base = low + arrays[f"{name}.base"][row, column] / 65535 * (high - low)
            shown_light = np.clip(arrays[f"{name}.unmix"] @ (mean * base), 0, 1)
            own = (shown_light - shares[name] * shown_light.min()) / (1 - shares[name])
            light = np.minimum(own, 1)  # a colour can be more saturated than the projector shows
            for channel in range(3):
                table = arrays[f"{name}.response"][channel]
                shown = int(frames[number][row, column, channel])
                assert table[max(shown - 1, 0)] - 1e-5 <= light[channel] <= table[min(shown + 1, 255)] + 1e-5


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("gain", np.zeros((3, 3, 3), np.float16)),
        ("present", np.zeros(TARGET[::-1], np.uint16)),
        ("P1.base", np.zeros((2, 2, 3), np.uint16)),
        ("P2.response", np.zeros((3, 255), np.float32)),
        ("unit", np.array([np.nan], np.float32)),
        ("P1.unmix", np.full((3, 3), np.inf, np.float32)),
        ("P1.segment", np.zeros(2, np.float32)),
        ("P1.segment", np.ones(1, np.float32)),
        ("P2.segment", np.full(1, -0.1, np.float32)),
        ("paint", np.zeros((*TARGET, 3, 3), np.float16)),
        ("paint", np.full((*TARGET[::-1], 3, 3), np.nan, np.float16)),
        ("indirect.factors", np.zeros((11, 12), np.float32)),
        ("indirect.places", np.full((64, 12, 2), 60, np.uint16)),
        ("indirect.side", np.zeros(1, np.float32)),
    ],
)
def test_a_live_section_of_another_shape_or_without_numbers_is_refused(
    tmp_path: Path, name: str, values: npt.NDArray[Any]
) -> None:
    path = write(tmp_path / "live.vel", random_live(1) | random_indirect(1) | {name: values})
    with pytest.raises(BundleError, match="damaged"):
        maps_of(path)


def test_a_bundle_without_a_live_section_says_how_to_get_one(tmp_path: Path) -> None:
    arrays = random_live(1)
    del arrays["P2.centre"]
    with pytest.raises(BundleError, match="--live") as wrong:
        maps_of(write(tmp_path / "live.vel", arrays))
    assert wrong.value.code == "bundle-not-live"
