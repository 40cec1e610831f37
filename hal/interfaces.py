"""The interfaces of all kinds of devices.

Every blocking call takes a ``Deadline`` and fails with an error of ``hal.errors``:
``DeviceGone``, ``DeviceBusy``, ``DeviceTimeout``, ``DeviceRefused`` or ``ProtocolError``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

from hal.deadline import Deadline
from hal.notices import Notice
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

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt


@runtime_checkable
class Device(Protocol):
    """Anything that can be opened, named and closed. Opened by its driver (see ``hal.registry``)."""

    def identity(self, *, deadline: Deadline) -> DeviceIdentity:
        """Ask the device for its identity."""

    def close(self) -> None:
        """Release the bus. May be called twice; never blocks for more than a second; never raises."""


@runtime_checkable
class Projector(Device, Protocol):
    """A projector's control line (not its picture)."""

    @property
    def capabilities(self) -> ProjectorCapabilities: ...

    def status(self, *, deadline: Deadline) -> ProjectorStatus:
        """Power and faults as the device answers now, never a stored answer; lamp hours may be an hour old."""

    def switch_on(self, *, deadline: Deadline) -> None:
        """Ask for power on; returns once the device has accepted (it may still warm up).

        No effect if it is on already. Raises DeviceRefused while the lamp cools.
        """

    def switch_off(self, *, deadline: Deadline) -> None:
        """Ask for standby; returns once accepted (the fans may still cool the lamp). No effect if it is off already."""

    def set_shutter(self, closed: bool, *, deadline: Deadline) -> None:
        """Block (AV mute) or pass the light. Raises DeviceRefused if ``capabilities.shutter`` is false."""


@runtime_checkable
class WatchedProjector(Projector, Protocol):
    """A projector whose driver reports answers that it could not understand."""

    def notices(self) -> list[Notice]:
        """Unexpected answers since the last call, each once. They do not stop the work."""


@runtime_checkable
class AdjustedProjector(Projector, Protocol):
    """A projector whose driver can read what people adjust in its menus."""

    def adjustments(self, *, deadline: Deadline) -> dict[str, str]:
        """What it tells now of "input", "keystone" and "lamp mode", in its own words.

        What its protocol does not have, or what it does not tell now (many answer only while lit), is left out.
        """


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
        under a temporary name and renamed when whole. A folder that does not exist is made.
        """


@runtime_checkable
class WatchedCamera(Camera, Protocol):
    """A camera that reports its battery and card."""

    def status(self, *, deadline: Deadline) -> CameraStatus:
        """Battery, card and warnings as the camera answers now."""

    def notices(self) -> list[Notice]:
        """Corrected faults since the last call, for the journal."""


@runtime_checkable
class LiveViewCamera(Camera, Protocol):
    """A camera that may have live view, for aiming: see ``capabilities.live_view``."""

    def live_view(self, *, deadline: Deadline) -> bytes:
        """One frame, a JPEG; the first one starts it. Raises DeviceRefused without ``capabilities.live_view``."""

    def end_live_view(self, *, deadline: Deadline) -> None:
        """End live view. No effect if it is off; ``capture`` does it automatically."""


@runtime_checkable
class Display(Device, Protocol):
    """All projector outputs together, as one: a set of frames appears on all of them at once."""

    def outputs(self, *, deadline: Deadline) -> tuple[OutputInfo, ...]:
        """The outputs in stage order."""

    def show(self, frames: Mapping[str, npt.NDArray[np.uint8]], *, deadline: Deadline) -> Presented:
        """Show one 8-bit frame per output, and return once all are presented.

        ``frames`` maps an output's name to (rows, columns, 3) uint8, device values (already linearised); an output
        without a frame shows black. Raises DeviceRefused for a wrong name, shape or dtype, before anything is shown.
        """

    def play(self, appearance: str, *, deadline: Deadline) -> Presented:
        """Show an appearance of the installed bundle by name. Raises DeviceRefused if it has none of that name."""


@runtime_checkable
class BundleDisplay(Display, Protocol):
    """A display that plays bundles by itself: the player."""

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
        """Show appearances one after the other, ``repeat`` times (0: without end); return when the first is complete.

        Each is (name, seconds) or (name, seconds, fade_s); it fades in during the first ``fade_s``.
        """

    def stop(self, *, deadline: Deadline) -> Presented:
        """Show black."""

    def live(self, file: Path, *, deadline: Deadline, white: float | None = None) -> None:
        """Show pictures live from a shared frame file, until the next command.

        The file has one 8-bit frame per output; with ``white`` it has targets (sRGB) instead, whose white has this
        radiance, and the display makes the frames with the bundle's live section. Raises DeviceRefused if it can't.
        """

    def playing(self, *, deadline: Deadline) -> PlaybackStatus:
        """What is shown now, and the timing."""


@runtime_checkable
class PowerSwitch(Device, Protocol):
    """Mains relays. The caller keeps the lamp rules; the driver only switches."""

    def channels(self, *, deadline: Deadline) -> int: ...

    def state(self, channel: int, *, deadline: Deadline) -> bool:
        """Whether the channel (1-based) is closed, i.e. passes current."""

    def switch(self, channel: int, closed: bool, *, deadline: Deadline) -> None: ...


@runtime_checkable
class Douser(Device, Protocol):
    """A mechanical shutter before a projector's lens."""

    def move(self, closed: bool, *, deadline: Deadline) -> None:
        """Block or pass the light; returns when the blades are there, as far as the driver can know. Repeatable."""

    def closed(self, *, deadline: Deadline) -> bool | None:
        """Whether it is closed, or was last set so if it can't be read; None: unknown, because it was never set.

        Raises DeviceGone if it can't be commanded now.
        """


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

        It stays there, also after the panel was unplugged. Raises DeviceRefused for a wrong key or picture,
        and for keys without pictures.
        """

    def wait_pressed(self, *, deadline: Deadline) -> int | None:
        """The next pressed key (0-based), or None when the deadline passes. Presses are kept until they are read."""


class Bench(Protocol):
    """A whole emulated stage in its own process, for ``velatura emulate``."""

    def prepare(self, stage: Path, *, size: str, object_file: Path | None, seed: int) -> Mapping[str, Any]:
        """Write the bench's own files into ``stage`` and return the device tables for stage.toml.

        The mapping has the stage.toml keys ``projectors`` (list), ``camera`` and ``display``, holding only what a
        technician of a real stage would know. The truth stays in the bench's own file, never read by the controller.
        What the owner of a built-in object has, a picture or a scan of it, lies as files in ``stage``.
        """

    def disturb(self, stage: Path, changes: Sequence[Mapping[str, Any]]) -> None:
        """Change a stage: bump, dim or turn its parts. Replaces earlier changes; () undoes all.

        Each change is a table that the bench explains; a running bench applies it within two seconds. Raises
        DeviceError for an unknown change.
        """

    def serve(self, stage: Path, *, json_lines: bool, scenario: Path | None = None) -> int:
        """Serve every device of ``stage`` until SIGINT/SIGTERM, printing each address; return the exit code.

        ``scenario``: a script of faults of its devices.
        """

    def replay(self, tape: Path, *, json_lines: bool) -> int:
        """Serve the devices of a tape (``hal.tape``) until SIGINT/SIGTERM, as ``serve``."""
