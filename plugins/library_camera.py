"""A camera whose library runs in a process of its own: the controller's side, the same for every such driver."""

from __future__ import annotations

from collections import deque
from pathlib import Path
from typing import Any, Final

from hal.deadline import Deadline
from hal.errors import DeviceGone
from hal.notices import Notice
from hal.values import CameraCapabilities, CameraStatus, CapturedFile, DeviceIdentity, ExposureSettings
from plugins.library_process import CRASHED, LibraryProcess, shot_lost

_MOST_NOTICES: Final = 1000
_MARGIN_S: Final = 1.0


class LibraryCamera:
    """``hal.interfaces.WatchedCamera`` on a ``LibraryProcess``.

    The worker has the methods ``capabilities``, ``identity``, ``configure`` and ``capture``, and sets its exposure
    again when it opens the camera again. ``module``, ``library``, ``start``, ``serial``: as for ``LibraryProcess``.
    """

    def __init__(self, module: str, library: str, *, start: tuple[Any, ...], serial: str, deadline: Deadline) -> None:
        self._notices: deque[Notice] = deque(maxlen=_MOST_NOTICES)
        self.process = LibraryProcess(
            module,
            library,
            start=start,
            serial=serial,
            note=self._notices.append,
        )
        self._settings: ExposureSettings | None = None
        self._configured: int | None = None
        """The process that has these settings."""
        try:
            self._capabilities: CameraCapabilities = self.process.request("capabilities", deadline=deadline)
        except BaseException:
            self.close()
            raise

    @property
    def capabilities(self) -> CameraCapabilities:
        return self._capabilities

    def identity(self, *, deadline: Deadline) -> DeviceIdentity:
        identity: DeviceIdentity = self.process.request("identity", deadline=deadline)
        return identity

    def status(self, *, deadline: Deadline) -> CameraStatus:
        """It has neither battery nor card; raises DeviceGone where it is not there."""
        self.identity(deadline=deadline)
        return CameraStatus()

    def notices(self) -> list[Notice]:
        return [self._notices.popleft() for _ in range(len(self._notices))]

    def configure(self, settings: ExposureSettings, *, deadline: Deadline) -> ExposureSettings:
        confirmed: ExposureSettings = self.process.request("configure", settings, deadline=deadline)
        self._settings, self._configured = confirmed, self.process.pid
        return confirmed

    def capture(self, destination: Path, *, deadline: Deadline) -> list[CapturedFile]:
        """See ``hal.interfaces.Camera.capture``. Raises DeviceGone("camera-shot-lost") where the process ended."""
        try:
            if self._settings is not None and self.process.pid != self._configured:
                # The process was ended, perhaps also started again by another request: its exposure is forgotten.
                self.configure(self._settings, deadline=deadline)
            left_s = deadline.left_s()
            # The worker ends before the caller does: it knows why there is no picture.
            theirs_s = left_s - min(_MARGIN_S, left_s / 5)
            files: list[CapturedFile] = self.process.request(
                "capture", destination.absolute(), theirs_s, deadline=deadline, repeatable=False
            )
        except DeviceGone as error:
            if error.code != CRASHED:
                raise
            raise shot_lost(error) from error
        return files

    def close(self) -> None:
        self.process.close()
