"""The driver ``gpio-keys``: the technician's keys on GPIO lines, through the library gpiod (extra ``gpio``)."""

from __future__ import annotations

import contextlib
import errno
import queue
from collections.abc import Mapping
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from hal.deadline import Deadline, in_seconds
from hal.errors import DeviceGone, DeviceRefused
from hal.registry import Driver, OpenContext
from hal.values import TECHNICIAN_KEYS, DeviceIdentity, PanelCapabilities
from plugins.gpio.lines import EXPLAINED, KeySettings, Lines, check_chip, key_settings, opened
from plugins.worker_link import NotOpened, WorkerLink

_SLICE_S: Final = 0.1
_LOOK_S: Final = 5.0
_GONE: Final = frozenset({errno.ENOENT, errno.ENODEV, errno.EIO})
"""Not listed, just unplugged, or unplugged while it was asked."""
_MOST_WAITING: Final = 16
"""Number of presses that are kept until they are read; older ones are dropped."""


class GpioKeys(WorkerLink[Lines]):
    """``hal.interfaces.ButtonPanel`` whose keys have no pictures. A key counts when it is pressed, not when let go."""

    def __init__(self, settings: KeySettings, *, deadline: Deadline) -> None:
        super().__init__("GPIO chip", broken=(OSError,))
        self._settings = settings
        self._pressed: queue.SimpleQueue[int] = queue.SimpleQueue()
        try:
            self.identity(deadline=deadline)
        except BaseException:
            self.close()
            raise

    @property
    def capabilities(self) -> PanelCapabilities:
        return PanelCapabilities(len(TECHNICIAN_KEYS), None)

    def identity(self, *, deadline: Deadline) -> DeviceIdentity:
        def query(lines: Lines) -> DeviceIdentity:
            lines.check()
            return DeviceIdentity("GPIO", lines.label, lines.name)

        return self.call(query, deadline=deadline)

    def show(self, key: int, picture: npt.NDArray[np.uint8], *, deadline: Deadline) -> None:
        """See ``hal.interfaces.ButtonPanel.show``. Raises DeviceRefused("panel-no-pictures")."""
        raise DeviceRefused(
            "panel-no-pictures", what="Keys on GPIO lines show no pictures.", remedy="Label them by hand."
        )

    def wait_pressed(self, *, deadline: Deadline) -> int | None:
        """See ``hal.interfaces.ButtonPanel.wait_pressed``. Raises DeviceGone while its chip is not there."""
        while True:
            deadline.sleep(0.0)  # a cancelled wait ends
            with contextlib.suppress(queue.Empty):
                return self._pressed.get(timeout=min(_SLICE_S, deadline.left_s()) or 1e-6)
            if deadline.left_s() < _SLICE_S / 10:
                return None
            self.call(lambda lines: lines.check(), deadline=in_seconds(_LOOK_S, deadline.cancel))

    def find(self) -> Lines:
        """See ``WorkerLink.find``. Raises DeviceGone or DeviceRefused."""
        try:
            return opened(self._settings, self._heard)
        except ValueError as error:
            raise DeviceRefused(
                "gpio-no-line",
                what=f"{self._settings.chip} has no such line ({error}).",
                remedy="Write the number or name of a line that it has: `gpioinfo` lists them.",
            ) from error
        except OSError as error:
            if error.errno in _GONE:
                raise DeviceGone(
                    "gpio-gone",
                    what=f"There is no GPIO chip {self._settings.chip}.",
                    remedy="Check its cable, and the name of the chip: `gpiodetect` lists them.",
                ) from error
            raise NotOpened(
                "gpio-not-opened",
                what=f"The lines of {self._settings.chip} can't be used ({error.strerror}).",
                remedy="Put this user into the group gpio, and end other programs that use these lines.",
            ) from error

    def let_go(self, opened: Lines) -> None:
        opened.close()

    def _heard(self, key: int) -> None:
        """On the thread that reads the lines."""
        self._pressed.put(key)
        if self._pressed.qsize() > _MOST_WAITING:
            with contextlib.suppress(queue.Empty):
                self._pressed.get_nowait()


def check_keys(settings: Mapping[str, Any], context: OpenContext) -> None:
    """As ``hal.registry.Driver.check``."""
    key_settings(settings)


def open_keys(settings: Mapping[str, Any], context: OpenContext, deadline: Deadline) -> GpioKeys:
    """Open the keys of a stage's table."""
    found = key_settings(settings)
    check_chip()
    return GpioKeys(found, deadline=deadline)


DRIVER: Final = Driver(
    kind="button_panel",
    name="gpio-keys",
    summary="Keys on GPIO lines of this computer, or of a USB adapter (needs the extra gpio).",
    open=open_keys,
    settings=EXPLAINED,
    required=("chip", "keys"),
    check=check_keys,
)
