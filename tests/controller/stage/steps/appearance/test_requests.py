"""Picture files that stage.toml names, and the colours that it says they have."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from controller.core.errors import UsageError
from controller.optics.solve.targets.files import read_picture
from controller.stage.artefacts.calibrated import Calibrated
from controller.stage.steps.appearance.requests import requests_of
from tests.controller.config.test_stage_file import STAGE, load
from tests.docs.synthetic_data import CAMERA, write_run

PICTURE = '\n[[appearances]]\nname = "x"\nkind = "KIND"\nfile = "t.png"\n'


@pytest.fixture
def calibrated(tmp_path: Path) -> Calibrated:
    write_run(tmp_path / "run")
    picture = np.random.default_rng(1).integers(0, 256, (*CAMERA, 3), dtype=np.uint8)
    Image.fromarray(picture).save(tmp_path / "t.png")
    return Calibrated(tmp_path / "run", ("left", "right"))


def test_a_picture_is_read_in_the_space_that_the_stage_names(tmp_path: Path, calibrated: Calibrated) -> None:
    text = STAGE + PICTURE.replace("KIND", "picture")
    plain = requests_of(load(tmp_path, text), calibrated)[0]
    wide = requests_of(load(tmp_path, text + 'colour = "display-p3"\n'), calibrated)[0]
    for wish, colour in ((plain, None), (wide, "display-p3")):
        light = read_picture(tmp_path / "t.png", colour)  # type: ignore[arg-type]
        np.testing.assert_array_equal(wish.target().image, np.maximum(light, 0))
    assert plain.inputs != wide.inputs, "another space is another target"
    assert np.abs(plain.target().image - wide.target().image).max() > 0.05


def test_a_photograph_is_wrapped_in_the_space_that_the_stage_names(tmp_path: Path, calibrated: Calibrated) -> None:
    text = STAGE + PICTURE.replace("KIND", "photograph") + 'mapping = "plane"\n'
    plain = requests_of(load(tmp_path, text), calibrated)[0].target()
    wide = requests_of(load(tmp_path, text + 'colour = "rec2020"\n'), calibrated)[0].target()
    assert np.isfinite(wide.image).all()
    assert np.abs(plain.image - wide.image).max() > 0.02


@pytest.mark.parametrize(("colour", "code"), [("adobe", "stage-key-type"), ("acescg", "target-unreadable")])
def test_a_space_that_does_not_fit_is_refused_before_anything_is_solved(
    tmp_path: Path, calibrated: Calibrated, colour: str, code: str
) -> None:
    text = STAGE + PICTURE.replace("KIND", "picture") + f'colour = "{colour}"\n'
    with pytest.raises(UsageError) as refused:
        requests_of(load(tmp_path, text), calibrated)
    assert refused.value.code == code
