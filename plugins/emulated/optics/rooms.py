"""Rooms in which a stage may be prepared: how far its light is what a model would like."""

from __future__ import annotations

import dataclasses
from typing import Final

import numpy as np

from plugins.emulated.optics.effects.levels import Dithering, Subsurface
from plugins.emulated.optics.objects import StageObject
from plugins.emulated.optics.truth import BenchTruth, Panels, ProjectorTruth, SurfaceTruth

DARK: Final = "dark"
ROOMS: Final = (DARK, "room", "hard")
TABLE_GAP_M: Final = 5e-4
"""Between the object and the table, so that no two surfaces are one."""
HALF_WIDTH_M: Final = 0.7
FRONT_M, WALL_M, CEILING_M = 0.4, 0.35, 0.7
"""The table's edge, the wall and its upper edge, from the object's middle."""
WOOD: Final = (0.42, 0.36, 0.29)
PAINT: Final = (0.46, 0.46, 0.44)
FILTERS_NM: Final = ((600.0, 38.0), (535.0, 38.0), (460.0, 28.0))
"""Of a camera: peak and standard deviation for red, green and blue."""
LAMP_NM: Final = ((625.0, 22.0), (540.0, 26.0), (455.0, 18.0))
"""Of a projector, likewise."""
BENT: Final = 0.02
"""Largest first radial term of a projector's lens: about a pixel at the edge of a picture at size small."""
MARBLE: Final = Subsurface(share=0.3, spread_m=0.0015)
TURNS: Final = Dithering(levels=64, turns=4, frame_s=1 / 240)
"""A panel of 64 levels, whose others are made by turns of frames."""


def arranged(truth: BenchTruth, room: str, thing: StageObject) -> BenchTruth:
    """The stage in a room of ``ROOMS``; ``dark`` leaves it as it is."""
    if room == DARK:
        return truth
    truth = dataclasses.replace(
        truth,
        surfaces=table_and_wall(thing),
        engine="radiosity",
        camera=dataclasses.replace(truth.camera, glare=0.02),
        projectors=tuple(
            dataclasses.replace(one, lamp=dataclasses.replace(one.lamp, flicker=0.01, drift=0.02))
            for one in truth.projectors
        ),
    )
    return truth if room == "room" else _hard(truth, thing)


def _hard(truth: BenchTruth, thing: StageObject) -> BenchTruth:
    """All the rest, as strong as with real devices."""
    rng = np.random.default_rng([truth.seed, 8])
    sensor = dataclasses.replace(truth.camera.sensor, response_spread=0.01, hot_pixels=2e-4, shutter_spread=0.02)
    away_m = float(np.linalg.norm(thing.vertices.mean(axis=0) - np.array(truth.camera.pose.position_m)))
    return dataclasses.replace(
        truth,
        object=dataclasses.replace(truth.object, gloss=0.04, gloss_exponent=25.0, subsurface=MARBLE),
        camera=dataclasses.replace(truth.camera, sensor=sensor, focus_m=away_m, bands_nm=FILTERS_NM),
        projectors=tuple(_hard_projector(one, rng) for one in truth.projectors),
    )


def _hard_projector(projector: ProjectorTruth, rng: np.random.Generator) -> ProjectorTruth:
    turn = rng.uniform(0.0, 2.0 * np.pi, 2)
    red, blue = ((0.3 * float(np.cos(angle)), 0.3 * float(np.sin(angle))) for angle in turn)
    panels = Panels(shift_px=(red, (0.0, 0.0), blue), magnified=(-4e-4, 0.0, 4e-4))
    light = dataclasses.replace(projector.light, glare=0.02, white_segment=0.25, bands_nm=LAMP_NM)
    lens = dataclasses.replace(projector.lens, distortion=(float(rng.uniform(-BENT, BENT)), 0.0))
    return dataclasses.replace(projector, lens=lens, light=light, panels=panels, dithering=TURNS)


def table_and_wall(thing: StageObject) -> tuple[SurfaceTruth, ...]:
    """A table under the object, and a wall behind it."""
    low = float(thing.vertices[:, 1].max()) + TABLE_GAP_M
    across = (2.0 * HALF_WIDTH_M, 0.0, 0.0)
    return (
        SurfaceTruth("table", (-HALF_WIDTH_M, low, -FRONT_M), across, (0.0, 0.0, FRONT_M + WALL_M), WOOD),
        SurfaceTruth("wall", (-HALF_WIDTH_M, -CEILING_M, WALL_M), across, (0.0, low + CEILING_M, 0.0), PAINT),
    )
