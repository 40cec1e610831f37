"""The rough varnish against Mitsuba's rough plastic, whose paint is black."""

from __future__ import annotations

import numpy as np
import pytest

from lab.emulated.effects import fresnel, reflected

mi = pytest.importorskip("mitsuba")
mi.set_variant("scalar_rgb")


@pytest.mark.parametrize("roughness", [0.15, 0.4])
def test_highlights_are_those_of_mitsubas_rough_plastic(roughness: float) -> None:
    plastic = mi.load_dict(
        {
            "type": "roughplastic",
            "distribution": "ggx",
            "alpha": roughness,
            "int_ior": 1.5,
            "ext_ior": 1.0,
            "diffuse_reflectance": {"type": "rgb", "value": 0.0},
        }
    )
    rng = np.random.default_rng(1)
    rays = rng.normal(size=(2, 300, 3))
    rays /= np.linalg.norm(rays, axis=2, keepdims=True)
    rays[..., 2] = np.abs(rays[..., 2])
    light, eye = rays[:, (rays[..., 2] > 0.15).all(axis=0)]
    normals = np.broadcast_to([0.0, 0.0, 1.0], light.shape)
    found = reflected(light, eye, normals, roughness, 1.5)
    wanted = []
    for towards_light, towards_eye in zip(light, eye, strict=True):
        hit = mi.SurfaceInteraction3f()
        hit.wi = mi.Vector3f(towards_eye)
        value = plastic.eval(mi.BSDFContext(), hit, mi.Vector3f(towards_light))
        wanted.append(np.pi * float(value[0]) / towards_light[2])  # Mitsuba's value has the cosine in it
    np.testing.assert_allclose(found, wanted, rtol=0.01, atol=1e-4)


def test_nothing_is_mirrored_below_the_surface_and_all_of_it_at_grazing_angles() -> None:
    up, down = np.array([[0.0, 0.0, 1.0]]), np.array([[0.0, 0.6, -0.8]])
    assert reflected(down, up, up, 0.3, 1.5) == 0.0
    np.testing.assert_allclose(fresnel(np.array([1.0, 0.0]), 1.5), [0.04, 1.0], atol=1e-9)
