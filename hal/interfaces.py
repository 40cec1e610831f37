"""What each kind of device does. Nothing else lives here.

Every blocking call takes a ``Deadline`` and fails with an error of ``hal.errors``:
``DeviceGone``, ``DeviceBusy``, ``DeviceTimeout``, ``DeviceRefused`` or ``ProtocolError``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np
import numpy.typing as npt

from hal.deadline import Deadline
from hal.values import (
    CameraCapabilities,
    CameraStatus,
    CapturedFile,
    DeviceIdentity,
    ExposureSettings,
    OutputInfo,
    PanelCapabilities,
    PlaybackStatus,
    Presented,
    ProjectorCapabilities,
    ProjectorStatus,
)


@runtime_checkable
class Device(Protocol):
    """Anything that can be opened, named and closed. Opened by its driver (see ``hal.registry``)."""

    def identity(self, *, deadline: Deadline) -> DeviceIdentity:
        """Ask the device who it is."""

    def close(self) -> None:
        """Release the bus. Harmless when called twice; never blocks for more than a second; never raises."""


@runtime_checkable
class Projector(Device, Protocol):
    """A projector's control line (not its picture)."""

    @property
    def capabilities(self) -> ProjectorCapabilities: ...

    def status(self, *, deadline: Deadline) -> ProjectorStatus:
        """Power, faults and lamp hours as the device answers now; never a remembered answer."""

    def switch_on(self, *, deadline: Deadline) -> None:
        """Ask for power on; returns once the device has accepted (it may still warm up).

        Harmless when already on. Raises DeviceRefused while the lamp cools.
        """

    def switch_off(self, *, deadline: Deadline) -> None:
        """Ask for standby; returns once accepted (the fans may still cool the lamp). Harmless when already off."""

    def set_shutter(self, closed: bool, *, deadline: Deadline) -> None:
        """Block (AV mute) or pass the light. Raises DeviceRefused where ``capabilities.shutter`` is false."""


@runtime_checkable
class WatchedProjector(Projector, Protocol):
    """A projector whose driver tells what it could not understand."""

    def troubles(self) -> list[tuple[str, str]]:
        """What was odd since the last call, each thing once: (stable code, one sentence). Nothing of it stops work."""


@runtime_checkable
class Camera(Device, Protocol):
    """A still camera that can be triggered and read out over a cable."""

    @property
    def capabilities(self) -> CameraCapabilities: ...

    def configure(self, settings: ExposureSettings, *, deadline: Deadline) -> ExposureSettings:
        """Set exposure; return what the camera confirmed, which may be rounded to what it has.

        Raises
        ------
        DeviceRefused  the camera can't do these settings
        DeviceTimeout  no confirmation before the deadline
        """

    def capture(self, destination: Path, *, deadline: Deadline) -> list[CapturedFile]:
        """Take one picture; return its files, complete and fsynced. Never fires twice.

        ``destination`` is a path without suffix; each file gets the camera's suffix (``.dng``, ``.jpg``), written
        under a temporary name and renamed when whole.
        """


@runtime_checkable
class WatchedCamera(Camera, Protocol):
    """A camera that tells how long it can go on."""

    def status(self, *, deadline: Deadline) -> CameraStatus:
        """Battery, card and warnings as the camera answers now."""

    def troubles(self) -> list[tuple[str, str]]:
        """What went wrong and was mended since the last call: (stable code, one sentence), for the journal."""


@runtime_checkable
class LiveViewCamera(Camera, Protocol):
    """A camera that may show what it sees without taking a picture, for aiming: see ``capabilities.live_view``."""

    def live_view(self, *, deadline: Deadline) -> bytes:
        """One frame, a JPEG; the first one starts it. Raises DeviceRefused without ``capabilities.live_view``."""

    def end_live_view(self, *, deadline: Deadline) -> None:
        """Close the shutter again. Harmless when it is not on; ``capture`` does it by itself."""


@runtime_checkable
class Display(Device, Protocol):
    """All projector outputs together, as one: a set of frames appears on all of them at once."""

    def outputs(self, *, deadline: Deadline) -> tuple[OutputInfo, ...]:
        """The outputs in stage order."""

    def show(self, frames: Mapping[str, npt.NDArray[np.uint8]], *, deadline: Deadline) -> Presented:
        """Show one 8-bit frame an output, and return once all are presented.

        ``frames`` maps an output's name to (rows, columns, 3) uint8, device values (already linearised); an output
        that is not named shows black. Raises DeviceRefused for a wrong name, shape or dtype, before anything is shown.
        """

    def play(self, appearance: str, *, deadline: Deadline) -> Presented:
        """Show an appearance of the installed bundle by name. Raises DeviceRefused if it has none of that name."""


@runtime_checkable
class BundleDisplay(Display, Protocol):
    """A display that plays bundles by itself, at its own pace: the player."""

    def load_bundle(self, path: Path, *, deadline: Deadline) -> str:
        """Use another bundle from now on; return its identity (hex). Raises DeviceRefused for one it does not trust."""

    def play_sequence(
        self,
        items: Sequence[tuple[str, float] | tuple[str, float, float]],
        *,
        deadline: Deadline,
        repeat: int = 0,
        rate_hz: float | None = None,
    ) -> Presented:
        """Show appearances in turn, ``repeat`` times (0: for ever); return when the first is whole.

        Each is (name, seconds) or (name, seconds, fade_s); it comes in over the one before in the first ``fade_s``.
        """

    def stop(self, *, deadline: Deadline) -> Presented:
        """Show black."""

    def live(self, file: Path, *, deadline: Deadline, white: float | None = None) -> None:
        """Show what is written to a shared frame file as it comes, until something else is asked for.

        The file holds one 8-bit frame an output; with ``white`` it holds targets (sRGB) instead, whose white has this
        radiance, and the display makes the frames of the bundle's live section. Raises DeviceRefused where it can't.
        """

    def playing(self, *, deadline: Deadline) -> PlaybackStatus:
        """What is shown now, and how evenly."""


@runtime_checkable
class PowerSwitch(Device, Protocol):
    """Mains relays. The caller keeps the lamp rules; the driver only switches."""

    def channels(self, *, deadline: Deadline) -> int: ...

    def state(self, channel: int, *, deadline: Deadline) -> bool:
        """Whether the channel (1-based) is closed, i.e. passes current."""

    def switch(self, channel: int, closed: bool, *, deadline: Deadline) -> None: ...


@runtime_checkable
class LightSensor(Device, Protocol):
    """Ambient light at the object."""

    def illuminance_lux(self, *, deadline: Deadline) -> float: ...


@runtime_checkable
class ButtonPanel(Device, Protocol):
    """Keys for the technician."""

    @property
    def capabilities(self) -> PanelCapabilities: ...

    def show(self, key: int, picture: npt.NDArray[np.uint8], *, deadline: Deadline) -> None:
        """Put a picture on a key (0-based): (rows, columns, 3) uint8 sRGB of the size in ``capabilities``.

        It stays there, also after the panel was unplugged. Raises DeviceRefused for a key or a picture that does not
        fit, and where keys have no pictures.
        """

    def wait_pressed(self, *, deadline: Deadline) -> int | None:
        """The key pressed next (0-based), or None when the deadline passes. Presses are kept until asked for."""


class Bench(Protocol):
    """A whole emulated stage in a process of its own: what ``velatura emulate`` runs."""

    def prepare(self, stage: Path, *, size: str, object_file: Path | None, seed: int) -> Mapping[str, Any]:
        """Write the bench's own files into ``stage`` and return the device tables for stage.toml.

        The mapping has the stage.toml keys ``projectors`` (list), ``camera`` and ``display``, holding only what a
        technician of a real stage would know. The truth stays in the bench's own file, which no controller reads.
        """

    def disturb(self, stage: Path, changes: Sequence[Mapping[str, Any]]) -> None:
        """Do to a stage what somebody might: bump, dim or turn its things. Replaces what was done before; () mends all.

        Each change is a table that the bench explains; one that serves the stage follows within a second or two. Raises
        DeviceError for a change that it does not know.
        """

    def serve(self, stage: Path, *, json_lines: bool, scenario: Path | None = None) -> int:
        """Serve every device of ``stage`` until SIGINT/SIGTERM, printing each address; return the exit code.

        ``scenario``: a script of the faults that its devices shall have.
        """
