"""Polished metal shows what is around it, and nothing where nothing is; the rest of a scene is as without it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
from embreex import rtcore_scene
from embreex.mesh_construction import TriangleMesh

from lab.emulated.effects import Mirrors
from plugins.emulated.core.truth import ObjectTruth
from plugins.emulated.optics.objects import default_object
from plugins.emulated.optics.render import response
from plugins.emulated.optics.staging import random_truth


@dataclass(frozen=True, slots=True)
class Mirror:
    """A mirror at 45 degrees, whose lower half is paint, and a wall to its right."""

    vertices: npt.NDArray[np.float32]
    faces: npt.NDArray[np.int32]
    normals: npt.NDArray[np.float32]
    object_faces: int = 2


def corner() -> tuple[Any, Any]:
    mirror = [(-1, -1, -1), (1, -1, 1), (1, 1, 1), (-1, 1, -1)]
    wall = [(5, -9, -9), (5, -9, 9), (5, 9, 9), (5, 9, -9)]
    vertices = np.array(mirror + wall, np.float32)
    faces = np.array([(0, 1, 2), (0, 2, 3), (4, 5, 6), (4, 6, 7)], np.int32)
    towards = [(np.sqrt(0.5), 0.0, -np.sqrt(0.5))] * 2 + [(-1.0, 0.0, 0.0)] * 2
    normals = np.repeat(np.array(towards, np.float32)[:, None], 3, axis=1)
    scene = rtcore_scene.EmbreeScene(robust=True)
    TriangleMesh(scene, vertices, faces)
    return Mirror(vertices, faces, normals), scene


def test_a_mirror_shows_the_wall_beside_it_and_its_painted_half_itself() -> None:
    things, scene = corner()
    origins = np.array([(0.2, -0.5, -4), (0.2, 0.5, -4), (3, -0.5, -4)], np.float32)
    rays = np.tile(np.array([(0, 0, 1)], np.float32), (3, 1))
    hits = Mirrors(scene, things, 0.5).run(origins, rays, output=1)
    assert hits["primID"][0] in (2, 3)
    assert hits["primID"][1] in (0, 1)
    np.testing.assert_allclose(hits["ray"], [(1, 0, 0), (0, 0, 1), (0, 0, 1)], atol=1e-6)
    before = scene.run(origins, rays, output=1)
    for key in before:
        np.testing.assert_array_equal(hits[key][1:], before[key][1:])


def test_a_mirror_that_shows_nothing_is_dark() -> None:
    things, scene = corner()
    seen = Mirrors(scene, replace(things, faces=things.faces[[0, 1]]), 0.5)
    up = np.array([(0.2, -0.5, -4)], np.float32)
    # from the right, its light would come from before it, where nothing is
    hits = seen.run(up + np.array([(4, 0, 4)], np.float32), np.array([(-1, 0, 0)], np.float32), output=1)
    assert hits["primID"][0] == -1


def test_a_dent_takes_its_share_of_medium_levels_and_the_response_still_rises() -> None:
    light = random_truth("small", 3, default_object(), ObjectTruth("vase-and-bust", "", 3), (1, 2)).projectors[0].light
    smooth, dented = response(light), response(replace(light, dent=0.15))
    np.testing.assert_allclose(dented[140] / smooth[140], 0.85, atol=1e-3)
    np.testing.assert_allclose(dented[[0, 64, 200, 255]], smooth[[0, 64, 200, 255]], rtol=2e-3)
    assert (np.diff(dented, axis=0) > 0).all()
