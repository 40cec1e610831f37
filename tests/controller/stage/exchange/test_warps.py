"""ST maps, warped by OpenImageIO, and transports as SciPy reads them."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO
import pytest
import scipy.sparse as sp

from controller.core.arrays import FloatImage
from controller.core.errors import UsageError
from controller.optics.transport import LightTransport
from controller.optics.transport.planes import CameraBox, frame_planes
from controller.stage.artefacts.names import safe_name
from controller.stage.exchange import sparse
from controller.stage.exchange.content import Content
from controller.stage.exchange.formats import format_of
from tests.controller.optics.transport.conftest import random_frames
from tests.controller.stage.exchange.conftest import NAMES


def values(picture: OpenImageIO.ImageBuf) -> FloatImage:
    return np.asarray(picture.get_pixels(), np.float32)


def gradients(size: tuple[int, int]) -> OpenImageIO.ImageBuf:
    """A picture that says in each pixel where it is, in pixels."""
    x, y = np.meshgrid(np.arange(size[0]), np.arange(size[1]))
    return OpenImageIO.ImageBuf(np.stack([x, y], axis=2).astype(np.float32))


def test_openimageio_takes_each_pixel_from_where_the_projector_pixel_lies(content: Content, tmp_path: Path) -> None:
    assert format_of("st-maps").write(content, tmp_path) == {"maps": 4}
    for n, name in enumerate(NAMES):
        own = content.geometry.projectors[n]
        metapixels, seen = content.metapixels()[n], content.seen_px[n]
        assert seen is not None
        for file, places, size in (
            (f"{safe_name(name)}-from-camera.exr", np.where(metapixels.valid[..., None], metapixels.centre_px, np.nan),
             content.geometry.camera.size_px),
            (f"camera-from-{safe_name(name)}.exr", seen, own.size_px),
        ):  # fmt: skip
            read = OpenImageIO.ImageBuf(str(tmp_path / file))
            warped = OpenImageIO.ImageBufAlgo.st_warp(gradients(size), read, "triangle", 2.0, flip_t=True, roi=read.roi)
            known = values(read)[..., 3] == 1
            np.testing.assert_array_equal(known, np.isfinite(places).all(axis=2))
            # the middle of the picture, where the warp's filter meets no border
            inside = known & (places > 2).all(axis=2) & (places < np.array(size) - 3).all(axis=2)
            assert inside.sum() > 100
            np.testing.assert_allclose(values(warped)[..., :2][inside], places[inside], atol=0.05)


def test_the_readme_says_that_a_warp_is_less_than_a_solve(content: Content, tmp_path: Path) -> None:
    format_of("st-maps").write(content, tmp_path)
    assert "superimposed" in (tmp_path / "README.txt").read_text()


def read(folder: Path) -> list[Any]:
    described = json.loads((folder / "transport.json").read_text())
    return [sp.load_npz(folder / row["file"]) for row in described["projectors"]]


def whole_stage(content: Content) -> Content:
    """With the names of the transport's two projectors."""
    return replace(content, names=NAMES)


def test_products_of_the_matrices_are_ours(content: Content, transport: LightTransport, tmp_path: Path) -> None:
    format_of("transport").write(whole_stage(content), tmp_path)
    matrices = read(tmp_path)
    frames = random_frames(transport, 1)
    theirs = sum(matrix @ frame_planes([frame]).ravel() for matrix, frame in zip(matrices, frames, strict=True))
    ours = transport.forward(frames)
    rows, columns = transport.camera_shape
    np.testing.assert_allclose(np.moveaxis(theirs.reshape(3, rows, columns), 0, 2), ours, rtol=2e-5, atol=2e-6)
    picture = np.random.default_rng(2).random(ours.shape, np.float32)
    flat = np.moveaxis(picture, 2, 0).ravel()
    for matrix, back in zip(matrices, transport.adjoint(picture), strict=True):
        np.testing.assert_allclose(matrix.T @ flat, frame_planes([back]).ravel(), rtol=2e-5, atol=2e-6)


def test_a_crop_has_its_rows_alone(
    content: Content, transport: LightTransport, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sparse, "AT_ONCE", 100)  # several parts
    box = CameraBox(5, 12, 17, 40)
    format_of("transport").write(replace(whole_stage(content), crop=box), tmp_path)
    assert json.loads((tmp_path / "transport.json").read_text())["crop"] == {"x": 12, "y": 5, "width": 28, "height": 12}
    frames = random_frames(transport, 3)
    theirs = sum(matrix @ frame_planes([frame]).ravel() for matrix, frame in zip(read(tmp_path), frames, strict=True))
    ours = transport.forward(frames)[box.window]
    np.testing.assert_allclose(np.moveaxis(theirs.reshape(3, 12, 28), 0, 2), ours, rtol=2e-5, atol=2e-6)
    with np.load(tmp_path / "black.npz", allow_pickle=False) as black:
        assert black["black"].shape == (12, 28, 3)


@pytest.mark.parametrize("box", [CameraBox(0, 0, 41, 10), CameraBox(5, 5, 5, 9), CameraBox(-1, 0, 4, 4)])
def test_a_crop_beyond_the_picture_is_refused(content: Content, tmp_path: Path, box: CameraBox) -> None:
    with pytest.raises(UsageError) as refused:
        format_of("transport").write(replace(content, crop=box), tmp_path)
    assert refused.value.code == "crop-outside"


def test_a_matrix_that_would_fill_the_memory_is_refused(
    content: Content, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sparse, "MOST_ENTRIES", 1000)
    with pytest.raises(UsageError) as refused:
        format_of("transport").write(content, tmp_path)
    assert refused.value.code == "transport-too-large"
    assert list(tmp_path.iterdir()) == []
