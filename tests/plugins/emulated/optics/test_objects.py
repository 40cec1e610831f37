"""Objects on the stage: the project's own, and any mesh that a person brings."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh

from hal.errors import DeviceError
from plugins.emulated.optics.objects import HEIGHT_M, WIDTH_M, StageObject, default_object, load_object
from plugins.emulated.optics.shapes import Surface, bust

PYRAMID = """
v 0 0 0
v 10 0 0
v 10 0 10
v 0 0 10
v 5 20 5
vt 0 0
vt 1 0
vt 0.5 1
{material}
f 1/1 2/2 5/3
f 2/1 3/2 5/3
f 3/1 4/2 5/3
f 4/1 1/2 5/3
"""


def middle_albedo(stage_object: StageObject, face: int) -> np.ndarray[tuple[int], np.dtype[np.float32]]:
    """Albedo in the middle of a face."""
    point = stage_object.vertices[stage_object.faces[face]].mean(axis=0, dtype=np.float64)[None]
    weights = np.full((1, 3), 1 / 3, np.float32)
    found = stage_object.albedo(point, np.array([face], np.int32), weights)[0]
    return np.asarray(found, np.float32).reshape(3)


def test_the_default_object_fills_the_stage_and_has_many_colours_of_middling_brightness(
    vase_and_bust: StageObject,
) -> None:
    extent = np.ptp(vase_and_bust.vertices, axis=0)
    assert extent[1] == pytest.approx(HEIGHT_M, rel=0.03)
    faces = np.arange(0, len(vase_and_bust.faces), 50, dtype=np.int32)
    points = vase_and_bust.vertices[vase_and_bust.faces[faces]].mean(axis=1, dtype=np.float64)
    albedo = vase_and_bust.albedo(points, faces, np.full((len(faces), 3), 1 / 3, np.float32))
    assert albedo.min() >= 0.25
    assert albedo.max() <= 0.85
    assert len(np.unique(np.round(albedo * 8).astype(int), axis=0)) > 20


def test_the_default_object_faces_outwards(vase_and_bust: StageObject) -> None:
    mesh = trimesh.Trimesh(vase_and_bust.vertices, vase_and_bust.faces, process=False)
    assert all(part.volume > 1e-4 for part in mesh.split(only_watertight=False))


def test_any_mesh_is_scaled_to_the_stage_and_stands_upright(tmp_path: Path) -> None:
    path = tmp_path / "pyramid.obj"
    path.write_text(PYRAMID.format(material=""))
    stage_object = load_object(path)
    assert np.ptp(stage_object.vertices[:, 1]) == pytest.approx(HEIGHT_M, rel=1e-5)
    assert np.ptp(stage_object.vertices[:, 0]) <= WIDTH_M
    apex = stage_object.vertices[np.argmin(stage_object.vertices[:, 1])]
    np.testing.assert_allclose(apex, (0.0, -HEIGHT_M / 2, 0.0), atol=1e-6)
    assert 0.2 < middle_albedo(stage_object, 0).mean() < 0.9


def test_a_flat_sided_mesh_is_shaded_flat(tmp_path: Path) -> None:
    trimesh.creation.box((1, 1, 1)).export(tmp_path / "box.ply")
    stage_object = load_object(tmp_path / "box.ply")
    np.testing.assert_allclose(np.abs(stage_object.normals).max(axis=2), 1.0, atol=1e-6)


def test_a_textured_mesh_keeps_its_texture(tmp_path: Path) -> None:
    from PIL import Image

    pixels = np.full((8, 8, 3), 188, np.uint8)
    pixels[:, :, 2] = 60
    Image.fromarray(pixels).save(tmp_path / "skin.png")
    (tmp_path / "skin.mtl").write_text("newmtl skin\nmap_Kd skin.png\n")
    (tmp_path / "pyramid.obj").write_text("mtllib skin.mtl\n" + PYRAMID.format(material="usemtl skin"))
    albedo = middle_albedo(load_object(tmp_path / "pyramid.obj"), 0)
    np.testing.assert_allclose(albedo, [0.503, 0.503, 0.05], atol=0.01)


def test_a_mesh_with_coloured_corners_keeps_them(tmp_path: Path) -> None:
    mesh = trimesh.creation.box((1, 1, 1))
    mesh.visual.vertex_colors = np.tile([188, 137, 99, 255], (8, 1)).astype(np.uint8)
    mesh.export(tmp_path / "box.ply")
    np.testing.assert_allclose(middle_albedo(load_object(tmp_path / "box.ply"), 3), [0.503, 0.25, 0.125], atol=0.01)


def test_a_stored_object_comes_back_the_same(tmp_path: Path) -> None:
    (tmp_path / "pyramid.obj").write_text(PYRAMID.format(material=""))
    stage_object = load_object(tmp_path / "pyramid.obj")
    stage_object.save(tmp_path / "bench" / "object.npz")
    again = StageObject.read(tmp_path / "bench" / "object.npz")
    assert again.paint == stage_object.paint
    np.testing.assert_array_equal(again.normals, stage_object.normals)


PLY_POINTS = """ply
format ascii 1.0
element vertex 3
property float x
property float y
property float z
end_header
0 0 0
1 0 0
0 1 0
"""


@pytest.mark.parametrize(("name", "content"), [("cloud.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\n"), ("cloud.ply", PLY_POINTS)])
def test_points_without_faces_are_refused(tmp_path: Path, name: str, content: str) -> None:
    (tmp_path / name).write_text(content)
    with pytest.raises(DeviceError) as refused:
        load_object(tmp_path / name)
    assert refused.value.code == "object-no-faces"
    assert name in refused.value.what


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("absent.obj", None),
        ("text.ply", b"this is no mesh"),
        ("what.xyzzy", b"v 0 0 0"),
        ("far.obj", b"v 0 0 0\nv 1 0 0\nv nan 1 0\nf 1 2 3\n"),
    ],
)
def test_what_is_no_mesh_is_refused(tmp_path: Path, name: str, content: bytes | None) -> None:
    if content is not None:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(DeviceError) as refused:
        load_object(tmp_path / name)
    assert refused.value.code == "object-unreadable"
    assert refused.value.remedy


def test_the_default_object_is_kept_and_shaped_again_when_its_file_is_damaged(
    vase_and_bust: StageObject, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("VELATURA_CACHE", str(tmp_path))
    shaped: list[int] = []

    def noted() -> Surface:
        shaped.append(1)
        return bust()

    monkeypatch.setattr("plugins.emulated.optics.objects.bust", noted)

    def default() -> list[bytes]:
        return [array.tobytes() for array in default_object.__wrapped__().fingerprint()]

    wanted = [array.tobytes() for array in vase_and_bust.fingerprint()]
    assert [default(), default()] == [wanted, wanted]
    assert shaped == [1]
    (file,) = (tmp_path / "bench").iterdir()
    file.write_bytes(file.read_bytes()[:-100])
    assert default() == wanted
    assert shaped == [1, 1]
