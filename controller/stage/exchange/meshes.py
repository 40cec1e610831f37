"""The object as a mesh, in the formats of programs for 3D pictures: glTF, PLY, Blender, USD."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from controller.core.colour import linear_to_srgb, srgb_to_linear
from controller.core.errors import UsageError
from controller.core.storage import stream_atomically, write_atomically
from controller.optics.calibrate.mesh import View, scene_script, write_glb, write_ply
from controller.optics.calibrate.values import Pinhole
from controller.optics.solve.targets.sheets import as_it_is, photographed
from controller.stage.artefacts.mesh import RegisteredMesh
from controller.stage.exchange.content import Content

MESH, SCRIPT = "object.glb", "scene.py"


def write_ply_file(content: Content, path: Path) -> dict[str, int]:
    """As ``write_ply``."""
    write_ply(path, content.mesh, content.colours)
    return _figures(content)


def write_glb_file(content: Content, path: Path) -> dict[str, int]:
    """As ``write_glb``, with a node for the camera and for each projector.

    A camera of glTF can't hold a principal point or a lens. So each node has the pose of a glTF camera (y up, looking
    along -z), and its ``extras`` have ``camera_matrix``, ``distortion`` (k1, k2, p1, p2) and ``size_px`` (width,
    height).
    """
    views = [
        View(
            name,
            pose_matrix(own),
            {"camera_matrix": own.matrix.tolist(), "distortion": own.distortion.tolist(), "size_px": list(own.size_px)},
        )
        for name, own in content.views
    ]
    write_glb(path, content.mesh, content.pictures_px, content.all_pictures, views)
    return _figures(content)


def write_blender_folder(content: Content, folder: Path) -> dict[str, int]:
    """The object and a script that sets up camera and projectors in Blender."""
    write_glb(folder / MESH, content.mesh, content.pictures_px, content.all_pictures)
    write_atomically(folder / SCRIPT, scene_script(content.views, len(content.cameras), MESH).encode())
    return _figures(content)


def _figures(content: Content) -> dict[str, int]:
    return {"vertices": len(content.mesh.vertices_m), "triangles": len(content.mesh.triangles)}


FLIP: Final = np.diag([1.0, -1.0, -1.0])
"""From our frame (y down, z forward) to that of USD and glTF (y up, cameras look along -z), and back."""
APERTURE_MM: Final = 36.0
"""Only the ratio of focal length and aperture counts."""


def pose_matrix(own: Pinhole) -> npt.NDArray[np.float64]:
    """(4, 4): from the frame of a USD or glTF camera to the world, for columns."""
    matrix = np.eye(4)
    matrix[:3, :3] = FLIP @ own.rotation.T @ FLIP
    matrix[:3, 3] = FLIP @ (-own.rotation.T @ own.translation_m)
    return matrix


def write_usd(content: Content, path: Path) -> dict[str, int]:
    """Write a mesh with normals, texture coordinates and colours, and one Camera for each view; metres, y up.

    A Camera of USD has no lens distortion: ``velatura:distortion`` holds k1, k2, p1 and p2; a rendering has to be bent.

    Raises WorkError("no-space", "cannot-write").
    """
    mesh = content.mesh
    parts = [_HEAD, *_mesh(content)]
    cameras = len(content.cameras)
    for n, (name, own) in enumerate(content.views):
        prim = "Camera" if n == 0 else f"Camera_{n}" if n < cameras else f"Projector_{n - cameras + 1}"
        parts += _camera(prim, name, own)
    write_atomically(path, ("\n".join([*parts, "}"]) + "\n").encode())
    return {"vertices": len(mesh.vertices_m), "triangles": len(mesh.triangles)}


_HEAD: Final = """#usda 1.0
(
    defaultPrim = "Stage"
    metersPerUnit = 1
    upAxis = "Y"
)

def Xform "Stage" (
    kind = "component"
)
{"""


def _mesh(content: Content) -> list[str]:
    mesh = content.mesh
    flip = np.diag(FLIP).astype(np.float32)
    vertices = mesh.vertices_m * flip
    width, height = content.pictures_px
    across = (mesh.camera_px.astype(np.float64) + 0.5) / (width, height)
    extent = np.stack([vertices.min(axis=0), vertices.max(axis=0)]) if len(vertices) else np.zeros((2, 3))
    lines = [
        '    def Mesh "Object"',
        "    {",
        "        bool doubleSided = 1",
        f"        float3[] extent = {_tuples(extent)}",
        f"        int[] faceVertexCounts = [{', '.join(['3'] * len(mesh.triangles))}]",
        f"        int[] faceVertexIndices = [{', '.join(map(str, mesh.triangles.ravel().tolist()))}]",
        f"        normal3f[] normals = {_tuples(mesh.normals * flip)} (",
        '            interpolation = "vertex"',
        "        )",
        f"        point3f[] points = {_tuples(vertices)}",
        f"        texCoord2f[] primvars:st = {_tuples(np.stack([across[:, 0], 1 - across[:, 1]], axis=1))} (",
        '            interpolation = "vertex"',
        "        )",
    ]
    if content.colours is not None:
        lines += [
            f"        color3f[] primvars:displayColor = {_tuples(srgb_to_linear(content.colours))} (",
            '            interpolation = "vertex"',
            "        )",
        ]
    return [*lines, '        uniform token subdivisionScheme = "none"', "    }"]


def _camera(prim: str, name: str, own: Pinhole) -> list[str]:
    """The focal length, and the picture's window on the plane at that distance, shifted by the principal point."""
    width, height = own.size_px
    focal_x, focal_y = float(own.matrix[0, 0]), float(own.matrix[1, 1])
    focal = APERTURE_MM * focal_x / width
    shift_x = focal * (width / 2 - 0.5 - float(own.matrix[0, 2])) / focal_x
    shift_y = focal * (float(own.matrix[1, 2]) + 0.5 - height / 2) / focal_y
    rows = ", ".join(_tuple(row) for row in pose_matrix(own).T.tolist())
    return [
        "",
        f'    def Camera "{prim}"',
        "    {",
        "        float2 clippingRange = (0.01, 100)",
        f"        float focalLength = {focal:.9g}",
        f"        float horizontalAperture = {APERTURE_MM:.9g}",
        f"        float horizontalApertureOffset = {shift_x:.9g}",
        '        token projection = "perspective"',
        f"        float verticalAperture = {focal * height / focal_y:.9g}",
        f"        float verticalApertureOffset = {shift_y:.9g}",
        f"        custom double4 velatura:distortion = {_tuple(own.distortion.tolist())}",
        f"        custom string velatura:name = {json.dumps(name, ensure_ascii=False)}",
        f"        custom int2 velatura:size = ({width}, {height})",
        f"        matrix4d xformOp:transform = ( {rows} )",
        '        uniform token[] xformOpOrder = ["xformOp:transform"]',
        "    }",
    ]


def _tuples(values: npt.NDArray[Any]) -> str:
    return "[" + ", ".join("(" + ", ".join(f"{one:.9g}" for one in row) + ")" for row in values.tolist()) + "]"


def _tuple(values: Sequence[float]) -> str:
    return "(" + ", ".join(f"{one:.17g}" for one in values) + ")"


def write_sheet(content: Content, path: Path) -> dict[str, object]:
    """A sheet for an appearance of kind texture: sRGB with its profile, clear where the camera sees nothing of it.

    It has the UV of the run's mesh; without one, or without UV, it is the camera's picture. Raises
    UsageError("sheet-exists"): somebody may have painted on the file.
    """
    from PIL import Image, ImageCms

    if path.exists():
        raise UsageError(
            "sheet-exists",
            what=f"{path} exists, and may have been painted on.",
            remedy="Name another file with --out, or move that file away.",
        )
    transport = content.transport()
    picture, mask = as_it_is(transport), transport.object_mask
    mesh = RegisteredMesh.read(content.folder)
    if mesh is None or mesh.uv is None:
        uv, sheet = "camera", np.dstack([picture, mask])
    else:
        places = mesh.places(content.geometry.camera) if content.places is None else content.places(mesh)
        # twice as fine as the camera sees it, if a half of the sheet is seen
        side = int(2 ** np.clip(np.round(np.log2(2.8 * np.sqrt(mask.sum()))), 9, 12))
        uv, sheet = "mesh", photographed(picture, places, mask, side)
        replace(mesh, figures={**mesh.figures, "sheet_px": [side, side]}).write_figures(content.folder)
    shown = np.dstack([linear_to_srgb(sheet[..., :3]), sheet[..., 3]])
    image = Image.fromarray(np.rint(255 * np.clip(shown, 0, 1)).astype(np.uint8), "RGBA")
    profile = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    stream_atomically(path, lambda file: image.save(file, "PNG", icc_profile=profile))
    return {"uv": uv, "size_px": list(image.size), "next": f'kind = "texture", uv = "{uv}", file = your painted sheet'}
