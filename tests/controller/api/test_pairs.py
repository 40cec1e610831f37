"""A transport from pairs of pictures, judged by what an emulated stage shows without noise."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest
import scipy.sparse as sp

from controller import api
from controller.core.arrays import ByteImage, FloatImage
from controller.stage.services.export import export
from plugins.emulated.core.truth import ObjectTruth
from plugins.emulated.optics.objects import default_object
from plugins.emulated.optics.rays import cast
from plugins.emulated.optics.render import Renderer, response
from plugins.emulated.optics.staging import random_truth
from tests.plugins.emulated.conftest import shrunk

COUNT = 120
SEEN = slice(20, 44), slice(30, 60)
"""Rows and columns of the camera's picture."""


@dataclass(frozen=True)
class Shown:
    """What one projector showed (N, rows, columns, 3), and what the camera saw (N, camera rows, columns, 3)."""

    pictures: ByteImage
    light: FloatImage
    seen: FloatImage


def pictures(count: int, shape: tuple[int, int]) -> ByteImage:
    """Coloured clouds with the spectrum of photographs."""
    random = np.random.default_rng(3)
    frequency = np.hypot(np.fft.fftfreq(shape[0])[:, None], np.fft.fftfreq(shape[1]))
    frequency[0, 0] = 1 / max(shape)
    grey, colours = random.normal(size=(count, 1, *shape)), random.normal(size=(count, 3, *shape))
    clouds = np.fft.ifft2(np.fft.fft2(grey + 0.7 * colours) / frequency).real
    clouds /= clouds.std()
    return np.clip(128 + 60 * clouds, 0, 255).astype(np.uint8).transpose(0, 2, 3, 1)


@pytest.fixture(scope="module")
def shown() -> Shown:
    thing = default_object()
    whole = shrunk(random_truth("small", 7, thing, ObjectTruth("vase-and-bust", "", 7), (0, 0)))
    frames = pictures(COUNT + 1, whole.projectors[0].lens.size_px[::-1])
    dark = [np.zeros_like(frames[0])] * (len(whole.projectors) - 1)
    renderer = Renderer(whole, cast(whole, thing, lambda share: None))
    levels = [1.0] * len(whole.projectors)
    seen = np.stack([renderer.light([frame, *dark], levels)[SEEN].copy() for frame in frames])
    table = response(whole.projectors[0].light)
    light = np.stack([table[frames[..., k], k] for k in range(3)], axis=-1).astype(np.float32)
    return Shown(frames, light, (seen / np.percentile(seen, 99)).astype(np.float32))


def test_new_pictures_are_predicted(shown: Shown) -> None:
    random = np.random.default_rng(4)
    noise = 0.01 * np.sqrt(np.maximum(shown.seen[:COUNT], 0.01)) * random.normal(size=shown.seen[:COUNT].shape)
    fit = api.transport_from_pairs([shown.light[:COUNT]], shown.seen[:COUNT] + noise)
    predicted = fit.transport.forward([shown.light[COUNT]]) + fit.black
    truth, lit = shown.seen[COUNT], fit.explained >= 0.5
    assert lit[truth.max(axis=2) > 0.05].mean() > 0.95
    assert np.sqrt(((predicted - truth)[lit] ** 2).sum() / (truth[lit] ** 2).sum()) < 0.05
    assert fit.error < 0.06


def test_a_folder_becomes_the_transport_of_its_arrays(shown: Shown, tmp_path: Path) -> None:
    for kind in ("projected", "photographs"):
        (tmp_path / kind).mkdir()
    for n in range(100):
        cv2.imwrite(str(tmp_path / "projected" / f"{n:03}.png"), shown.pictures[n, ..., ::-1])
        photograph = np.rint(65535 * np.clip(shown.seen[n, 8:16, 8:16], 0, 1)).astype(np.uint16)
        cv2.imwrite(str(tmp_path / "photographs" / f"{n:03}.png"), photograph[..., ::-1])
    pairs = api.read_pairs(tmp_path)
    np.testing.assert_allclose(pairs.projected[0], (shown.pictures[:100] / 255.0) ** 2.2, atol=1e-5)
    fit = api.transport_from_pairs(pairs.projected, pairs.photographs)
    written = export(run=tmp_path, kind="transport", out=tmp_path / "out", step=None)
    assert "left out" in written["error"]
    matrix, black = sp.load_npz(tmp_path / "out" / "projected.npz"), np.load(tmp_path / "out" / "black.npz")["black"]
    frame = pairs.projected[0][3]
    made = (matrix @ frame.transpose(2, 0, 1).ravel()).reshape(3, 8, 8).transpose(1, 2, 0) + black
    np.testing.assert_allclose(made, fit.transport.forward([frame]) + fit.black, atol=1e-3)
    (tmp_path / "projected" / "007.png").unlink()
    with pytest.raises(api.VelaturaError, match="no picture 007"):
        api.read_pairs(tmp_path)


def test_pairs_that_determine_nothing_are_refused(shown: Shown) -> None:
    seen = shown.seen[:100, 8:12, 8:12]
    for photographs, code in ((seen[:99], "pairs-too-few"), (seen[::-1], "pairs-undetermined")):
        with pytest.raises(api.VelaturaError) as refused:
            api.transport_from_pairs([shown.light[: len(photographs)]], photographs)
        assert refused.value.code == code
