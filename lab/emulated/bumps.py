"""Bumps: changes of the emulated stage after it was set up, as ``bench/bumps.toml``; changes count at once.

[[bump]]
what = "projector"      # or "camera", "object", "ambient"
name = "left"           # which projector
shift_px = [2.0, 0.0]   # turned about its lens until its picture's middle lies that many of its pixels elsewhere
turn_deg = [0, 0, 0.2]  # turned about its own axes (x right, y down, z along the optical axis)
move_mm = [0, 0, 0]     # moved along them
dim = 0.1               # share of the light that is lost
dim_channels = [0, 0, 0.2]  # and of its red, green and blue
defocus_mm = 20.0       # its focus lies that much farther away
gamma = 1.05            # its response's exponents are so many times as large
white_segment = 0.25    # its colour wheel has a white segment, see ``truth``
misconverged_px = 0.5   # its red lies that many pixels to the right, its blue as many below
flicker = 0.02          # spread of its light in short exposures
shadow = 0.15           # a visitor stands in that share of its picture's width
dent = 0.15             # its medium levels lack that share of their light

More for the others: ``noise`` times all noise of the camera, ``blur_px`` more blur of its lens, ``gloss`` and ``metal``
of the object, ``factor`` times the ambient light and ``indirect`` for the share of all light that comes back from
object and room (see ``truth``).

The file holds everything that is otherwise than in ``bench.toml``; without it, all is as it was set up.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Final

import numpy as np
import numpy.typing as npt

from hal.errors import DeviceError
from hal.runtime.files import read_text
from plugins.emulated.core.tables import Between, dump, load
from plugins.emulated.core.truth import (
    BUMPS_FILE,
    BenchTruth,
    Lens,
    Matrix,
    Pose,
    ProjectorTruth,
    SurfaceTruth,
    Three,
    Two,
    matrix_of,
    read_truth,
    rotation_vector_of,
    three,
)
from plugins.emulated.optics.rays import directions

KINDS: Final = ("projector", "camera", "object", "ambient")
Floats = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Bump:
    """One thing that is otherwise. ``what`` is one of ``KINDS``; ``name`` a projector's.

    ``shift_px``: where a point of the object lies in the device's image, the image's middle exactly, moves by that;
    ``turn_deg``, ``move_mm``: about and along the device's own axes, the object's are the world's; ``dim``,
    ``dim_channels``: shares of a projector's light that are lost; ``defocus_mm``: how much farther away its focus lies;
    ``gamma``: factor of its response's exponents; ``white_segment``, ``flicker``, ``shadow``, ``dent``: see ``truth``;
    ``misconverged_px``: how far its red is shifted to the right and its blue down; ``noise``: factor of all noise of
    the camera, ``blur_px``: standard deviation added to its lens'; ``factor``: of the ambient light; ``indirect``,
    ``gloss``, ``metal``: as in ``truth``, of the stage where ``what`` is "ambient", and of the "object".
    """

    what: str
    name: str = ""
    shift_px: Annotated[Two, Between(-1e4, 1e4)] = (0.0, 0.0)
    turn_deg: Annotated[Three, Between(-180.0, 180.0)] = (0.0, 0.0, 0.0)
    move_mm: Annotated[Three, Between(-1e4, 1e4)] = (0.0, 0.0, 0.0)
    dim: Annotated[float, Between(0.0, 1.0)] = 0.0
    dim_channels: Annotated[Three, Between(0.0, 1.0)] = (0.0, 0.0, 0.0)
    factor: Annotated[float, Between(0.0, 1e3)] = 1.0
    defocus_mm: Annotated[float, Between(-1e4, 1e4)] = 0.0
    gamma: Annotated[float, Between(0.2, 5.0)] = 1.0
    noise: Annotated[float, Between(0.0, 1e3)] = 1.0
    indirect: Annotated[float, Between(0.0, 1.0)] = 0.0
    gloss: Annotated[float, Between(0.0, 1.0)] = 0.0
    white_segment: Annotated[float, Between(0.0, 2.0)] = 0.0
    misconverged_px: Annotated[float, Between(-3.0, 3.0)] = 0.0
    flicker: Annotated[float, Between(0.0, 0.3)] = 0.0
    shadow: Annotated[float, Between(0.0, 1.0)] = 0.0
    dent: Annotated[float, Between(0.0, 0.2)] = 0.0
    metal: Annotated[float, Between(0.0, 1.0)] = 0.0
    blur_px: Annotated[float, Between(0.0, 9.0)] = 0.0


@dataclass(frozen=True, slots=True)
class Bumps:
    """All of them; each is applied to the stage that the earlier ones left."""

    bump: tuple[Bump, ...] = ()


def read_bumps(path: Path, truth: BenchTruth) -> Bumps:
    """The bumps in a file; none without it. Raises DeviceError as ``tables.load``, or ``bumps-wrong``."""
    try:
        text = read_text(path)
    except FileNotFoundError:
        return Bumps()
    except (OSError, UnicodeDecodeError) as error:
        raise _wrong(path, f"it can't be read ({error})") from error
    bumps = load(text, Bumps, file=str(path))
    _check(path, bumps, truth)
    return bumps


def bumps_of(changes: Sequence[Mapping[str, Any]], truth: BenchTruth) -> Bumps:
    """Bumps from tables as a file has them. Raises DeviceError as ``read_bumps``."""
    try:
        bumps = Bumps(tuple(Bump(**change) for change in changes))
    except TypeError as error:
        raise _wrong(Path(BUMPS_FILE), str(error)) from error
    checked = load(dump(bumps), Bumps, file=BUMPS_FILE) if changes else bumps
    _check(Path(BUMPS_FILE), checked, truth)
    return checked


def _check(path: Path, bumps: Bumps, truth: BenchTruth) -> None:
    names = [projector.name for projector in truth.projectors]
    for number, bump in enumerate(bumps.bump, start=1):
        if bump.what not in KINDS:
            raise _wrong(path, f"bump {number}: {bump.what!r} is not one of {', '.join(KINDS)}")
        if bump.what == "projector" and bump.name not in names:
            raise _wrong(path, f"bump {number}: {bump.name!r} is not one of {', '.join(names)}")
        if bump.what in ("object", "ambient") and any(bump.shift_px):
            raise _wrong(path, f"bump {number}: {bump.what} has no image that could shift")


def write_bumps(stage: Path, *bumps: Bump) -> None:
    """Bump the stage, in one step; without bumps: restore it."""
    path = stage / BUMPS_FILE
    if not bumps:
        path.unlink(missing_ok=True)
        return
    temporary = path.with_name(path.name + ".part")
    temporary.write_text(dump(Bumps(bumps)), encoding="utf-8")
    temporary.replace(path)


def _wrong(path: Path, why: str) -> DeviceError:
    return DeviceError("bumps-wrong", what=f"{path}: {why}.", remedy="Correct the file, or remove it.")


def changed(path: Path, truth: BenchTruth) -> tuple[BenchTruth, int]:
    """A stage after the bumps of its file, and how many these are. Raises DeviceError as ``read_bumps``."""
    bumps = read_bumps(path, truth)
    return bumped(truth, bumps), len(bumps.bump)


def disturb(stage: Path, changes: Sequence[Mapping[str, Any]]) -> None:
    """Bump a stage by tables as its file has them. Raises DeviceError as ``read_bumps``."""
    write_bumps(stage, *bumps_of(changes, read_truth(stage)).bump)


def bumped(truth: BenchTruth, bumps: Bumps) -> BenchTruth:
    """The stage after the bumps."""
    for bump in bumps.bump:
        truth = _bumped(truth, bump)
    return truth


def _bumped(truth: BenchTruth, bump: Bump) -> BenchTruth:
    if bump.what == "ambient":
        ambient = three(bump.factor * np.asarray(truth.ambient))
        return dataclasses.replace(truth, ambient=ambient, indirect=truth.indirect + bump.indirect)
    if bump.what == "camera":
        camera = truth.camera
        sensor = dataclasses.replace(camera.sensor, noise=camera.sensor.noise * bump.noise)
        camera = dataclasses.replace(
            camera,
            pose=_device(camera.pose, camera.lens, bump),
            sensor=sensor,
            psf_sigma_px=float(np.hypot(camera.psf_sigma_px, bump.blur_px)),
        )
        return dataclasses.replace(truth, camera=camera)
    if bump.what == "object":
        glossy = dataclasses.replace(
            truth.object, gloss=truth.object.gloss + bump.gloss, metal=max(truth.object.metal, bump.metal)
        )
        moved = _object_moved(truth, bump) if any((*bump.turn_deg, *bump.move_mm)) else truth
        return dataclasses.replace(moved, object=glossy)
    projectors = tuple(_projector(one, bump) if one.name == bump.name else one for one in truth.projectors)
    return dataclasses.replace(truth, projectors=projectors)


def _projector(projector: ProjectorTruth, bump: Bump) -> ProjectorTruth:
    light = projector.light
    mixing = np.asarray(light.mixing) * (1.0 - np.asarray(bump.dim_channels))
    rows: Matrix = (three(mixing[0]), three(mixing[1]), three(mixing[2]))
    light = dataclasses.replace(
        light,
        brightness=light.brightness * (1.0 - bump.dim),
        mixing=rows,
        gamma=three(bump.gamma * np.asarray(light.gamma)),
        white_segment=light.white_segment + bump.white_segment,
        shadow=max(light.shadow, bump.shadow),
        dent=max(light.dent, bump.dent),
    )
    focus = dataclasses.replace(
        projector.focus, distance_m=max(0.01, projector.focus.distance_m + 1e-3 * bump.defocus_mm)
    )
    pose = _device(projector.pose, projector.lens, bump)
    red, green, blue = projector.panels.shift_px
    shifted = ((red[0] + bump.misconverged_px, red[1]), green, (blue[0], blue[1] + bump.misconverged_px))
    return dataclasses.replace(
        projector,
        light=light,
        focus=focus,
        pose=pose,
        panels=dataclasses.replace(projector.panels, shift_px=shifted),
        lamp=dataclasses.replace(projector.lamp, flicker=projector.lamp.flicker + bump.flicker),
    )


def _device(pose: Pose, lens: Lens, bump: Bump) -> Pose:
    """Its new pose: x_new = turn (R (x - position) ...), the position moved along its own axes."""
    turn = matrix_of(np.deg2rad(bump.turn_deg))
    if any(bump.shift_px):
        width, height = lens.size_px
        middle = np.array([0.5 * (width - 1), 0.5 * (height - 1)])
        at = np.stack([middle, middle + bump.shift_px])
        here, there = directions(Pose((0.0, 0.0, 0.0), (0.0, 0.0, 0.0)), lens, at[:, 0], at[:, 1])
        turn = _shortest_turn(here, there) @ turn
    rotation = pose.rotation
    position = np.asarray(pose.position_m) + rotation.T @ (1e-3 * np.asarray(bump.move_mm))
    return Pose(three(position), three(rotation_vector_of(turn @ rotation)))


def _shortest_turn(here: Floats, there: Floats) -> Floats:
    """(3, 3) rotation that takes one unit vector to another."""
    axis = np.cross(here, there)
    sine = float(np.linalg.norm(axis))
    angle = np.arctan2(sine, float(here @ there))
    return matrix_of(axis / max(sine, 1e-15) * angle)


def _object_moved(truth: BenchTruth, bump: Bump) -> BenchTruth:
    """An object that moves among still devices looks as devices and room that move the other way round it."""
    turn = matrix_of(np.deg2rad(bump.turn_deg))
    move = 1e-3 * np.asarray(bump.move_mm)

    def other_way(pose: Pose) -> Pose:
        position = turn.T @ (np.asarray(pose.position_m) - move)
        return Pose(three(position), three(rotation_vector_of(pose.rotation @ turn)))

    def surface(one: SurfaceTruth) -> SurfaceTruth:
        across, along = (three(turn.T @ np.asarray(side)) for side in (one.across_m, one.along_m))
        corner = three(turn.T @ (np.asarray(one.corner_m) - move))
        return dataclasses.replace(one, corner_m=corner, across_m=across, along_m=along)

    return dataclasses.replace(
        truth,
        camera=dataclasses.replace(truth.camera, pose=other_way(truth.camera.pose)),
        projectors=tuple(dataclasses.replace(one, pose=other_way(one.pose)) for one in truth.projectors),
        surfaces=tuple(surface(one) for one in truth.surfaces),
    )
