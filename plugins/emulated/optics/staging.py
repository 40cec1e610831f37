"""Setting up an emulated stage: a random but plausible truth, and what a technician would know of it."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from hal.errors import DeviceError
from plugins.emulated.core.truth import (
    OPAQUE,
    BenchTruth,
    CameraTruth,
    Focus,
    LampTruth,
    Lens,
    LightTruth,
    Matrix,
    ObjectTruth,
    Pose,
    ProjectorTruth,
    Sensor,
    Three,
    rotation_vector_of,
    three,
)
from plugins.emulated.optics.layout import DEFAULT, Stands
from plugins.emulated.optics.objects import VASE_AND_BUST, StageObject
from plugins.emulated.optics.rays import project

Floats = npt.NDArray[np.float64]


@dataclasses.dataclass(frozen=True, slots=True)
class Size:
    """Image sizes (width, height) of a stage, camera subsamples a side, and how many projectors it usually has."""

    projector_px: tuple[int, int]
    camera_px: tuple[int, int]
    subsamples: int
    projectors: int = DEFAULT


SIZES: Final[Mapping[str, Size]] = {
    "small": Size((280, 210), (776, 520), 3),
    "medium": Size((700, 526), (1944, 1296), 2),
    "paper": Size((1400, 1050), (3888, 2592), 2),
    # one ray a camera pixel: with four, the rays alone would take 6 GB
    "uhd": Size((3840, 2160), (8192, 5464), 1, 4),
}
INTRINSICS: Final = "camera-intrinsics.toml"
FOCAL_REL_SIGMA, CENTRE_SIGMA_PX, K1_SIGMA = 0.001, 3.0, 0.01
"""Precision of a lens calibration with a ChArUco board at the size ``paper``; the centre scales with the picture."""
FRAMES: Final = "run/outputs.frame"
FAST_PROFILE: Final = "bench/optoma-fast.toml"
CAMERA_FILL: Final = 0.90
PROJECTOR_FILL: Final = 0.88
FAST_LAMP: Final = LampTruth(warm_up_s=2.0, stable_s=2.0, cool_down_s=1.0)
LENS_SHIFT: Final = 1.05
"""The optical axis' height in the image, in image heights from the top: below the lower edge."""
WHITE_LIGHT: Final = 2.5
"""Linear light of the brightest point with three projectors at white; exposed to 85 % at 1/15 s, f/8, ISO 100."""


def size_named(name: str) -> Size:
    """Raises DeviceError ``size-unknown``."""
    if name not in SIZES:
        raise DeviceError(
            "size-unknown",
            what=f"There is no emulated stage of size {name!r}.",
            remedy=f"Choose one of {', '.join(SIZES)}.",
        )
    return SIZES[name]


def random_truth(
    size: str,
    seed: int,
    stage_object: StageObject,
    kept: ObjectTruth,
    ports: tuple[int, ...],
    stands: Stands | None = None,
) -> BenchTruth:
    """A plausible stage round ``stage_object``; the same arguments give the same stage."""
    sizes, rng = size_named(size), np.random.default_rng(seed)
    points = stage_object.vertices[:: max(1, len(stage_object.vertices) // 6000)].astype(np.float64)
    stands = stands or Stands()
    degrees = stands.camera_degrees
    camera = _camera(sizes, rng, points, ports[:2], degrees[0])
    others = []
    for n, right in enumerate(degrees[1:], start=1):
        own = np.random.default_rng([seed, 30 + n])
        others.append(_differing(_camera(sizes, own, points, ports[2 * n : 2 * n + 2], right), n, own))
    if others:
        camera = dataclasses.replace(camera, name=CAMERA_NAME.format(1))
    aims = [points]
    if stage_object.paint != VASE_AND_BUST and len(stage_object.parts) > 1:
        parts = np.split(stage_object.faces, stage_object.parts[1:])
        aims = [stage_object.vertices[np.unique(part)].astype(np.float64) for part in parts]
    projectors = tuple(
        _projector(index, *place, sizes, rng, aims[index % len(aims)])
        for index, place in enumerate(stands.places(sizes.projectors))
    )
    if stands.placed:
        projectors = tuple(stand.put(drawn) for stand, drawn in zip(stands.placed, projectors, strict=True))
    return BenchTruth(
        size=size,
        frames=FRAMES,
        ambient=three(rng.uniform(0.0012, 0.0022, 3)),
        latency_s=2.0 / 60.0,
        time_scale=0.25,
        seed=seed,
        subsamples=sizes.subsamples,
        object=kept,
        camera=camera,
        projectors=projectors,
        more_cameras=tuple(others),
    )


SLOW_PICTURE_S: Final = 120
QUICK_PX: Final = 1_000_000
"""Larger pictures take the bench longer than a camera."""


def _slow(truth: BenchTruth) -> bool:
    """Whether the bench works some seconds on a picture, and longer on a computer with other work."""
    width, height = truth.camera.lens.size_px
    return width * height > QUICK_PX or truth.camera.spectral or truth.object.subsurface != OPAQUE


def device_tables(truth: BenchTruth, stage_object: StageObject) -> dict[str, Any]:
    """The device tables for stage.toml: what a technician reads off the devices, or measures with a tape.

    ``distance_m`` is from the camera to the nearest point of ``stage_object``, which nothing can hide.
    """
    if truth.more_cameras:
        rows = []
        for n, camera in enumerate(truth.cameras):
            table = device_tables(truth.seen_by(camera), stage_object)["camera"]
            rows.append({"name": camera.name, **table, "intrinsics": intrinsics_name(n)})
        first = device_tables(truth.seen_by(truth.camera), stage_object)
        return {key: value for key, value in first.items() if key != "camera"} | {"cameras": rows}
    rng = np.random.default_rng([truth.seed, 1])
    camera = truth.camera
    distance = float(np.linalg.norm(stage_object.vertices - np.asarray(camera.pose.position_m), axis=1).min())
    return {
        "projectors": [
            {"name": p.name, "output": p.output, "driver": "serial", "profile": p.profile, "port": p.port}
            for p in truth.projectors
        ],
        "camera": {
            "driver": "ptp",
            "address": f"ptpip:127.0.0.1:{camera.command_port}:{camera.event_port}",
            "iso": 100,
            "intrinsics": INTRINSICS,
            "distance_m": round(distance * (1.0 + 0.01 * rng.uniform(-1.0, 1.0)), 3),
            **({"picture_s": SLOW_PICTURE_S} if _slow(truth) else {}),
        },
        "display": {
            "driver": "player",
            "frames": truth.frames,
            "outputs": [
                {"name": p.output, "width_px": p.lens.size_px[0], "height_px": p.lens.size_px[1]}
                for p in truth.projectors
            ],
        },
    }


def intrinsics_name(number: int) -> str:
    """The file of the lens of a camera of this number, from 0."""
    return INTRINSICS if not number else INTRINSICS.replace(".", f"-{number + 1}.")


def intrinsics_of(truth: BenchTruth) -> str:
    """The file that a ChArUco session with this camera would have left: the truth, off by a session's errors."""
    rng = np.random.default_rng([truth.seed, 3])
    lens = truth.camera.lens
    (width, height), centre_sigma = lens.size_px, CENTRE_SIGMA_PX * lens.size_px[0] / SIZES["paper"].camera_px[0]
    focal = lens.focal_px * (1.0 + FOCAL_REL_SIGMA * float(rng.uniform(-1.0, 1.0)))
    x, y = np.asarray(lens.centre_px) + centre_sigma * rng.uniform(-1.0, 1.0, 2)
    k1 = lens.distortion[0] + K1_SIGMA * float(rng.uniform(-1.0, 1.0))
    variances = np.square([FOCAL_REL_SIGMA, centre_sigma, centre_sigma, K1_SIGMA])
    rows = ", ".join(str([float(v) for v in row]) for row in np.diag(variances))
    return "\n".join(
        (
            'method = "charuco"',
            f"width_px = {width}",
            f"height_px = {height}",
            f"focal_length_px = {focal!r}",
            f"principal_point_px = [{float(x)!r}, {float(y)!r}]",
            f"distortion_k1 = {k1!r}",
            f"covariance = [{rows}]",
            "",
        )
    )


CAMERA_NAME: Final = "view-{}"


def _differing(camera: CameraTruth, n: int, rng: np.random.Generator) -> CameraTruth:
    """Another body: more or less noise, light and colour than the first one's."""
    sensor = camera.sensor
    sensor = dataclasses.replace(
        sensor,
        electrons_per_light_s=sensor.electrons_per_light_s * float(rng.uniform(0.85, 1.15)),
        read_noise_e=sensor.read_noise_e * float(rng.uniform(0.8, 1.3)),
    )
    tint = three(np.array([rng.uniform(0.96, 1.04), 1.0, rng.uniform(0.96, 1.04)]))
    return dataclasses.replace(camera, sensor=sensor, tint=tint, name=CAMERA_NAME.format(n + 1))


def _camera(sizes: Size, rng: np.random.Generator, points: Floats, ports: tuple[int, ...], right: float) -> CameraTruth:
    width, height = sizes.camera_px
    centre = (0.5 * (width - 1) + rng.normal(0.0, 0.004) * width, 0.5 * (height - 1) + rng.normal(0.0, 0.004) * width)
    distortion = (float(rng.uniform(-0.06, -0.02)), float(rng.uniform(0.0, 0.01)))
    lens = Lens((width, height), 1.0, (float(centre[0]), float(centre[1])), distortion)
    right += float(rng.uniform(-2.0, 2.0))
    position = _place(right, float(rng.uniform(7.0, 10.0)), float(rng.uniform(1.08, 1.16)))
    pose, lens = _aimed(position, lens, points, CAMERA_FILL, rng, middle=(0.5, 0.5))
    return CameraTruth(
        pose=pose,
        lens=lens,
        sensor=Sensor(
            electrons_per_light_s=0.85 * 3960.0 * 9.0 * 15.0 / WHITE_LIGHT,
            electrons_per_step=9.0,
            full_well_e=44000.0,
            read_noise_e=9.0,
            black_level=128,
            white_level=4095,
        ),
        serial_number=f"VE{int(rng.integers(10**7)):07d}",
        command_port=ports[0],
        event_port=ports[1],
        psf_sigma_px=0.55,
        vignetting=float(rng.uniform(0.10, 0.18)),
    )


def _projector(
    index: int, name: str, right: float, above: float, sizes: Size, rng: np.random.Generator, points: Floats
) -> ProjectorTruth:
    width, height = sizes.projector_px
    reference = float(rng.uniform(1.05, 1.25))
    position = _place(right + float(rng.uniform(-2.0, 2.0)), above + float(rng.uniform(-2.0, 2.0)), reference)
    centre = (
        0.5 * (width - 1) + float(rng.normal(0.0, 0.003)) * width,
        (LENS_SHIFT + float(rng.normal(0.0, 0.004))) * height,
    )
    pose, lens = _aimed(
        position, Lens((width, height), 1.0, centre, (0.0, 0.0)), points, PROJECTOR_FILL, rng, (0.5, 0.5)
    )
    depth = float((pose.rotation @ (0.0 - np.asarray(position)))[2])
    return ProjectorTruth(
        name=name,
        output=f"P{index + 1}",
        port=f"run/tty-{name}",
        profile=FAST_PROFILE,
        pose=pose,
        lens=lens,
        focus=Focus(
            distance_m=depth + float(rng.uniform(-0.03, 0.01)),
            sharpest_px=float(rng.uniform(0.28, 0.36)),
            slope_px_per_m=float(rng.uniform(5.0, 8.0)),
        ),
        light=LightTruth(
            brightness=float(rng.uniform(0.92, 1.08)),
            reference_m=depth,
            black_level=float(rng.uniform(0.9, 1.1)) / 1500.0,
            vignetting=float(rng.uniform(0.12, 0.25)),
            fill_factor=0.9,
            gamma=three(rng.uniform(2.1, 2.4, 3)),
            s_curve=three(rng.uniform(0.08, 0.25, 3)),
            mixing=_mixing(rng),
        ),
        lamp=FAST_LAMP,
    )


def _mixing(rng: np.random.Generator) -> Matrix:
    """Crosstalk of 3 to 12 % of each channel's light, then the colour of the lamp."""
    mixing = rng.uniform(0.03, 0.12, (3, 3))
    np.fill_diagonal(mixing, 0.0)
    mixing += np.diag(1.0 - mixing.sum(axis=1))
    mixing *= rng.uniform((0.86, 0.96, 0.82), (0.98, 1.0, 0.95))[:, None]
    return (three(mixing[0]), three(mixing[1]), three(mixing[2]))


def _place(right_degrees: float, above_degrees: float, distance_m: float) -> Three:
    """World position at two angles, as seen from the object towards the audience."""
    right, above = np.deg2rad(right_degrees), np.deg2rad(above_degrees)
    return three(distance_m * np.array([np.sin(right) * np.cos(above), -np.sin(above), -np.cos(right) * np.cos(above)]))


def _aimed(
    position: Three, lens: Lens, points: Floats, fill: float, rng: np.random.Generator, middle: tuple[float, float]
) -> tuple[Pose, Lens]:
    """Turn and zoom a device so that ``points`` lie in the middle of its image and fill ``fill`` of it.

    The optical axis need not pass through the middle (lens shift), so direction and zoom are found together.
    """
    width, height = lens.size_px
    roll = float(np.deg2rad(rng.uniform(-1.0, 1.0)))
    image_middle = np.array([middle[0] * (width - 1), middle[1] * (height - 1)])
    target = np.zeros(3)
    lens = dataclasses.replace(lens, focal_px=1.8 * width)
    for _ in range(16):
        pose = Pose(position, _looking(np.asarray(position), target, roll))
        at, local = project(pose, lens, points)
        low, high = at.min(axis=0), at.max(axis=0)
        lens = dataclasses.replace(
            lens, focal_px=lens.focal_px * fill * float(min(width / (high[0] - low[0]), height / (high[1] - low[1])))
        )
        miss = (0.5 * (low + high) - image_middle) / lens.focal_px * float(np.mean(local[:, 2]))
        target = target + pose.rotation.T @ np.array([miss[0], miss[1], 0.0])
    return pose, lens


def _looking(position: Floats, target: Floats, roll: float) -> Three:
    from scipy.spatial.transform import Rotation

    forward = (target - position) / np.linalg.norm(target - position)
    right = np.cross((0.0, 1.0, 0.0), forward)
    right /= np.linalg.norm(right)
    matrix = np.stack((right, np.cross(forward, right), forward))
    return three(rotation_vector_of(Rotation.from_euler("z", roll).as_matrix() @ matrix))
