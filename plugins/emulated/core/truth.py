"""What the emulated stage really is: ``bench.toml``. Only the bench reads it; nothing in it reaches the controller.

World: metres, right-handed, origin in the middle of the object, x to the right, y down, z away from the audience.
A device's own frame is that of its lens: x right, y down, z along the optical axis. Pixel centres at whole numbers.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Final, TypeAlias

import numpy as np
import numpy.typing as npt

from hal.errors import DeviceError
from hal.runtime.files import read_text
from plugins.emulated.core.tables import Between, OneOf, dump, load

Bands: TypeAlias = tuple[tuple[float, float], tuple[float, float], tuple[float, float]]
"""Red, green and blue by wavelength: peak and standard deviation in nm."""
NO_BANDS: Bands = ((0.0, 0.0), (0.0, 0.0), (0.0, 0.0))


@dataclass(frozen=True, slots=True)
class Varnish:
    """A rough varnish on the object. ``strength``: 0 without one, 1 all over it; ``roughness``: alpha of GGX;

    ``index``: of refraction
    """

    strength: Annotated[float, Between(0.0, 1.0)] = 0.0
    roughness: Annotated[float, Between(0.02, 1.0)] = 0.3
    index: Annotated[float, Between(1.01, 3.0)] = 1.5


@dataclass(frozen=True, slots=True)
class Subsurface:
    """Light that spreads in the object's material. ``share``: of the light; ``spread_m``: diffusion length."""

    share: Annotated[float, Between(0.0, 1.0)] = 0.0
    spread_m: Annotated[float, Between(1e-5, 0.05)] = 0.0015


@dataclass(frozen=True, slots=True)
class Dithering:
    """A panel that makes levels by turns.

    ``levels``: in one frame, 0 without dithering; ``turns``: frames; ``frame_s``: of one
    """

    levels: Annotated[int, Between(0, 65536)] = 0
    turns: Annotated[int, Between(1, 64)] = 4
    frame_s: Annotated[float, Between(1e-4, 1.0)] = 1.0 / 60.0


BARE, OPAQUE, STEADY = Varnish(), Subsurface(), Dithering()
"""Without the effects."""


Two: TypeAlias = tuple[float, float]
Three: TypeAlias = tuple[float, float, float]
Matrix: TypeAlias = tuple[Three, Three, Three]
FILE_NAME: Final = "bench.toml"
FOLDER: Final = "bench"
DEFAULT_BOARD: Final = "optoma-later"
BUMPS_FILE: Final = f"{FOLDER}/bumps.toml"
USB_FILE: Final = f"{FOLDER}/usb.toml"
ENGINES: Final = ("direct", "radiosity", "mitsuba")
"""Of light between surfaces."""


def three(values: npt.NDArray[np.float64]) -> Three:
    """The numbers of an array (3,)."""
    a, b, c = (float(value) for value in values)
    return (a, b, c)


def matrix_of(rotation_vector: Three | npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """(3, 3) rotation by a Rodrigues vector (3,) in radians."""
    from scipy.spatial.transform import Rotation  # many that start the emulated devices turn nothing

    return np.asarray(Rotation.from_rotvec(rotation_vector).as_matrix(), dtype=np.float64)


def rotation_vector_of(matrix: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """(3,) Rodrigues vector in radians of a rotation (3, 3)."""
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_matrix(matrix).as_rotvec())


@dataclass(frozen=True, slots=True)
class Pose:
    """Where a device stands: x_device = R(rotation_vector) (x_world - position_m), Rodrigues vector in radians."""

    position_m: Three
    rotation_vector: Three

    @property
    def rotation(self) -> npt.NDArray[np.float64]:
        """(3, 3) world to device."""
        return matrix_of(self.rotation_vector)


@dataclass(frozen=True, slots=True)
class Lens:
    """Pinhole with two radial terms: x_px = focal_px * x (1 + k1 r^2 + k2 r^4) + centre, x = X/Z."""

    size_px: Annotated[tuple[int, int], Between(1, 16384)]
    focal_px: Annotated[float, Between(1.0, 1e6)]
    centre_px: Annotated[Two, Between(-1e5, 1e5)]
    distortion: Annotated[Two, Between(-1.0, 1.0)]


@dataclass(frozen=True, slots=True)
class Sensor:
    """A 12-bit Bayer sensor (RGGB). ``electrons_per_light_s``: photo-electrons of linear light 1 in 1 s at f/8;

    ``electrons_per_step``: of one raw step at ISO 100; ``contrast``: how far the JPEG tone curve leaves sRGB;
    ``response_spread``: of pixels, relative; ``hot_pixels``: their share; ``shutter_spread``: of exposure times round
    what the camera says, relative, the same at each time for the same speed; ``noise``: factor on all of the noise,
    shot noise and read noise alike.
    """

    electrons_per_light_s: Annotated[float, Between(1.0, 1e9)]
    electrons_per_step: Annotated[float, Between(0.01, 1e4)]
    full_well_e: Annotated[float, Between(100.0, 1e7)]
    read_noise_e: Annotated[float, Between(0.0, 1e3)]
    black_level: Annotated[int, Between(0, 1023)]
    white_level: Annotated[int, Between(1024, 4095)]
    contrast: Annotated[float, Between(0.0, 0.9)] = 0.25
    response_spread: Annotated[float, Between(0.0, 0.3)] = 0.0
    hot_pixels: Annotated[float, Between(0.0, 0.1)] = 0.0
    shutter_spread: Annotated[float, Between(0.0, 0.3)] = 0.0
    noise: Annotated[float, Between(0.0, 1e3)] = 1.0


@dataclass(frozen=True, slots=True)
class CameraTruth:
    """The camera. ``vignetting``: share of light lost in the image's corners; ``raw``: False makes JPEG files only.

    ``glare``: share of the light that its lens spreads over the whole picture (``effects.flaws.veiled``);
    ``focus_m``: where along its axis it is focused, 0: all is sharp (``effects.depth_of_field``);
    ``bands_nm``: its filters, without which its colours are those of sRGB (``effects.spectra``);
    ``name``: of its view;
    ``tint``: the sensitivity of its colours, which it does not know;
    ``picture_s``: a picture takes at least so long from the release to its file, in seconds of the clock.
    """

    pose: Pose
    lens: Lens
    sensor: Sensor
    serial_number: str
    command_port: Annotated[int, Between(0, 65535)]
    event_port: Annotated[int, Between(0, 65535)]
    psf_sigma_px: Annotated[float, Between(0.0, 10.0)]
    vignetting: Annotated[float, Between(0.0, 0.95)]
    raw: bool = True
    glare: Annotated[float, Between(0.0, 0.5)] = 0.0
    focus_m: Annotated[float, Between(0.0, 100.0)] = 0.0
    bands_nm: Annotated[Bands, Between(0.0, 2000.0)] = NO_BANDS
    picture_s: Annotated[float, Between(0.0, 60.0)] = 0.0
    name: str = "camera"
    tint: Annotated[Three, Between(0.1, 10.0)] = (1.0, 1.0, 1.0)

    @property
    def spectral(self) -> bool:
        return all(width > 0.0 for _, width in self.bands_nm)


@dataclass(frozen=True, slots=True)
class Focus:
    """Blur in projector pixels: sqrt(sharpest^2 + (slope (z - distance))^2), z along the axis."""

    distance_m: Annotated[float, Between(0.01, 100.0)]
    sharpest_px: Annotated[float, Between(0.0, 3.0)]
    slope_px_per_m: Annotated[float, Between(0.0, 1000.0)]


@dataclass(frozen=True, slots=True)
class LightTruth:
    """Lamp and panel.

    ``brightness``: linear light of white on a white plane facing the lens at ``reference_m``;
    ``mixing``: camera channel (row) by projector channel (column), lamp colour included;
    ``gamma``, ``s_curve``: response per channel, see ``render.response``; ``black_level``: share of white at value 0;
    ``glare``: share of the light that the lens spreads over the whole picture; ``white_segment``: of a colour wheel,
    which adds so many times the least of the three channels to each of them, so that colours do not add up to white;
    ``shadow``: share of the picture's width, from its left, in which a visitor's body keeps the light; ``dent``: share
    of the light that its medium levels lack (``render.DENT``);
    ``bands_nm``: the light of its channels by wavelength, where the camera has bands, too: white light then has the
    colour of ``mixing``, the rest of which does not count
    """

    brightness: Annotated[float, Between(0.0, 1e3)]
    reference_m: Annotated[float, Between(0.01, 100.0)]
    black_level: Annotated[float, Between(0.0, 0.5)]
    vignetting: Annotated[float, Between(0.0, 0.95)]
    fill_factor: Annotated[float, Between(0.01, 1.0)]
    gamma: Annotated[Three, Between(0.5, 4.0)]
    s_curve: Annotated[Three, Between(0.0, 0.5)]
    mixing: Annotated[Matrix, Between(0.0, 2.0)]
    glare: Annotated[float, Between(0.0, 0.5)] = 0.0
    white_segment: Annotated[float, Between(0.0, 2.0)] = 0.0
    shadow: Annotated[float, Between(0.0, 1.0)] = 0.0
    dent: Annotated[float, Between(0.0, 0.2)] = 0.0
    bands_nm: Annotated[Bands, Between(0.0, 2000.0)] = NO_BANDS


@dataclass(frozen=True, slots=True)
class LampTruth:
    """Seconds from strike to full light, from strike to stable light, and from off to cool.

    ``flicker``: spread of its light in short exposures, relative; ``drift``: so much more light it has at first, which
    falls by e in each ``drift_s`` after the strike.
    """

    warm_up_s: Annotated[float, Between(0.0, 3600.0)]
    stable_s: Annotated[float, Between(0.0, 3600.0)]
    cool_down_s: Annotated[float, Between(0.0, 3600.0)]
    flicker: Annotated[float, Between(0.0, 0.3)] = 0.0
    drift: Annotated[float, Between(-0.5, 0.5)] = 0.0
    drift_s: Annotated[float, Between(1.0, 1e5)] = 300.0


@dataclass(frozen=True, slots=True)
class Panels:
    """Where the pictures of red, green and blue lie: shifted by projector pixels (x, y), and larger by a share.

    ``shift_px``: panels that are not aligned; ``magnified``: lateral chromatic aberration, from the lens' axis.
    """

    shift_px: Annotated[tuple[Two, Two, Two], Between(-3.0, 3.0)] = ((0.0, 0.0), (0.0, 0.0), (0.0, 0.0))
    magnified: Annotated[Three, Between(-0.01, 0.01)] = (0.0, 0.0, 0.0)

    @property
    def aligned(self) -> bool:
        return not (any(self.magnified) or any(any(shift) for shift in self.shift_px))


@dataclass(frozen=True, slots=True)
class ProjectorTruth:
    """A projector; ``port`` and ``profile`` are relative to the stage folder.

    ``board``: the family whose control board it has; ``tcp_port``: it is reached by its own LAN port on this computer,
    with the login of its family and ``password``, and not by a serial line. Boards other than the default, and LAN
    ports, are in velatura-lab. ``frames``: the memory output of its own player, if that is not the stage's; ``late_s``:
    its light comes so much later than ``latency_s`` says (``lab.emulated.outputs``).
    """

    name: str
    output: str
    port: str
    profile: str
    pose: Pose
    lens: Lens
    focus: Focus
    light: LightTruth
    lamp: LampTruth
    panels: Panels = Panels()
    dithering: Dithering = STEADY
    board: str = DEFAULT_BOARD
    tcp_port: Annotated[int, Between(0, 65_535)] = 0
    password: str = ""
    frames: str = ""
    late_s: Annotated[float, Between(0.0, 1.0)] = 0.0


@dataclass(frozen=True, slots=True)
class ObjectTruth:
    """``kind`` is ``vase-and-bust``, ``mesh`` or a name of ``optics.scenes``; ``file``, relative to the stage folder,
    has its triangles.

    Without ``file`` the vase and the bust are computed again, which takes seconds.

    ``gloss``: strength of its highlights (Blinn and Phong, normalised): light added where the surface mirrors a lens
    into the camera, relative to a perfect white; ``gloss_exponent``: how small they are. ``varnish`` and
    ``subsurface``: see ``effects``; ``metal``: share of its height, from its top, that is polished like a mirror
    """

    kind: str
    file: str
    seed: Annotated[int, Between(0, 2**63 - 1)]
    gloss: Annotated[float, Between(0.0, 1.0)] = 0.0
    gloss_exponent: Annotated[float, Between(1.0, 1e4)] = 60.0
    varnish: Varnish = BARE
    subsurface: Subsurface = OPAQUE
    metal: Annotated[float, Between(0.0, 1.0)] = 0.0


@dataclass(frozen=True, slots=True)
class SurfaceTruth:
    """A flat part of the room, table or wall: a parallelogram from ``corner_m``; ``albedo`` on both sides."""

    name: str
    corner_m: Annotated[Three, Between(-100.0, 100.0)]
    across_m: Annotated[Three, Between(-100.0, 100.0)]
    along_m: Annotated[Three, Between(-100.0, 100.0)]
    albedo: Annotated[Three, Between(0.0, 0.95)]


@dataclass(frozen=True, slots=True)
class MainsTruth:
    """A relay and whose mains go through it. ``relay``: the board's name in bench/usb.toml; ``feeds``: projectors;

    ``boot_s``: from mains on until they accept commands.
    """

    relay: str
    channel: Annotated[int, Between(1, 8)]
    feeds: tuple[str, ...]
    boot_s: Annotated[float, Between(0.0, 600.0)] = 0.0


@dataclass(frozen=True, slots=True)
class DouserTruth:
    """A douser on a DMX node that hears sACN at UDP ``port``. ``covers``: the projector whose lens it stands before.

    ``travel_s``: of its blades, which are open at level 128 and above; ``lost``: what the node does without a signal.
    """

    port: Annotated[int, Between(1, 65535)]
    universe: Annotated[int, Between(1, 63999)]
    channel: Annotated[int, Between(1, 512)]
    covers: str
    travel_s: Annotated[float, Between(0.0, 60.0)] = 0.5
    lost: Annotated[str, OneOf("close", "hold")] = "close"


@dataclass(frozen=True, slots=True)
class BenchTruth:
    """A whole emulated stage. ``subsamples``: S x S rays a camera pixel; ``time_scale``: emulated / real duration;

    ``latency_s``: from a frame's presentation to its light, real seconds (projectors: one to eight frames, the stage's
    default is two).

    ``scenario``: faults on the projectors' wires (by velatura-lab), a file relative to the stage folder;
    ``mains``: which emulated relays feed which projectors, whose mains are on otherwise; ``dousers``: closed at first;
    ``indirect``: the share of all projected light that object and room throw back evenly on the object.

    ``surfaces``: of the room round the object; ``engine``: "direct" for light straight from the projectors alone,
    "radiosity" for light between object and surfaces, too, which counts it on so many ``patches``, "mitsuba" for the
    same along so many ``paths`` from each small spot of the picture through a scene of Mitsuba 3.
    ``more_cameras``: beside ``camera``, photographing from elsewhere.
    """

    size: str
    frames: str
    ambient: Annotated[Three, Between(0.0, 10.0)]
    latency_s: Annotated[float, Between(0.0, 1.0)]
    time_scale: Annotated[float, Between(0.0, 1.0)]
    seed: Annotated[int, Between(0, 2**63 - 1)]
    subsamples: Annotated[int, Between(1, 8)]
    object: ObjectTruth
    camera: CameraTruth
    projectors: tuple[ProjectorTruth, ...]
    scenario: str = ""
    mains: tuple[MainsTruth, ...] = ()
    dousers: tuple[DouserTruth, ...] = ()
    indirect: Annotated[float, Between(0.0, 1.0)] = 0.0
    surfaces: tuple[SurfaceTruth, ...] = ()
    engine: Annotated[str, OneOf(*ENGINES)] = "direct"
    patches: Annotated[int, Between(10, 20000)] = 2000
    paths: Annotated[int, Between(1, 100000)] = 256
    more_cameras: tuple[CameraTruth, ...] = ()

    @property
    def cameras(self) -> tuple[CameraTruth, ...]:
        """All of them, the first one first."""
        return (self.camera, *self.more_cameras)

    def seen_by(self, camera: CameraTruth) -> BenchTruth:
        """The same stage with this camera alone; no two have the same noise."""
        number = self.cameras.index(camera)
        return replace(self, camera=camera, more_cameras=(), seed=self.seed + NEXT_CAMERA * number)


NEXT_CAMERA: Final = 7919
"""Added to the seed for each further camera."""


def write_truth(stage: Path, truth: BenchTruth) -> None:
    """Write ``bench.toml`` in one step; a reader finds the old or the new file."""
    stage.mkdir(parents=True, exist_ok=True)
    temporary = stage / f".{FILE_NAME}.part"
    temporary.write_text("# The truth of the emulated stage. The controller never reads this file.\n" + dump(truth))
    temporary.replace(stage / FILE_NAME)


def read_truth(stage: Path) -> BenchTruth:
    """Read ``bench.toml`` of a stage. Raises DeviceError as ``tables.load``, or ``bench-file-missing``."""
    path = stage / FILE_NAME
    try:
        text = read_text(path)
    except (OSError, UnicodeDecodeError) as error:
        raise DeviceError(
            "bench-file-missing",
            what=f"{path} can't be read, so there is no emulated stage here.",
            remedy="Prepare a stage first: velatura demo --prepare-only --out DIR.",
        ) from error
    return load(text, BenchTruth, file=str(path))
