"""``velatura live`` on a calibrated stage, through the real player into its memory output."""

from __future__ import annotations

import contextlib
import tomllib
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import OpenEXR
import pytest

from controller.bundle.live_maps import LiveMaps, compensate
from controller.play.frames import FrameFile, OutputSize
from controller.stage.artefacts.calibrated import Calibrated
from controller.stage.steps.appearance.live_parts import live_maps
from hal.values import Power
from tests.controller.play.wire import Frames
from tests.end_to_end.conftest import FinishedDemo
from tests.end_to_end.kiosk import copied
from tests.end_to_end.program import Bench, Command, lamps, powers, processes_on, strikes, velatura, wrong_code
from tests.waiting import eventually

pytestmark = [pytest.mark.long, pytest.mark.timeout(1200)]
CAMERA_PX = (776, 520)
Image = npt.NDArray[np.uint8]


@pytest.fixture(scope="module")
def stage(finished_demo: FinishedDemo, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return copied(finished_demo.stage, tmp_path_factory.mktemp("live") / "stage")


def picture(seed: int) -> Image:
    """Coloured waves, sRGB, as large as the camera's picture."""
    y, x = np.mgrid[0 : CAMERA_PX[1], 0 : CAMERA_PX[0]] / 90.0
    waves = [0.5 + 0.4 * np.sin((seed + 1) * x + c) * np.cos(y - seed * c) for c in range(3)]
    return np.asarray(np.rint(255 * np.stack(waves, -1)), np.uint8)


def write(folder: Path, name: str, pixels: Image) -> None:
    """Under another name first, as docs/how-to/live-targets.md asks of a writer that can."""
    assert cv2.imwrite(str(folder / f"new-{name}"), np.ascontiguousarray(pixels[..., ::-1]))
    (folder / f"new-{name}").rename(folder / "pictures" / name)


def maps_of(stage: Path) -> LiveMaps:
    tables = tomllib.loads((stage / "stage.toml").read_text())["projectors"]
    outputs = {table["name"]: table["output"] for table in tables}
    (run,) = (stage / "runs").glob("*-demo")
    return live_maps(Calibrated(run, tuple(outputs)), outputs)


def shows(stage: Path, maps: LiveMaps, target: Image, white: float) -> Callable[[], bool]:
    """Whether the memory output has the frames of the reference, as far as the processor's way is exact."""
    wanted = compensate(maps, target, white)

    def asked() -> bool:
        found = Frames(stage / "run" / "outputs.frame").read()
        away = [
            np.abs(found[o.name].astype(int) - frame)[o.shape[..., 0] > 0].mean()
            for o, frame in zip(maps.outputs, wanted, strict=True)
        ]
        # 8-bit shares of 4 x 4 blocks are 0.15 away, another picture 20.
        return bool(max(away) < 0.5)

    return asked


def test_pictures_are_shown_as_they_come_until_ctrl_c_leaves_lamps_safe_and_black(stage: Path, tmp_path: Path) -> None:
    (tmp_path / "pictures").mkdir()
    write(tmp_path, "0001.png", picture(1))
    with Bench(stage), Command("live", stage, tmp_path / "pictures") as live:
        live.wait_for("Live: pictures")
        (white,) = (
            float(record["message"]["text"].split()[-1].rstrip("."))
            for record in live.records
            if record.get("message", {}).get("text", "").startswith("White of a target")
        )
        maps = maps_of(stage)
        assert eventually(shows(stage, maps, picture(1), white))
        assert set(lamps(stage).values()) == {True}
        # a target that is no number is passed over: the last good one stays
        light = np.full((*CAMERA_PX[::-1], 3), 0.3, np.float32)
        light[100, 100, 1] = np.nan
        header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
        OpenEXR.File(header, {"RGB": light}).write(str(tmp_path / "pictures" / "0002.exr"))
        assert eventually(lambda: any("1 bad" in str(record) for record in live.records))
        assert shows(stage, maps, picture(1), white)()
        write(tmp_path, "0003.png", picture(3))
        assert eventually(shows(stage, maps, picture(3), white))
        stopped = live.interrupt()
        assert stopped.code == 130
        assert not any(image.any() for image in Frames(stage / "run" / "outputs.frame").read().values())
        assert set(lamps(stage).values()) == {False}
        assert set(powers(stage).values()) <= {Power.COOLING, Power.OFF}
    assert processes_on(stage) == []


def test_a_video_is_decoded_for_a_player_elsewhere(stage: Path, tmp_path: Path) -> None:
    writer = cv2.VideoWriter(str(tmp_path / "v.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 25.0, (388, 260))
    for grey in range(40, 140, 4):
        writer.write(np.full((260, 388, 3), grey, np.uint8))
    writer.release()
    outcome = velatura("live", stage, tmp_path / "v.avi", "--into", tmp_path / "live.frame", "--targets")
    assert outcome.code == 0
    assert outcome.result["made"] + outcome.result["late"] == 25
    assert (outcome.result["bad"], outcome.result["white"] > 0) == (0, True)
    (target,) = Frames(tmp_path / "live.frame").read().values()
    assert target.shape == (*CAMERA_PX[::-1], 3)
    assert abs(int(target.min()) - 136) <= 3
    assert abs(int(target.max()) - 136) <= 3


def test_a_source_that_does_not_fit_is_refused_before_a_lamp_is_struck(stage: Path, tmp_path: Path) -> None:
    before = strikes(stage)
    with contextlib.closing(FrameFile(tmp_path / "render", [OutputSize("target", 388, 260)])):
        refused = velatura("live", stage, tmp_path / "render")
    assert wrong_code(refused) == "live-file-unfit"
    assert "target 388x260" in refused.error["what"]
    assert "target 776x520" in refused.error["remedy"]
    (tmp_path / "text.mp4").write_text("Dear viewer,")
    assert wrong_code(velatura("live", stage, tmp_path / "text.mp4")) == "live-source-unreadable"
    assert strikes(stage) == before
