"""The object as a mesh, in the formats of programs for 3D pictures."""

from __future__ import annotations

from pathlib import Path

from controller.core.storage import write_atomically
from controller.optics.calibrate.mesh import View, scene_script, write_glb, write_ply
from controller.stage.exchange.content import Content
from controller.stage.exchange.usd import pose_matrix

MESH, SCRIPT = "object.glb", "scene.py"


def write_ply_file(content: Content, path: Path) -> dict[str, int]:
    """As ``write_ply``."""
    write_ply(path, content.mesh, content.colours)
    return _figures(content)


def write_glb_file(content: Content, path: Path) -> dict[str, int]:
    """As ``write_glb``, with a node for the camera and for each projector.

    A camera of glTF can't hold a principal point or a lens. So each node has the pose of a glTF camera (y up, looking
    along -z), and its ``extras`` have ``camera_matrix``, ``distortion`` (k1, k2) and ``size_px`` (width, height).
    """
    views = [
        View(
            name,
            pose_matrix(own),
            {
                "camera_matrix": own.matrix.tolist(),
                "distortion": own.distortion.tolist(),
                "size_px": list(own.size_px),
            },
        )
        for name, own in content.views
    ]
    write_glb(path, content.mesh, content.geometry.camera.size_px, content.picture, views)
    return _figures(content)


def write_blender_folder(content: Content, folder: Path) -> dict[str, int]:
    """The object and a script that sets up camera and projectors in Blender."""
    write_glb(folder / MESH, content.mesh, content.geometry.camera.size_px, content.picture)
    write_atomically(folder / SCRIPT, scene_script(content.geometry, content.names, MESH).encode())
    return _figures(content)


def _figures(content: Content) -> dict[str, int]:
    return {"vertices": len(content.mesh.vertices_m), "triangles": len(content.mesh.triangles)}
