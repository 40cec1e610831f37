"""Picture files that stage.toml names, and the colours that it says they have."""

from __future__ import annotations

import io
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from PIL import Image, ImageCms
from scipy import ndimage

from controller.core.arrays import FloatImage, load_arrays, save_arrays
from controller.core.errors import CalibrationError, UsageError
from controller.kiosk.store.targets import on_object
from controller.optics.calibrate.geometry.shape import FoundShape
from controller.optics.calibrate.mesh_alignment import Pose
from controller.optics.solve.targets.files import read_large_picture, read_picture
from controller.run.journal import Journal
from controller.stage.artefacts.calibrated import Calibrated
from controller.stage.artefacts.geometry import write_geometry
from controller.stage.artefacts.kinds import CALIBRATED
from controller.stage.artefacts.mesh import RegisteredMesh
from controller.stage.artefacts.solved import Registered
from controller.stage.services.export import export
from controller.stage.steps.appearance.requests import make_target, requests_of
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


@pytest.mark.parametrize("kind", ["photograph", "pattern", "checkerboard", "gloss", "blender"])
def test_what_needs_a_shape_says_so_by_name_before_anything_is_computed(
    tmp_path: Path, calibrated: Calibrated, kind: str
) -> None:
    asked = '\n[object]\nshape = "unknown"\n'
    table = PICTURE.replace("KIND", kind).replace(
        'file = "t.png"\n', "" if kind != "photograph" else 'file = "t.png"\n'
    )
    flat = CalibrationError("one-projector", what="One is not enough.", remedy="Use two.")
    write_geometry(calibrated.folder, ("left", "right"), FoundShape("unknown", CAMERA[::-1], why=flat))
    not_yet = Calibrated(tmp_path / "next", ("left", "right"))
    for stage, at, remedy in ((STAGE, calibrated, "Use two."), (STAGE + asked, not_yet, "Set shape under")):
        with pytest.raises(UsageError, match=f"appearance x of kind {kind} needs the shape") as refused:
            requests_of(load(tmp_path, stage + table), at)
        assert refused.value.code == "shape-unknown"
        assert refused.value.remedy.startswith(remedy)
    assert requests_of(load(tmp_path, STAGE + asked + PICTURE.replace("KIND", "picture")), calibrated)


@pytest.mark.parametrize("kind", ["glb", "ply", "blender", "usd", "colmap", "opencv", "mpcdi"])
def test_an_export_of_a_shape_that_is_unknown_is_refused_by_name(calibrated: Calibrated, kind: str) -> None:
    write_geometry(calibrated.folder, ("left", "right"), FoundShape("unknown", CAMERA[::-1]))
    with pytest.raises(UsageError, match=f"format {kind} needs the shape") as refused:
        export(run=calibrated.folder, kind=kind, out=None, step=None)
    assert refused.value.code == "shape-unknown"
    assert export(run=calibrated.folder, kind="st-maps", out=None, step=None)["maps"]


def lay_wall(run: Path, *, uv: bool = True) -> None:
    """The wall of ``write_run``, 1 m before the camera, as a registered mesh whose sheet is 2 m wide and 1.5 m high."""
    corners = np.array([[-1, 0.75, 0], [1, 0.75, 0], [1, -0.75, 0], [-1, -0.75, 0]], np.float64)
    faces, places = np.array([[0, 1, 2], [0, 2, 3]], np.int32), np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32)
    pose = Pose(1.0, np.eye(3), np.array([0.0, 0.0, 1.0]))
    facts = {"sha256": "0", "sheet_px": [80, 60]}
    arrays: dict[str, npt.NDArray[Any]] = {"vertices": corners, "faces": faces}
    arrays |= {"uv": places[faces]} if uv else {}
    RegisteredMesh(arrays, pose, facts).write(run)


def painted(folder: Path, sheet: npt.NDArray[np.uint8]) -> None:
    Image.fromarray(sheet).save(folder / "t.png")


def half_red(folder: Path) -> None:
    """A sheet whose left half is red, and whose right half is clear."""
    sheet = np.zeros((600, 800, 4), np.uint8)
    sheet[:, :400] = (255, 0, 0, 255)
    painted(folder, sheet)


TEXTURE = PICTURE.replace("KIND", "texture")


def test_a_sheet_lies_on_the_mesh_and_leaves_the_object_where_it_is_clear(
    tmp_path: Path, calibrated: Calibrated
) -> None:
    lay_wall(calibrated.folder)
    half_red(tmp_path)
    request = requests_of(load(tmp_path, STAGE + TEXTURE), calibrated)[0]
    target = request.target()
    np.testing.assert_array_equal(target.mask, calibrated.transport.object_mask)
    left, right = target.mask.copy(), target.mask.copy()
    left[:, 37:], right[:, :43] = False, False
    np.testing.assert_allclose(target.image[left], np.broadcast_to((1, 0, 0), (left.sum(), 3)), atol=1e-5)
    as_it_is = recolour_white(tmp_path, calibrated)
    np.testing.assert_allclose(target.image[right], as_it_is[right], atol=1e-4)


def test_where_no_camera_sees_a_projector_shows_what_lies_there_on_the_mesh(
    tmp_path: Path, calibrated: Calibrated
) -> None:
    lay_wall(calibrated.folder)
    half_red(tmp_path)
    found = requests_of(load(tmp_path, STAGE + TEXTURE), calibrated)[0].sheet
    assert found is not None
    for n, own in enumerate(calibrated.geometry.projectors):
        width, height = own.size_px
        at = np.argwhere(np.ones((height, width)))[:, ::-1]
        ways = np.column_stack([at, np.ones(len(at))]) @ np.linalg.inv(own.matrix).T @ own.rotation
        start = -own.rotation.T @ own.translation_m
        x = (start[0] + (1 - start[2]) / ways[:, 2] * ways[:, 0]).reshape(height, width)
        colours = found(n, np.ones((height, width), np.bool_))
        red, clear = (x > -0.9) & (x < -0.05), x > 0.05
        np.testing.assert_allclose(colours[red], np.broadcast_to((1, 0, 0), (red.sum(), 3)), atol=1e-4)
        assert np.isnan(colours[clear]).all(), "the object's own paint is not on the sheet"
        assert red.any()
    camera = requests_of(load(tmp_path, STAGE + TEXTURE + 'uv = "camera"\n'), calibrated)[0]
    assert camera.sheet is None, "the camera's picture has nothing of what it does not see"


def recolour_white(folder: Path, calibrated: Calibrated) -> FloatImage:
    text = STAGE + '\n[[appearances]]\nname = "x"\nkind = "recolour"\ntint = [1.0, 1.0, 1.0]\n'
    return requests_of(load(folder, text), calibrated)[0].target().image


def test_a_sheet_that_does_not_fit_is_refused_before_anything_is_solved(tmp_path: Path, calibrated: Calibrated) -> None:
    def code(settings: str = "") -> str:
        with pytest.raises(UsageError) as refused:
            requests_of(load(tmp_path, STAGE + TEXTURE + settings), calibrated)
        return refused.value.code

    painted(tmp_path, np.full((60, 60, 3), 200, np.uint8))
    assert code() == "mesh-not-registered"
    assert code('uv = "camera"\n') == "sheet-wrong-shape"
    lay_wall(calibrated.folder)
    assert code() == "sheet-wrong-shape"
    lay_wall(calibrated.folder, uv=False)
    assert code() == "mesh-without-uv"
    painted(tmp_path, np.full((90, 120, 3), 200, np.uint8))
    assert requests_of(load(tmp_path, STAGE + TEXTURE + 'uv = "camera"\n'), calibrated)


@pytest.mark.parametrize("uv", ["mesh", "camera"])
def test_an_exported_sheet_that_nobody_painted_on_leaves_the_object_as_it_is(
    tmp_path: Path, calibrated: Calibrated, uv: str
) -> None:
    if uv == "mesh":
        lay_wall(calibrated.folder)
    (tmp_path / "t.png").unlink()
    figures = export(run=calibrated.folder, kind="uv", out=tmp_path / "t.png", step=None)
    assert figures["uv"] == uv
    with Image.open(tmp_path / "t.png") as sheet:
        assert sheet.mode == "RGBA"
        assert list(sheet.size) == figures["size_px"]
        assert "sRGB" in ImageCms.getProfileName(ImageCms.ImageCmsProfile(io.BytesIO(sheet.info["icc_profile"])))
    target = requests_of(load(tmp_path, STAGE + TEXTURE + f'uv = "{uv}"\n'), calibrated)[0].target()
    inside = ndimage.binary_erosion(target.mask, iterations=4)
    as_it_is = recolour_white(tmp_path, calibrated)
    assert np.abs(target.image - as_it_is)[inside].mean() < 0.02
    with pytest.raises(UsageError) as refused:
        export(run=calibrated.folder, kind="uv", out=tmp_path / "t.png", step=None)
    assert refused.value.code == "sheet-exists", "somebody may have painted on it"


RESTORATION = PICTURE.replace("KIND", "restoration")
CORNERS = "points = [[2, 2, 5.0, 5.0], [77, 2, 70.0, 5.0], [77, 57, 70.0, 50.0], [2, 57, 5.0, 50.0]]\n"


def test_a_restoration_is_laid_by_points_at_the_light_that_is_asked_for(tmp_path: Path, calibrated: Calibrated) -> None:
    light = "brightness = 0.25\n"
    wish = requests_of(load(tmp_path, STAGE + RESTORATION + CORNERS + light), calibrated)[0]
    target = wish.target()
    assert target.image.shape == (*CAMERA, 3)
    assert target.mask[10:45, 10:65].all()
    assert not target.mask[:3].any()
    assert target.exposure is not None
    white = calibrated.transport.reach().mean(axis=2) / calibrated.reflectance.mean(axis=2)
    assert target.exposure == pytest.approx(0.25 * float(np.median(white)), rel=1e-3)
    assert wish.prepare is not None
    said: list[str] = []
    context = SimpleNamespace(folder=calibrated.folder, reporter=SimpleNamespace(say=said.append))
    wish.prepare(context)  # type: ignore[arg-type]
    (text,) = said
    assert "by its points alone" in text
    assert "At the light that is asked for" in text
    kept = Registered.read(calibrated.folder, "x")
    assert kept is not None
    assert kept.figures["share"] <= kept.figures["then_share"] <= 1


def test_what_lies_beside_the_planes_of_one_projector_stays_as_it_is(tmp_path: Path, calibrated: Calibrated) -> None:
    stage = load(tmp_path, STAGE + RESTORATION + CORNERS + 'outside = "as-is"\n')
    whole = requests_of(stage, Calibrated(calibrated.folder, ("left",)))[0].target()
    arrays = load_arrays(calibrated.folder / "geometry.npz")
    frame = np.zeros(CAMERA, np.bool_)
    frame[20:40, :4] = True
    arrays["points_m"][frame] = arrays["normals"][frame] = np.nan
    save_arrays(calibrated.folder / "geometry.npz", arrays)
    target = requests_of(stage, Calibrated(calibrated.folder, ("left",)))[0].target()
    assert target.mask[frame].all()
    assert whole.image[frame].min() > 0.05
    np.testing.assert_allclose(target.image[frame], whole.image[frame], rtol=0.15)


@pytest.mark.parametrize(
    ("written", "code"),
    [
        ("", "restoration-not-matched"),
        ("points = [[2, 2, 5.0, 5.0]]\n", "restoration-points"),
        ("points = [[2, 2, 5.0]]\n", "stage-key-type"),
        ('outside = "blue"\n', "stage-key-type"),
        ("lux = 50.0\n", "restoration-light"),
    ],
)
def test_a_restoration_that_cannot_be_is_refused_before_anything_is_solved(
    tmp_path: Path, calibrated: Calibrated, written: str, code: str
) -> None:
    with pytest.raises(UsageError) as refused:
        requests_of(load(tmp_path, STAGE + RESTORATION + written), calibrated)
    assert refused.value.code == code


def test_the_light_of_a_large_picture_is_averaged_not_its_numbers(tmp_path: Path) -> None:
    fine = np.zeros((400, 600, 3), np.uint8)
    fine[::2, ::2] = fine[1::2, 1::2] = 255
    Image.fromarray(fine).save(tmp_path / "t.png")
    light, by = read_large_picture(tmp_path / "t.png", None, (60, 40))
    assert by == 10
    assert light.shape == (40, 60, 3)
    np.testing.assert_allclose(light, 0.5, atol=1e-4)


def test_a_restoration_that_a_page_asks_for_is_refused_by_the_same_name(tmp_path: Path, calibrated: Calibrated) -> None:
    with pytest.raises(UsageError) as refused:
        make_target("restoration", tmp_path / "t.png", {}, calibrated)
    assert refused.value.code == "restoration-not-matched"


def test_points_of_a_page_are_shares_of_both_pictures(tmp_path: Path) -> None:
    run = tmp_path / "runs" / "20260101-000000-calibrate"
    write_run(run)
    with Journal(run) as journal:
        journal.complete(CALIBRATED, {}, [], began_at_s=0)
    Image.fromarray(np.full((30, 90, 3), 200, np.uint8)).save(tmp_path / "t.png")
    points = "[[0, 0, 0.25, 0.2], [1, 0, 0.75, 0.2], [1, 1, 0.75, 0.9], [0, 1, 0.25, 0.9]]"
    with Image.open(
        io.BytesIO(on_object(tmp_path, ("left", "right"), tmp_path / "t.png", "restoration", points))
    ) as made:
        assert made.size == CAMERA[::-1]
        box = made.getchannel("A").getbbox() or (0, 0, 0, 0)
    assert list(box) == pytest.approx([20, 12, 60, 54], abs=2)
    for wrong in ("[[0, 0, 1]]", "{}", "[" * 9000):
        with pytest.raises(UsageError) as refused:
            on_object(tmp_path, ("left", "right"), tmp_path / "t.png", "restoration", wrong)
        assert refused.value.code == "restoration-points"
