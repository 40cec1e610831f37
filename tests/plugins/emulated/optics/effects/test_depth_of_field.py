"""The depth of field against rays through Mitsuba's thin lens, and against its formula."""

from __future__ import annotations

import numpy as np
import pytest

from lab.emulated.effects import confusion_px, defocused


def test_blur_is_none_in_focus_and_as_large_as_the_aperture_lets_it() -> None:
    lens = {"focal_px": 2000.0, "pixel_m": 25e-6, "focus_m": 1.0}
    depth = np.array([1.0, 1.1, 0.9, 1e6])
    at_four, at_eight = (confusion_px(depth, aperture_f=f, **lens) for f in (4.0, 8.0))
    assert at_four[0] == 0.0
    np.testing.assert_allclose(at_four, 2.0 * at_eight)
    # far away: a disc of f^2 / (N (s - f))
    assert at_eight[3] == pytest.approx(0.25 * 0.05**2 / 8.0 / 0.95 / 25e-6, rel=1e-5)


def test_each_pixels_light_has_its_own_variance_and_none_is_lost() -> None:
    for sigma in (0.0, 0.5, 1.1, 2.3, 4.0):
        image = np.zeros((81, 81, 3), np.float32)
        image[40, 40] = 1.0
        spread = np.zeros((81, 81), np.float32)
        spread[40, 40], spread[0, 0] = sigma, 6.0
        found = defocused(image, spread)[..., 1]
        y = np.arange(81) - 40.0
        assert found.sum() == pytest.approx(1.0, abs=1e-5)
        assert float((found.sum(axis=1) * y**2).sum()) == pytest.approx(sigma**2, abs=0.02 + 0.01 * sigma**2)


def test_a_slanted_chequer_is_blurred_as_by_mitsubas_thin_lens() -> None:
    mi = pytest.importorskip("mitsuba")
    mi.set_variant("scalar_rgb")
    width, focal_px, aperture_f, focal_m = 96, 150.0, 0.05, 0.005
    pixel_m = focal_m / focal_px
    chequer = {"type": "checkerboard", "color0": 0.1, "color1": 0.9,
               "to_uv": mi.ScalarTransform4f().scale([12, 12, 1])}  # fmt: skip
    # the plane z = 1.2 + 1.5 x before a camera that looks along z
    turned = mi.ScalarTransform4f().translate([0, 0, 1.2]).rotate([0, 1, 0], 180 - np.rad2deg(np.arctan(1.5)))

    def picture(radius: float) -> np.ndarray:
        kind = (
            {"type": "thinlens", "aperture_radius": radius, "focus_distance": 1.2}
            if radius
            else {"type": "perspective"}
        )
        scene = {
            "type": "scene",
            "integrator": {"type": "direct"},
            "plane": {"type": "rectangle", "to_world": turned.scale([0.7, 0.7, 1]),
                      "bsdf": {"type": "twosided", "m": {"type": "diffuse", "reflectance": chequer}}},
            "light": {"type": "constant"},
            "sensor": kind | {
                "fov": float(np.rad2deg(2 * np.arctan(0.5 * width / focal_px))),
                "to_world": mi.ScalarTransform4f().look_at(origin=[0, 0, 0], target=[0, 0, 1], up=[0, 1, 0]),
                "film": {"type": "hdrfilm", "width": width, "height": 40, "rfilter": {"type": "box"}},
                "sampler": {"type": "multijitter", "sample_count": 64, "seed": 1},
            },
        }  # fmt: skip
        return np.array(mi.render(mi.load_dict(scene)), np.float32)[..., :3]

    sharp, soft = picture(0.0), picture(0.5 * focal_m / aperture_f)
    # Mitsuba's camera has x to the left
    x = -(np.arange(width) - 0.5 * (width - 1)) / focal_px
    depth = np.asarray(1.2 / (1.0 - 1.5 * x), np.float64)
    blur = confusion_px(depth, focal_px=focal_px, pixel_m=pixel_m, aperture_f=aperture_f, focus_m=1.2)
    found = defocused(sharp, np.broadcast_to(blur, sharp.shape[:2]).astype(np.float32))
    inside = np.s_[8:-8, 14:-14]
    change = float(np.sqrt(np.mean((sharp - soft)[inside] ** 2)))
    left = float(np.sqrt(np.mean((found - soft)[inside] ** 2)))
    assert left < 0.3 * change
