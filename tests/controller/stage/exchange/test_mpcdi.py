"""MPCDI files, read by the standard library, OpenCV and SciPy as the standard's public explanations say.

No reader of MPCDI is in the registries that the tests install from, so this one is written from those explanations.
"""

from __future__ import annotations

import math
import zipfile
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

import cv2
import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation

from controller.stage.exchange.content import Content
from controller.stage.exchange.formats import format_of
from tests.controller.stage.exchange.conftest import NAMES, opencv_bent, opencv_px

Floats = npt.NDArray[np.float64]


@dataclass
class Region:
    """One region with its files, as a media server has them."""

    xml: ElementTree.Element
    warp: Floats
    alpha: npt.NDArray[np.uint8]
    distortion: Floats | None

    @property
    def size(self) -> tuple[int, int]:
        return int(self.xml.attrib["xResolution"]), int(self.xml.attrib["yResolution"])

    def number(self, path: str) -> float:
        text = self.xml.findtext(path)
        assert text is not None
        return float(text)

    def ideal(self, points: Floats) -> Floats:
        """(n, 2): where points in the file's frame are in the frustum, 0 to 1 from the left and the top."""
        arrows = {
            name: np.array([self.number(f"coordinateFrame/{name}{axis}") for axis in "xyz"])
            for name in ("yaw", "pitch", "roll")
        }
        position = np.array([self.number(f"coordinateFrame/pos{axis}") for axis in "xyz"])
        # As of an aeroplane: x forward, y to the right, z down; about the turned axes: yaw, pitch, roll.
        body = (points - position) @ np.stack([arrows["roll"], arrows["pitch"], arrows["yaw"]]).T
        turned = Rotation.from_euler("ZYX", [self.number(f"frustum/{a}") for a in ("yaw", "pitch", "roll")], True)
        ahead, right, down = turned.inv().apply(body).T
        slope = {a: math.tan(math.radians(self.number(f"frustum/{a}Angle"))) for a in ("left", "right", "up", "down")}
        assert (ahead > 0).all()
        return np.stack(
            [(right / ahead - slope["left"]) / (slope["right"] - slope["left"]),
             (slope["up"] + down / ahead) / (slope["up"] - slope["down"])], axis=-1,
        )  # fmt: skip


def pfm(archive: zipfile.ZipFile, name: str) -> Floats:
    """By OpenCV, which knows that the rows of a PFM go from the bottom to the top; x, y, z."""
    image = cv2.imdecode(np.frombuffer(archive.read(name), np.uint8), cv2.IMREAD_UNCHANGED)
    assert image is not None
    assert image.dtype == np.float32
    return np.asarray(image[..., ::-1], np.float64)


def read(path: Path, profile: str) -> list[Region]:
    with zipfile.ZipFile(path) as archive:
        assert archive.testzip() is None
        root = ElementTree.fromstring(archive.read("mpcdi.xml"))
        assert root.tag == "MPCDI"
        assert (root.attrib["version"], root.attrib["profile"]) == ("2.0", profile)
        assert {"date", "geometry", "color"} <= set(root.attrib)
        (buffer,) = root.findall("display/buffer")
        regions = []
        for xml, files in zip(buffer.findall("region"), root.findall("files/fileset"), strict=True):
            assert files.attrib["region"] == xml.attrib["id"]
            name, more = files.findtext("geometryWarpFile/path"), files.findtext("distortionMap/path")
            alpha = cv2.imdecode(
                np.frombuffer(archive.read(files.findtext("alphaMap/path") or ""), np.uint8), cv2.IMREAD_UNCHANGED
            )
            assert name
            assert files.findtext("geometryWarpFile/interpolation") == "linear"
            if profile == "sl":
                assert files.findtext("geometryWarpFile/geometricUnit") == "m"
                assert files.findtext("geometryWarpFile/originof3DData") == "centerOfMass"
            distortion = None if more is None else pfm(archive, more)
            regions.append(Region(xml, pfm(archive, name), np.asarray(alpha, np.uint8), distortion))
    return regions


@pytest.fixture(scope="module")
def folder(content: Content, tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("mpcdi")
    assert format_of("mpcdi").write(content, made) == {"files": 3, "regions": 2}
    return made


@pytest.mark.parametrize("profile", ["2d", "3d", "sl"])
def test_each_projector_is_a_region_of_its_size_with_its_own_name(content: Content, folder: Path, profile: str) -> None:
    regions = read(folder / f"stage-{profile}.mpcdi", profile)
    assert [one.xml.attrib["id"] for one in regions] == list(NAMES)
    for one, own in zip(regions, content.geometry.projectors, strict=True):
        assert one.size == own.size_px
        assert one.warp.shape[1::-1] == one.alpha.shape[::-1] == own.size_px
        np.testing.assert_array_equal(one.alpha == 255, np.isfinite(one.warp[..., :2]).all(axis=2))
        assert set(np.unique(one.alpha)) <= {0, 255}


def test_a_picture_warped_by_the_2d_profile_is_that_of_each_pixels_place(content: Content, folder: Path) -> None:
    width, height = content.geometry.camera.size_px
    x, y = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    for one, metapixels in zip(read(folder / "stage-2d.mpcdi", "2d"), content.metapixels(), strict=True):
        known = np.isfinite(one.warp[..., :2]).all(axis=2)
        np.testing.assert_array_equal(known, metapixels.valid)
        at = (one.warp[..., :2] * (width, height) - 0.5).astype(np.float32)
        seen = np.stack([cv2.remap(image, at[..., 0], at[..., 1], cv2.INTER_LINEAR) for image in (x, y)], axis=-1)
        inside = known & (metapixels.centre_px < (width - 1, height - 1)).all(axis=2)
        # OpenCV interpolates in steps of 1/32 pixel
        np.testing.assert_allclose(seen[inside], metapixels.centre_px[inside], atol=0.02)


def test_the_3d_profile_names_the_camera_without_its_lens(content: Content, folder: Path) -> None:
    camera = content.geometry.camera
    for one, metapixels in zip(read(folder / "stage-3d.mpcdi", "3d"), content.metapixels(), strict=True):
        slope = {a: math.tan(math.radians(one.number(f"frustum/{a}Angle"))) for a in ("left", "right", "up", "down")}
        assert [one.number(f"frustum/{a}") for a in ("yaw", "pitch", "roll")] == [0, 0, 0]
        u, v = one.warp[metapixels.valid][:, 0], one.warp[metapixels.valid][:, 1]
        ray = np.stack([slope["left"] + u * (slope["right"] - slope["left"]),
                        -slope["up"] + v * (slope["up"] - slope["down"])], -1)  # fmt: skip
        np.testing.assert_allclose(opencv_bent(camera, ray), metapixels.centre_px[metapixels.valid], atol=1e-3)


def test_points_of_the_shader_lamp_profile_are_where_opencv_projects_them(content: Content, folder: Path) -> None:
    for one, own in zip(read(folder / "stage-sl.mpcdi", "sl"), content.geometry.projectors, strict=True):
        known = np.isfinite(one.warp).all(axis=2)
        assert known.sum() > 500
        points = one.warp[known]
        # the file's frame has y up
        theirs = opencv_px(own, (points * (1, -1, -1)).astype(np.float32))
        ideal = one.ideal(points) * one.size - 0.5
        ray = (ideal - own.matrix[:2, 2]) / own.matrix[(0, 1), (0, 1)]
        np.testing.assert_allclose(opencv_bent(own, ray), theirs, atol=1e-3)
        assert one.distortion is not None
        x, y = np.meshgrid(np.arange(one.size[0]), np.arange(one.size[1]))
        straight = one.distortion[..., :2] * one.size - 0.5
        ray = (straight - own.matrix[:2, 2]) / own.matrix[(0, 1), (0, 1)]
        np.testing.assert_allclose(opencv_bent(own, ray), np.stack([x, y], -1), atol=1e-3)


def test_the_readme_says_that_a_superimposed_solve_is_more_than_a_warp(folder: Path) -> None:
    assert "A superimposed solve is more than a warp" in (folder / "README.txt").read_text()


def test_the_same_calibration_gives_the_same_bytes(content: Content, folder: Path, tmp_path: Path) -> None:
    format_of("mpcdi").write(content, tmp_path)
    for profile in ("2d", "3d", "sl"):
        name = f"stage-{profile}.mpcdi"
        assert (tmp_path / name).read_bytes() == (folder / name).read_bytes()
