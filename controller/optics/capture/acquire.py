"""Show, wait, photograph: the one place where display and camera work together."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

from controller.core.arrays import ByteImage
from controller.core.errors import WorkError
from hal.deadline import Deadline
from hal.errors import DeviceError
from hal.interfaces import Camera, Display
from hal.values import CapturedFile, ExposureSettings, FileKind, Presented

if TYPE_CHECKING:  # it needs OpenCV, and a kiosk gets here before its first picture
    from controller.optics.capture.latency import Fingerprint

STORE_MARGIN_S = 5.0
"""Longest time that a camera may need beyond the exposure itself: mirror, write-out and transfer."""

UNMEASURED_S = 0.15
"""Seconds that are waited for a picture as long as its delay is not known and stage.toml says nothing."""

DISK_CODES = ("no-space", "cannot-write")
"""Error codes of a camera driver when this computer's disk fails."""


@dataclass(frozen=True, slots=True)
class Shot:
    """One photograph of one set of frames. ``name`` is unique in a run and names the file."""

    name: str
    frames: Mapping[str, ByteImage]
    exposure_s: float


@dataclass(frozen=True, slots=True)
class LastShown:
    """The last photograph of a row of pictures: its frames, what it shows, and the frames' number at the display."""

    frames: Mapping[str, ByteImage]
    shows: Fingerprint
    sequence: int


class Turns(Protocol):
    """The display where several cameras photograph its pictures at the same time."""

    def show(self, frames: Mapping[str, ByteImage], *, deadline: Deadline) -> Presented:
        """As ``Display.show``, when no other camera needs the picture before any more."""

    def done(self) -> None:
        """This camera has photographed the picture."""


class Acquirer:
    """Takes shots; sets the camera only when the exposure changes, and shows frames only when they change.

    Parameters
    ----------
    settle_s : least seconds between the display's report that frames are presented and the release of the shutter.
        Where the delay of the stage has been measured (``set_delay``), the longer of the two is waited, so that no
        photograph shows the pattern before. None: the measured delay alone
    turns : instead of ``display``, where other cameras photograph, too
    """

    def __init__(
        self,
        display: Display,
        camera: Camera,
        *,
        iso: int,
        aperture_f: float | None,
        settle_s: float | None,
        turns: Turns | None = None,
    ) -> None:
        self._display, self._turns = display, turns
        self._camera = camera
        self._iso = iso
        self._aperture_f = aperture_f
        self._settle_s = settle_s
        self._delay_s: float | None = None
        self._confirmed: tuple[float, ExposureSettings] | None = None
        self.last: LastShown | None = None
        """Set while one picture after the other is photographed, to find out whether one shows the previous picture."""

    @property
    def wait_s(self) -> float:
        """Seconds that are waited between presentation and shutter."""
        if self._settle_s is None:
            return UNMEASURED_S if self._delay_s is None else self._delay_s
        return max(self._settle_s, self._delay_s or 0.0)

    @property
    def protected(self) -> bool:
        """Whether the stage's delay is known; until then a late picture and a short wait look the same."""
        return self._delay_s is not None

    def set_delay(self, delay_s: float) -> None:
        """What was measured between presentation and a photograph that shows the picture (``capture.latency``)."""
        self._delay_s = delay_s

    def show(self, frames: Mapping[str, ByteImage], *, deadline: Deadline) -> float:
        """Show frames; return when they were presented, on the monotonic clock."""
        return self.present(frames, deadline=deadline).at_s

    def present(self, frames: Mapping[str, ByteImage], *, deadline: Deadline) -> Presented:
        """Show frames; return when they were presented, and their number among all that the display has shown."""
        if self._turns is not None:
            return self._turns.show(frames, deadline=deadline)
        return self._display.show(frames, deadline=deadline.within(10.0))

    def exposures_s(self) -> tuple[float, ...]:
        """The exposures that the camera offers, ascending, in seconds."""
        return self._camera.capabilities.exposures_s

    def take(
        self, shot: Shot, folder: Path, *, deadline: Deadline, wait_s: float | None = None
    ) -> tuple[CapturedFile, float]:
        """Show and photograph one shot into ``folder``; return as ``photograph``."""
        presented = self.present_for(shot, deadline=deadline)
        return self.photograph(
            shot.name, shot.exposure_s, folder, shown_at_s=presented.at_s, deadline=deadline, wait_s=wait_s
        )

    def present_for(self, shot: Shot, *, deadline: Deadline) -> Presented:
        """Show a shot's frames, with the camera set for it before: that takes a while, in which they would wait."""
        self._set(shot.exposure_s, deadline)
        return self.present(shot.frames, deadline=deadline)

    def photograph(
        self,
        name: str,
        exposure_s: float,
        folder: Path,
        *,
        shown_at_s: float,
        deadline: Deadline,
        wait_s: float | None = None,
    ) -> tuple[CapturedFile, float]:
        """Photograph what has been shown since ``shown_at_s`` (monotonic clock), ``wait_s`` after it (as ``wait_s``).

        Returns the RAW file (JPEG where there is no RAW) and the confirmed exposure in seconds.

        Raises
        ------
        WorkError("camera-no-file")  the camera sent nothing
        WorkError("no-space", "cannot-write")  the picture could not be stored
        and every error of the display and the camera
        """
        confirmed = self._set(exposure_s, deadline)
        waited_s = self.wait_s if wait_s is None else wait_s
        deadline.sleep(max(0.0, shown_at_s + waited_s - time.monotonic()))
        bound = deadline.within(2 * confirmed.exposure_s + self._camera.capabilities.picture_s + STORE_MARGIN_S)
        try:
            files = self._camera.capture(folder / name, deadline=bound)
        except DeviceError as error:
            if error.code not in DISK_CODES:
                raise
            # The camera did its part: this is no failing device.
            raise WorkError(error.code, what=error.what, remedy=error.remedy) from error
        finally:
            if self._turns is not None:
                self._turns.done()
        if not files:
            raise WorkError(
                "camera-no-file",
                what=f"The camera took picture {name} but sent no file.",
                remedy="Check its memory card and its image quality setting (RAW), then run the same command again to "
                "continue.",
            )
        raw = [file for file in files if file.kind is FileKind.RAW]
        return (raw or files)[0], confirmed.exposure_s

    def _set(self, exposure_s: float, deadline: Deadline) -> ExposureSettings:
        if self._confirmed is None or self._confirmed[0] != exposure_s:
            settings = ExposureSettings(
                exposure_s=exposure_s, iso=self._iso, aperture_f=self._aperture_f, raw=self._camera.capabilities.raw
            )
            self._confirmed = (exposure_s, self._camera.configure(settings, deadline=deadline.within(15.0)))
        return self._confirmed[1]
