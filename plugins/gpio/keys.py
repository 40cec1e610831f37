"""The driver ``gpio-keys``: the technician's keys on GPIO lines, through the library gpiod (extra ``gpio``). Edges come
where the chip has interrupts; else the lines are read again and again.
"""

from __future__ import annotations

import contextlib
import errno
import queue
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from hal.codecs.ptp.values import printable
from hal.deadline import Deadline, in_seconds
from hal.errors import DeviceGone, DeviceRefused, PluginError
from hal.registry import Driver, OpenContext, setting
from hal.values import TECHNICIAN_KEYS, DeviceIdentity, PanelCapabilities
from plugins.worker_link import NotOpened, WorkerLink

PULLS: Final = ("", "up", "down", "none")
_DOES: Final = TECHNICIAN_KEYS[1:]
EXPLAINED: Final = {
    "chip": "the GPIO chip: /dev/gpiochip0, or its label, such as cp2112_gpio",
    "keys": "a list of tables: line (its number or name), does (play, stop or recalibrate), active_low (default true)",
    "debounce_ms": "milliseconds for which a key must stay as it is: 1 to 500 (default 20)",
    "pull": 'the resistor in the chip: "up", "down" or "none" (default: as it is)',
}


@dataclass(frozen=True, slots=True)
class KeySettings:
    """``keys``: for each line its number or name, the key that it is, and whether it is pressed at a low level."""

    chip: str
    keys: tuple[tuple[int | str, int, bool], ...]
    debounce_s: float
    pull: str


def key_settings(settings: Mapping[str, Any]) -> KeySettings:
    """Raises PluginError for what can't be used."""
    debounce_ms = setting(settings, "debounce_ms", int, 20)
    pull = setting(settings, "pull", str, "")
    tables = setting(settings, "keys", list, [])
    keys = tuple(_key(table) for table in tables)
    if not keys or len({line for line, _, _ in keys}) < len(keys) or not 1 <= debounce_ms <= 500 or pull not in PULLS:
        raise _wrong("The keys, debounce_ms or pull of the key panel are wrong.")
    return KeySettings(setting(settings, "chip", str, ""), keys, debounce_ms / 1000, pull)


def _key(table: object) -> tuple[int | str, int, bool]:
    if not isinstance(table, Mapping) or table.keys() - {"line", "does", "active_low"}:
        raise _wrong("A key of the key panel is no table of line, does and active_low.")
    line, does, active_low = table.get("line"), table.get("does"), table.get("active_low", True)
    number = isinstance(line, int) and not isinstance(line, bool) and line >= 0
    sound = number or (isinstance(line, str) and line != "")
    if not sound or does not in _DOES or not isinstance(active_low, bool):
        raise _wrong(f"The key on line {line!r} can't be used.")
    assert isinstance(line, int | str)
    return line, TECHNICIAN_KEYS.index(does), active_low


def _wrong(what: str) -> PluginError:
    return PluginError(
        "key-setting",
        what=what,
        remedy=f"Write a line and one of {', '.join(_DOES)} for each key, each line once; 1 to 500 for debounce_ms; up,"
        " down or none for pull.",
    )


_LEVEL_LOOK_S: Final = 0.005
_WAIT_S: Final = 0.2
_CLOSE_S: Final = 0.6
_SILENT_S: Final = 10.0
"""A USB adapter may need some seconds for an answer, and its driver gives up only after several of them."""
_NOT_NOW: Final = frozenset({errno.EAGAIN, errno.ETIMEDOUT})
"""An adapter that was busy or missed one question; its lines are looked at again."""
_NO_EDGES: Final = frozenset({errno.ENXIO, errno.EINVAL, errno.EOPNOTSUPP, errno.ENOSYS, 524})
"""What the kernel answers where a chip has no interrupts; 524 is its own ENOTSUPP."""
_CONSUMER: Final = "velatura"


def check_chip() -> None:
    """Raises PluginError("gpiod-missing") without the library."""
    try:
        import gpiod  # noqa: F401
    except ImportError as error:
        raise PluginError(
            "gpiod-missing",
            what=f"The library for GPIO lines could not be loaded: {error}.",
            remedy="Install it: pip install 'velatura[gpio]'.",
        ) from error


class Lines:
    """Requested lines and the thread that reads them.

    ``edges``: whether the chip reports changes by itself; ``silent_s``: a chip that is silent for longer is lost.
    """

    def __init__(self, chip: Any, request: Any, keys: Mapping[int, int], heard: Callable[[int], None], *,
                 debounce_s: float, edges: bool, silent_s: float = _SILENT_S) -> None:  # fmt: skip
        info = chip.get_info()
        self.name, self.label = printable(info.name), printable(info.label)
        self.edges = edges
        self._chip, self._request, self._keys, self._heard = chip, request, keys, heard
        self._debounce_s, self._silent_s = debounce_s, silent_s
        self._lost: OSError | None = None
        self._answered_s = time.monotonic()
        # A key that is pressed from now on counts.
        self._pressed = self._values(list(keys))
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._run, name="gpio keys", daemon=True)
        self._thread.start()

    def check(self) -> None:
        """Raises OSError for a chip that went, or does not answer.

        The lines are read on one thread alone: some drivers mix up the answers to two programs that ask at once.
        """
        if self._lost is not None:
            raise self._lost
        if time.monotonic() > self._answered_s + self._silent_s:
            raise OSError(errno.ETIMEDOUT, "no answer")

    def close(self) -> None:
        """The lines are free when their thread has ended, mostly at once."""
        self._end.set()
        self._thread.join(_CLOSE_S)

    def _run(self) -> None:
        try:
            self._read()
        except OSError as error:
            self._lost = error
        finally:
            # By the thread that reads: the library may not free what is in use.
            with contextlib.suppress(OSError):
                self._request.release()
            self._chip.close()

    def _read(self) -> None:
        while not self._end.is_set():
            if self.edges and self._request.wait_edge_events(timedelta(seconds=_WAIT_S)):
                self._request.read_edge_events()
            # Also without an edge, so that a chip that went is found soon.
            try:
                self._settle()
            except OSError as error:
                if error.errno not in _NOT_NOW:
                    raise
                self._end.wait(_LEVEL_LOOK_S)

    def _settle(self) -> None:
        """Look until each line has been the same for the time of debouncing; report those that are pressed since."""
        offsets = list(self._keys)
        values, since_s = self._values(offsets), time.monotonic()
        while time.monotonic() < since_s + self._debounce_s and not self._end.wait(_LEVEL_LOOK_S):
            now = self._values(offsets)
            if now != values:
                values, since_s = now, time.monotonic()
        for line in offsets:
            if values[line] and not self._pressed[line]:
                self._heard(self._keys[line])
        self._pressed = values

    def _values(self, offsets: list[int]) -> dict[int, bool]:
        from gpiod.line import Value

        values = self._request.get_values(offsets)
        self._answered_s = time.monotonic()
        return {line: value == Value.ACTIVE for line, value in zip(offsets, values, strict=True)}


def opened(settings: KeySettings, heard: Callable[[int], None]) -> Lines:
    """Request the lines; ``heard`` is called with each key that is pressed.

    Raises OSError; ValueError for a line that the chip lacks.
    """
    import gpiod

    chip = gpiod.Chip(str(_chip(settings.chip)))
    try:
        keys = {chip.line_offset_from_id(line): key for line, key, _ in settings.keys}
        low = {chip.line_offset_from_id(line): active_low for line, _, active_low in settings.keys}
        try:
            request, edges = _requested(chip, settings, low, edges=True), True
        except OSError as error:
            if error.errno not in _NO_EDGES:
                raise
            request, edges = _requested(chip, settings, low, edges=False), False
        return Lines(chip, request, keys, heard, debounce_s=settings.debounce_s, edges=edges)
    except BaseException:
        chip.close()
        raise


def _requested(chip: Any, settings: KeySettings, low: Mapping[int, bool], *, edges: bool) -> Any:
    """Raises OSError."""
    config = {line: _line(settings, active_low, edges) for line, active_low in low.items()}
    try:
        return chip.request_lines(consumer=_CONSUMER, config=config)
    except ValueError as error:  # the library's word for EINVAL
        raise OSError(errno.EINVAL, str(error)) from error


def _line(settings: KeySettings, active_low: bool, edges: bool) -> Any:
    from gpiod import LineSettings
    from gpiod.line import Bias, Direction, Edge

    pulls = {"": Bias.AS_IS, "up": Bias.PULL_UP, "down": Bias.PULL_DOWN, "none": Bias.DISABLED}
    return LineSettings(
        direction=Direction.INPUT,
        edge_detection=Edge.BOTH if edges else Edge.NONE,
        bias=pulls[settings.pull],
        active_low=active_low,
    )


def _chip(name: str) -> Path:
    """The device of this path, name or label; labels stay while numbers change. Raises FileNotFoundError."""
    import gpiod

    if Path(name).is_absolute():
        if not Path(name).exists():
            raise FileNotFoundError(errno.ENOENT, "no such chip", name)
        return Path(name)
    for path in sorted(Path("/dev").glob("gpiochip*")):
        with contextlib.suppress(OSError), gpiod.Chip(str(path)) as chip:
            info = chip.get_info()
            if name in (info.name, info.label):
                return path
    raise FileNotFoundError(errno.ENOENT, "no such chip", name)


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
    check=lambda settings, context: key_settings(settings),
)
