"""Meshes as programs write them: every one has the area, the colours and the texture that it had there."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from hal.runtime.mesh_file import MeshFile, MeshUnreadable, read_mesh, triangles

CORNERS = [
    (0, 0, 0),
    (0.2, 0, 0),
    (0.2, 0.3, 0),
    (0, 0.3, 0),
    (0, 0, 0.1),
    (0.2, 0, 0.1),
    (0.2, 0.3, 0.1),
    (0, 0.3, 0.1),
]
SIDES = [(1, 4, 3, 2), (5, 6, 7, 8), (1, 2, 6, 5), (3, 4, 8, 7), (1, 5, 8, 4), (2, 3, 7, 6)]
AREA = 0.22
V = "".join(f"v {x} {y} {z}\n" for x, y, z in CORNERS)
F = "".join(f"f {' '.join(map(str, side))}\n" for side in SIDES)
L_SHAPE = [(0, 0), (0.3, 0), (0.3, 0.1), (0.1, 0.1), (0.1, 0.3), (0, 0.3)]


def area(mesh: MeshFile) -> float:
    a, b, c = (mesh.vertices[mesh.faces[:, corner]] for corner in range(3))
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2)


def by_turns() -> str:
    return "".join(
        "".join(f"v {' '.join(map(str, CORNERS[n - 1]))}\n" for n in side) + "f -4 -3 -2 -1\n" for side in SIDES
    )


OBJ = {
    "plain": V + F, "relative": by_turns(),
    "relative with texture": V + "vt 0 0\nvt 1 1\n" + F.replace("f 1 4 3 2", "f -8/-2 -5/-1 -6/-1 -7/-2"),
    "byte order mark": "\ufeff" + V + F, "umlaut": "o B\xfcste\n" + V + F, "windows": (V + F).replace("\n", "\r\n"),
    "continued": V + F.replace("f 1 4 3 2", "f 1 4\\\n3 2"), "comments": V.replace("0.3 0\n", "0.3 0 # top\n") + F,
    "tabs": (V + F).replace(" ", "\t"), "groups": "g a\ns 1\n" + V + "usemtl none\n" + F,
}  # fmt: skip


@pytest.mark.parametrize("name", OBJ)
@pytest.mark.parametrize("encoding", ["utf-8", "latin-1", "utf-16"])
def test_an_obj_has_all_its_sides(tmp_path: Path, name: str, encoding: str) -> None:
    (tmp_path / "m.obj").write_bytes(OBJ[name].encode(encoding, "ignore"))
    assert area(read_mesh(tmp_path / "m.obj")) == pytest.approx(AREA)


@pytest.mark.parametrize("start", range(6))
@pytest.mark.parametrize("kind", ["obj", "ply", "ply with others"])
@pytest.mark.parametrize("axes", [(0, 1, 2), (2, 0, 1), (1, 0, 2)])
def test_a_concave_face_is_cut_inside_itself(tmp_path: Path, kind: str, start: int, axes: tuple[int, int, int]) -> None:
    shape = [tuple(np.array([*corner, 0.0])[list(axes)]) for corner in L_SHAPE[start:] + L_SHAPE[:start]]
    path = tmp_path / f"m.{kind[:3]}"
    if kind == "obj":
        path.write_text("".join(f"v {x} {y} {z}\n" for x, y, z in shape) + "f 1 2 3 4 5 6\n")
    else:
        more = "3 0 1 2\n" if "others" in kind else ""
        path.write_text(ply(shape, faces=["6 0 1 2 3 4 5", *more.splitlines()]))
    mesh = read_mesh(path)
    corners = mesh.vertices[mesh.faces[:4]]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert np.linalg.norm(cross, axis=1).sum() / 2 == pytest.approx(0.05)
    assert (cross @ cross.sum(axis=0) > 0).all()


@settings(max_examples=60, deadline=None)
@given(st.lists(st.floats(0.2, 1), min_size=4, max_size=12), st.booleans())
def test_a_star_of_any_form_keeps_its_area(radii: list[float], reverse: bool) -> None:
    angle = np.linspace(0, 2 * np.pi, len(radii), endpoint=False)
    points = np.array([np.cos(angle), np.sin(angle), 0.3 * np.cos(angle)]).T * np.array(radii)[:, None]
    points = points[::-1] if reverse else points
    (cut,) = triangles(points, [range(len(points))])
    shoelace = np.linalg.norm(np.cross(points, np.roll(points, -1, axis=0)).sum(axis=0)) / 2
    pieces = [np.cross(points[b] - points[a], points[c] - points[a]) / 2 for a, b, c in cut]
    assert len(cut) == len(radii) - 2
    assert np.linalg.norm(pieces, axis=1).sum() == pytest.approx(shoelace)


def ply(points: Any, names: str = "", colours: Any = None, faces: Any = ("3 0 1 2",), of_face: str = "") -> str:
    rows = [[*point, *([] if colours is None else colours[n])] for n, point in enumerate(points)]
    head = ["ply", "format ascii 1.0", f"element vertex {len(rows)}", *(f"property float {axis}" for axis in "xyz")]
    head += names.split(";") if names else []
    head += [
        f"element face {len(faces)}",
        "property list uchar int vertex_indices",
        *(of_face.split(";") if of_face else []),
    ]
    return "\n".join([*head, "end_header", *(" ".join(map(str, row)) for row in rows), *faces]) + "\n"


TRIANGLE = [(0, 0, 0), (1, 0, 0), (0, 1, 0)]
COLOURS = np.array([[255, 51, 0], [0, 102, 255], [153, 255, 204]])


def declared(kind: str, *names: str) -> str:
    return ";".join(f"property {kind} {name}" for name in names)


@pytest.mark.parametrize(
    ("kind", "full"), [("uchar", 255), ("ushort", 65535), ("float", 255.0), ("float", 1.0), ("double", 1.0)]
)
@pytest.mark.parametrize("names", [("red", "green", "blue"), ("diffuse_red", "diffuse_green", "diffuse_blue")])
def test_colours_of_any_type_and_name_are_the_same(
    tmp_path: Path, kind: str, full: float, names: tuple[str, ...]
) -> None:
    values = COLOURS / 255 * full
    values = values.round().astype(int) if kind.startswith("u") else values
    (tmp_path / "m.ply").write_text(ply(TRIANGLE, declared(kind, *names), values))
    colours = read_mesh(tmp_path / "m.ply").colours
    assert colours is not None
    np.testing.assert_allclose(colours[0], COLOURS / 255, atol=1e-4)


@pytest.mark.parametrize("byteorder", ["<", ">"])
def test_colours_of_faces_and_of_binary_files_too(tmp_path: Path, byteorder: str) -> None:
    faces = ["4 0 1 3 2 255 51 0", "3 0 1 2 0 102 255"]
    (tmp_path / "m.ply").write_text(
        ply([*TRIANGLE, (1, 1, 0)], faces=faces, of_face=declared("uchar", "red", "green", "blue"))
    )
    colours = read_mesh(tmp_path / "m.ply").colours
    assert colours is not None
    np.testing.assert_allclose(255 * colours[:, 0], [[255, 51, 0], [255, 51, 0], [0, 102, 255]])
    vertex = np.dtype([("p", f"{byteorder}f4", 3), ("c", f"{byteorder}u2", 3)])
    rows = np.array([(point, colour * 257) for point, colour in zip(TRIANGLE, COLOURS, strict=True)], vertex)
    text = ply(TRIANGLE, declared("ushort", "red", "green", "blue"), COLOURS)
    order = "little" if byteorder == "<" else "big"
    head = text.partition("end_header\n")[0].replace("ascii", f"binary_{order}_endian") + "end_header\n"
    face = np.array([(3, (0, 1, 2))], np.dtype([("n", "u1"), ("i", f"{byteorder}i4", 3)]))
    (tmp_path / "b.ply").write_bytes(head.encode() + rows.tobytes() + face.tobytes())
    binary = read_mesh(tmp_path / "b.ply").colours
    assert binary is not None
    np.testing.assert_allclose(binary[0], COLOURS / 255, atol=1e-4)


@pytest.mark.parametrize("full", [1, 255])
def test_an_obj_with_coloured_corners_keeps_them(tmp_path: Path, full: int) -> None:
    rows = zip(TRIANGLE, COLOURS / 255 * full, strict=True)
    (tmp_path / "m.obj").write_text("".join(f"v {' '.join(map(str, [*p, *c]))}\n" for p, c in rows) + "f 1 2 3\n")
    colours = read_mesh(tmp_path / "m.obj").colours
    assert colours is not None
    np.testing.assert_allclose(colours[0], COLOURS / 255, atol=3e-3)


@pytest.mark.parametrize("material", [
    "map_Kd ta.png", "map_Kd textures\\ta.png", "map_Kd C:\\work\\ta.png", "map_kd -s 1 1 1 -o 0 0 0 ta.png",
    "map_Kd -clamp on -mm 0 1 ta.png",
    "map_Kd TA.PNG", "map_Kd my skin.png", 'map_Kd "ta.png"', "Kd 1 1 1\n\tmap_Kd ta.png  ",
])  # fmt: skip
def test_a_texture_is_found_however_its_name_is_written(tmp_path: Path, material: str) -> None:
    (tmp_path / "textures").mkdir()
    for name in ("ta.png", "my skin.png", "textures/ta.png"):
        Image.new("RGB", (8, 8), (200, 30, 20)).save(tmp_path / name)
    (tmp_path / "M.mtl").write_bytes(f"\ufeff# Farbe\nnewmtl A\n{material}\n".encode())
    texture = "mtllib m.mtl\n" + V + "vt 0 0\nvt 1 0\nvt 1 1\nusemtl A\n" + "f 1/1 2/2 3/3\n"
    (tmp_path / "m.obj").write_text(texture)
    mesh = read_mesh(tmp_path / "m.obj")
    assert mesh.texture is not None
    assert mesh.texture[4, 4].tolist() == [200, 30, 20]
    assert mesh.uv is not None
    np.testing.assert_allclose(mesh.uv[0], [[0, 0], [1, 0], [1, 1]])


@pytest.mark.parametrize(
    ("material", "reason"), [("map_Kd gone.png", "gone.png is missing"), ("map_Kd -s 2 2 2 ta.png", "moved or scaled")]
)
def test_a_texture_that_can_not_be_used_is_named_where_colours_count(
    tmp_path: Path, material: str, reason: str
) -> None:
    Image.new("RGB", (8, 8)).save(tmp_path / "ta.png")
    (tmp_path / "m.mtl").write_text(f"newmtl A\n{material}\n")
    (tmp_path / "m.obj").write_text("mtllib m.mtl\n" + V + "vt 0 0\nvt 1 0\nvt 1 1\nusemtl A\nf 1/1 2/2 3/3\n")
    with pytest.raises(MeshUnreadable, match=reason):
        read_mesh(tmp_path / "m.obj")
    assert len(read_mesh(tmp_path / "m.obj", coloured=False).faces) == 1


@pytest.mark.parametrize("lost", [8, 40, 100])
@pytest.mark.parametrize("encoding", ["ascii", "binary"])
def test_a_ply_that_was_cut_off_is_refused_and_not_half_an_object(tmp_path: Path, encoding: str, lost: int) -> None:
    data = trimesh.creation.box((1, 2, 3)).export(file_type="ply", encoding=encoding, vertex_normal=False)
    (tmp_path / "a.ply").write_bytes(data[:-lost])
    with pytest.raises(MeshUnreadable):
        read_mesh(tmp_path / "a.ply")


@pytest.mark.parametrize("face", ["f 0 1 2", "f 1 2 0", " f\t1/1 2/2 0/3", "f 1//1 0//1 2//1"])
def test_an_obj_that_counts_from_zero_is_refused(tmp_path: Path, face: str) -> None:
    corners = "".join(f"v {x} {y} 0\nvt {x} {y}\nvn 0 0 1\n" for x, y in ((0, 0), (1, 0), (0, 1)))
    (tmp_path / "a.obj").write_text(corners + face + "\n")
    with pytest.raises(MeshUnreadable, match="counts from 1"):
        read_mesh(tmp_path / "a.obj")


def test_strips_are_refused_by_name(tmp_path: Path) -> None:
    text = ply(TRIANGLE).replace("element face 1", "element tristrips 1")
    (tmp_path / "m.ply").write_text(text)
    with pytest.raises(MeshUnreadable, match="triangle strips"):
        read_mesh(tmp_path / "m.ply")
    with pytest.raises(MeshUnreadable, match=r"^No such file or directory$"):
        read_mesh(tmp_path / "missing.ply")


@pytest.mark.parametrize("kind", ["stl", "glb", "off", "ply", "obj"])
def test_what_trimesh_writes_comes_back(tmp_path: Path, kind: str) -> None:
    trimesh.creation.icosphere(subdivisions=2).export(tmp_path / f"m.{kind}")
    assert area(read_mesh(tmp_path / f"m.{kind}")) == pytest.approx(trimesh.creation.icosphere(subdivisions=2).area)


def test_colours_of_a_glb_are_light(tmp_path: Path) -> None:
    box = trimesh.creation.box()
    box.visual.vertex_colors = np.tile([188, 137, 99, 255], (8, 1)).astype(np.uint8)
    box.export(tmp_path / "m.glb")
    mesh = read_mesh(tmp_path / "m.glb")
    assert mesh.linear
    assert mesh.colours is not None
    np.testing.assert_allclose(255 * mesh.colours[0, 0], [188, 137, 99], atol=1)
