"""Before a lamp is struck: the outputs, the kind and the size of a photograph, and what a file should say."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np
import OpenEXR
import pytest

from controller.core.errors import VelaturaError
from controller.optics.calibrate.geometry.values import CameraPrior
from controller.optics.capture.raw import read_photograph, read_samples
from controller.run.journal import Journal
from controller.run.progress import Silent
from controller.run.runner import Runner
from controller.stage.steps.capture.camera import device_checks
from hal.deadline import Deadline, in_seconds
from hal.notices import Level
from hal.values import CapturedFile, FileKind
from plugins.emulated.optics.dng import PictureFacts, dng
from tests.controller.stage.rig.rig_model import ModelCamera, ModelRig

LINEAR = np.linspace(0, 1, 6 * 8 * 3, dtype=np.float32).reshape(6, 8, 3)


def file_of(kind: str, folder: Path, black: int = 0) -> bytes:
    """A photograph of 8 x 6 pixels."""
    path = folder / f"made{kind}"
    if kind == ".exr":
        header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
        OpenEXR.File(header, {"RGB": LINEAR}).write(str(path))
    elif kind == ".dng":
        facts = PictureFacts(1.0, 100, 8.0, 50.0, "2026:01:01 12:00:00", "1")
        return dng(np.full((48, 64), 300, np.uint16), black_level=black, white_level=4095, facts=facts)
    else:
        stored = np.rint(LINEAR * 65535).astype(np.uint16) if kind == ".tif" else np.rint(LINEAR * 255).astype(np.uint8)
        assert cv2.imwrite(str(path), stored[..., ::-1])
    return path.read_bytes()


@dataclass
class FileCamera(ModelCamera):
    """Every picture is this file."""

    suffix: str = ".tif"
    data: bytes = b""

    def capture(self, destination: Path, *, deadline: Deadline) -> list[CapturedFile]:
        self.taken.append(destination.name)
        destination.parent.mkdir(parents=True, exist_ok=True)
        path = destination.parent / (destination.name + self.suffix)
        path.write_bytes(self.data)
        kind = FileKind.JPEG if self.suffix == ".jpg" else FileKind.RAW
        return [CapturedFile(path, kind, len(self.data), hashlib.sha256(self.data).hexdigest())]


@dataclass
class Heard(Silent):
    said: list[tuple[str, Level]] = field(default_factory=list)

    def say(self, text: str, level: Level = Level.INFO) -> None:
        self.said.append((text, level))


def checked(rig: ModelRig, *, size_px: tuple[int, int] | None = None) -> list[str]:
    """Run the checks; the warnings."""
    heard = Heard()
    with Journal(rig.folder) as journal:
        steps = device_checks(rig.rig, CameraPrior(1000.0, size_px=size_px))
        Runner(steps, journal, reporter=heard).run("calibrate", deadline=in_seconds(60))
    assert not list(rig.folder.rglob("device-checks*")), "the photograph is deleted"
    return [text for text, level in heard.said if level is Level.WARNING]


def rig_with(folder: Path, suffix: str) -> ModelRig:
    return ModelRig(folder, camera=FileCamera(suffix=suffix, data=file_of(suffix, folder)))


@pytest.mark.parametrize("suffix", [".tif", ".exr", ".jpg"])
def test_every_accepted_file_passes_where_the_sizes_agree(tmp_path: Path, suffix: str) -> None:
    assert checked(rig_with(tmp_path, suffix), size_px=(8, 6)) == []


@pytest.mark.parametrize("suffix", [".tif", ".exr"])
def test_linear_files_are_read_as_they_are(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"a{suffix}"
    path.write_bytes(file_of(suffix, tmp_path))
    photograph = read_photograph(path)
    np.testing.assert_allclose(photograph.image, LINEAR, atol=1e-5)
    assert photograph.saturated.sum() == (suffix == ".tif"), "a TIFF's largest number is saturated"
    assert (photograph.camera_to_xyz, photograph.colours) == (None, None)
    np.testing.assert_array_equal(read_samples(path)[0], photograph.image)


def test_a_tiff_of_8_bits_is_refused_by_name(tmp_path: Path) -> None:
    assert cv2.imwrite(str(tmp_path / "a.tif"), np.zeros((4, 4, 3), np.uint8))
    with pytest.raises(VelaturaError, match="16 bits") as caught:
        read_photograph(tmp_path / "a.tif")
    assert caught.value.code == "photograph-unreadable"


def test_a_raw_file_without_black_level_gives_a_warning(tmp_path: Path) -> None:
    warnings = checked(rig_with(tmp_path, ".dng"))
    assert len(warnings) == 1
    assert "no black level" in warnings[0]
    said = FileCamera(suffix=".dng", data=file_of(".dng", tmp_path, black=256))
    assert checked(ModelRig(tmp_path / "other", camera=said)) == []


def test_a_lens_file_for_other_pictures_is_refused(tmp_path: Path) -> None:
    with pytest.raises(VelaturaError) as caught:
        checked(rig_with(tmp_path, ".tif"), size_px=(16, 6))
    assert caught.value.code == "camera-intrinsics-wrong-size"


def test_an_output_of_another_size_is_refused_before_anything_is_shown_or_photographed(tmp_path: Path) -> None:
    rig = rig_with(tmp_path, ".tif")
    projectors = (replace(rig.rig.projectors[0], size_px=(40, 30)), rig.rig.projectors[1])
    rig.rig = replace(rig.rig, projectors=projectors)
    with pytest.raises(VelaturaError, match="P1 has 40 x 30") as caught:
        checked(rig)
    assert caught.value.code == "display-outputs-differ"
    assert (rig.display.shown, rig.camera.taken) == ([], [])


def test_a_file_of_no_known_kind_is_named(tmp_path: Path) -> None:
    rig = ModelRig(tmp_path, camera=FileCamera(suffix=".dng", data=b"not a photograph"))
    with pytest.raises(VelaturaError) as caught:
        checked(rig)
    assert caught.value.code == "photograph-unreadable"
