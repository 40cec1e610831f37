"""Light by wavelength, against colour-science and integrals by SciPy."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from scipy.integrate import quad

from lab.emulated.spectra import (
    D65_WHITE,
    EDGES_NM,
    SOFT_NM,
    WAVELENGTHS_NM,
    colours,
    matching_functions,
    paint_bands,
    xyz_to_camera,
)
from plugins.emulated.core.truth import Bands

LAMP: Bands = ((612.0, 22.0), (541.0, 27.0), (457.0, 17.0))
FILTERS: Bands = ((598.0, 38.0), (538.0, 42.0), (462.0, 30.0))


def test_what_a_camera_sees_is_the_integral_of_lamp_paint_and_filter() -> None:
    found = colours(LAMP, FILTERS, (1.0, 1.0, 1.0))

    def gaussian(nm: float, band: tuple[float, float]) -> float:
        return float(np.exp(-0.5 * ((nm - band[0]) / band[1]) ** 2) / band[1])

    def red_paint(nm: float) -> float:
        return float(1 / (1 + np.exp(-(nm - EDGES_NM[1]) / SOFT_NM)))

    def integral(camera: int, c: int, paint: Callable[[float], float]) -> float:
        def product(nm: float) -> float:
            return gaussian(nm, LAMP[c]) * gaussian(nm, FILTERS[camera]) * paint(nm)

        return float(quad(product, 380, 780, points=[450, 540, 600], limit=200)[0])

    for camera in range(3):
        whole = sum(integral(camera, c, lambda nm: 1.0) for c in range(3))
        for c in range(3):
            assert found[camera, 0, c] == pytest.approx(integral(camera, c, red_paint) / whole, abs=2e-4)
    np.testing.assert_allclose(found.sum(axis=(1, 2)), 1.0)


def test_mixing_depends_on_the_paint() -> None:
    found = colours(LAMP, FILTERS, (1.0, 1.0, 1.0))
    white, brown = found.sum(axis=1), np.einsum("kjc,j->kc", found, (0.6, 0.3, 0.1))
    mixing = [one / one.sum(axis=1, keepdims=True) for one in (white, brown)]
    assert np.abs(mixing[0] - mixing[1]).max() > 0.02


def test_matching_functions_and_colour_matrix_are_those_of_colour_science() -> None:
    colour = pytest.importorskip("colour")
    shape = colour.SpectralShape(380, 780, 2)
    table = colour.MSDS_CMFS["CIE 1931 2 Degree Standard Observer"].copy().align(shape).values.T
    assert np.abs(matching_functions() - table).max() < 0.04
    daylight = colour.SDS_ILLUMINANTS["D65"].copy().align(shape).values
    curves = np.stack([np.exp(-0.5 * ((WAVELENGTHS_NM - peak) / width) ** 2) for peak, width in FILTERS])
    errors = []
    for albedo in np.random.default_rng(4).uniform(0.05, 0.9, (40, 3)):
        light = albedo @ paint_bands() * daylight
        camera = curves @ light / (curves @ daylight)
        xyz = np.linalg.solve(xyz_to_camera(FILTERS), camera)
        wanted = table @ light / (table[1] @ daylight)
        labs = [colour.XYZ_to_Lab(one, (0.3127, 0.3290)) for one in (xyz, wanted)]
        errors.append(colour.delta_E(*labs, method="CIE 2000"))
    assert np.median(errors) < 2.5  # as for real cameras, whose filters are no mixture of the eye's
    np.testing.assert_allclose(xyz_to_camera(FILTERS) @ D65_WHITE, 1.0, atol=1e-9)
