"""Appearances that can't be made, on a calibrated stage: reported within a second, nothing solved or published."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import numpy as np
import OpenEXR
import pytest

from tests.end_to_end.conftest import FinishedDemo
from tests.end_to_end.kiosk import copied
from tests.end_to_end.program import asked, run_of, velatura

pytestmark = [pytest.mark.long, pytest.mark.timeout(1200)]
CAMERA_PX = (776, 520)


@pytest.fixture(scope="module")
def calibrated(finished_demo: FinishedDemo, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the finished demo's stage with pictures of all sorts beside it."""
    stage = copied(finished_demo.stage, tmp_path_factory.mktemp("calibrated") / "stage")
    width, height = CAMERA_PX
    light = np.full((height, width, 3), 0.3, np.float32)
    light[100:110, 100:120, 1] = np.nan
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(header, {"RGB": light}).write(str(stage / "nan.exr"))
    (stage / "small.png").write_bytes(grey_png(77, 52))
    (stage / "letter.png").write_text("Dear reader,")
    (stage / "cut.png").write_bytes(grey_png(width, height)[:-20])
    return stage


def grey_png(width: int, height: int) -> bytes:
    """Written from the specification (PNG, third edition, 11.2), so that no library of ours is asked about itself."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    rows = zlib.compress((b"\0" + bytes([128] * 3 * width)) * height)
    head = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", rows) + chunk(b"IEND", b"")


WRONG = {
    "another size": ('kind = "picture"\nfile = "small.png"', "target-wrong-size", "77 x 52"),
    "not finite": ('kind = "picture"\nfile = "nan.exr"', "target-not-finite", "200 pixels"),
    "a photograph that is not finite": ('kind = "photograph"\nfile = "nan.exr"', "target-not-finite", "200 pixels"),
    "no picture at all": ('kind = "picture"\nfile = "letter.png"', "target-unreadable", "letter.png"),
    "cut short": ('kind = "picture"\nfile = "cut.png"', "target-unreadable", "its end is missing"),
    "a folder": ('kind = "picture"\nfile = "bench"', "target-missing", "bench"),
    "not there": ('kind = "picture"\nfile = "nowhere.exr"', "target-missing", "nowhere.exr"),
    "no file named": ('kind = "picture"', "stage-key-missing", "'file'"),
    "unknown kind": ('kind = "glass"', "stage-key-value", "'glass' is not a kind"),
    "unknown setting": ('kind = "checkerboard"\nsquare = 0.1', "stage-key-unknown", "did you mean 'square_m'"),
    "setting of a wrong type": ('kind = "recolour"\ntint = "red"', "stage-key-type", "'tint' = 'red'"),
    "too short a list": ('kind = "recolour"\ntint = [1, 0.5]', "stage-key-type", "'tint'"),
    "not a number": ('kind = "gloss"\nshininess = nan', "stage-key-", "'shininess'"),
    "missing setting": ('kind = "recolour"', "stage-key-missing", "'tint'"),
}


@pytest.mark.parametrize("name", WRONG)
def test_a_target_that_can_not_be_made_is_told_before_anything_is_solved(calibrated: Path, name: str) -> None:
    table, code, says = WRONG[name]
    toml = calibrated / "stage.toml"
    before = toml.read_text(), asked(run_of(calibrated), "SELECT * FROM steps"), installed(calibrated)
    try:
        toml.write_text(f'{before[0]}\n[[appearances]]\nname = "x"\n{table}\n')
        outcome = velatura("appearance", calibrated)
    finally:
        toml.write_text(before[0])
    assert outcome.code == 2
    assert outcome.error["code"].startswith(code)
    assert says in outcome.error["what"]
    assert (toml.read_text(), asked(run_of(calibrated), "SELECT * FROM steps"), installed(calibrated)) == before


def test_a_name_that_stage_toml_does_not_have_is_told_with_those_it_has(calibrated: Path) -> None:
    outcome = velatura("appearance", calibrated, "glos")
    assert (outcome.code, outcome.error["code"]) == (2, "appearance-unknown")
    assert "photograph, new-pattern, checkerboard, gloss" in outcome.error["remedy"]


def installed(stage: Path) -> list[str]:
    return sorted(path.name for path in (stage / "bundles").iterdir())
