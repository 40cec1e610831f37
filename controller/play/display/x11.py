"""What the player needs of an X server beside its window: which outputs there are, and that they show plain values.

Calls libX11, libXrandr and libXext, which pyglet loads anyway, through ctypes, on a connection of its own.
"""

from __future__ import annotations

import ctypes
import ctypes.util
import os
import time
from collections.abc import Callable, Iterator
from ctypes import POINTER, byref, c_int, c_ubyte, c_ulong, c_ushort, c_void_p
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from pyglet.libs.x11 import xlib, xrandr

from controller.core.errors import WorkError
from controller.play.display.edid import serial_names
from controller.play.display.kept_picture import KeptPicture, number_of, set_number

_ATOM: Final = 4
_NOTIFY_EVERYTHING: Final = 0b1111
"""RandR: screen, CRTC, output and property changes."""
_GAMMA_TOLERANCE: Final = 0x0100
"""One step of an 8-bit value in the 16 bits of a gamma ramp."""
_UPRIGHT: Final = 1
"""RandR: neither rotated nor reflected. A Rotation has 16 bits, and pyglet reads 32."""
_UNSCALED: Final = [0x10000, 0, 0, 0, 0x10000, 0, 0, 0, 0x10000]
_LONGEST_PROPERTY_WORDS: Final = 8192
_ONE_PLAYER: Final = b"_VELATURA_PLAYER"
_PROCESS: Final = b"_NET_WM_PID"
_PREDECESSOR_S: Final = 1.0
"""Until the server has noticed that a player which was just killed is gone."""


class _Transforms(ctypes.Structure):
    """XRRCrtcTransformAttributes; matrices (3, 3) in 16.16 fixed point."""

    _fields_ = (
        ("pending", c_int * 9), ("pending_filter", c_void_p), ("pending_count", c_int), ("pending_values", c_void_p),
        ("current", c_int * 9), ("current_filter", c_void_p), ("current_count", c_int), ("current_values", c_void_p),
    )  # fmt: skip


class _Gamma(ctypes.Structure):
    _fields_ = (("size", c_int), ("red", POINTER(c_ushort)), ("green", POINTER(c_ushort)), ("blue", POINTER(c_ushort)))


def _bind(name: str, result: Any, *arguments: Any) -> Any:
    function = getattr(xrandr.lib, name)
    function.restype, function.argtypes = result, list(arguments)
    return function


_DISPLAY = c_void_p
_get_property = _bind(
    "XRRGetOutputProperty", c_int, _DISPLAY, c_ulong, c_ulong, ctypes.c_long, ctypes.c_long, c_int, c_int, c_ulong,
    POINTER(c_ulong), POINTER(c_int), POINTER(c_ulong), POINTER(c_ulong), POINTER(POINTER(c_ubyte)),
)  # fmt: skip
_change_property = _bind(
    "XRRChangeOutputProperty", None, _DISPLAY, c_ulong, c_ulong, c_ulong, c_int, c_int, c_void_p, c_int
)
_select_input = _bind("XRRSelectInput", None, _DISPLAY, c_ulong, c_int)
_get_transform = _bind("XRRGetCrtcTransform", c_int, _DISPLAY, c_ulong, POINTER(POINTER(_Transforms)))
_gamma_size = _bind("XRRGetCrtcGammaSize", c_int, _DISPLAY, c_ulong)
_get_gamma = _bind("XRRGetCrtcGamma", POINTER(_Gamma), _DISPLAY, c_ulong)
_set_gamma = _bind("XRRSetCrtcGamma", None, _DISPLAY, c_ulong, POINTER(_Gamma))
_alloc_gamma = _bind("XRRAllocGamma", POINTER(_Gamma), c_int)
_free_gamma = _bind("XRRFreeGamma", None, POINTER(_Gamma))


@dataclass(frozen=True, slots=True)
class Connector:
    """An output of the X server that shows a part of its screen.

    ``serials``: names that identify its display (``edid.serial_names``); ``rate_hz``: of its mode; ``changed``: how it
    changes the picture, "turned" or "scaled", or empty.
    """

    name: str
    serials: tuple[str, ...]
    x: int
    y: int
    width_px: int
    height_px: int
    rate_hz: float
    output: int
    crtc: int
    changed: str = ""


class XServer:
    """A connection to the X server of ``DISPLAY``. Raises WorkError("display-gone")."""

    def __init__(self) -> None:
        self._display = xlib.XOpenDisplay(None)
        if not self._display:
            raise WorkError(
                "display-gone",
                what="The player found no display: no X server answers.",
                remedy="Start the X server and set DISPLAY, or use --frames on a machine without one.",
            )
        self._address = ctypes.cast(self._display, c_void_p)
        self._root = xlib.XDefaultRootWindow(self._display)
        _select_input(self._address, self._root, _NOTIFY_EVERYTHING)
        self.kept = KeptPicture(self._display, self._root)

    def close(self) -> None:
        """Hang up."""
        xlib.XCloseDisplay(self._display)

    def claim(self) -> None:
        """Be this server's only player, until this connection ends. Raises WorkError("display-taken").

        The claim is the ownership of a selection (X11 protocol, SetSelectionOwner), which ends with its client.
        """
        selection, until_s = xlib.XInternAtom(self._display, _ONE_PLAYER, 0), time.monotonic() + _PREDECESSOR_S
        while (holder := self._claimed(selection)) is not None:
            if time.monotonic() > until_s:
                raise WorkError(
                    "display-taken",
                    what=f"Another player{holder} already shows its pictures on this X server.",
                    remedy="End the kiosk or command that it belongs to, or give this stage an X server of its own.",
                )
            time.sleep(0.05)

    def _claimed(self, selection: int) -> str | None:
        """None if it is ours now, else which process has it, as far as that is known."""
        # While the server is held, no other player comes between question and claim, and the owner's window stays.
        xlib.XGrabServer(self._display)
        try:
            owner = xlib.XGetSelectionOwner(self._display, selection)
            if owner:
                process = number_of(self._display, owner, _PROCESS)
                return f" (process {process})" if process else ""
            window = xlib.XCreateSimpleWindow(self._display, self._root, -1, -1, 1, 1, 0, 0, 0)
            set_number(self._display, window, _PROCESS, os.getpid())
            xlib.XSetSelectionOwner(self._display, selection, window, 0)
            return None
        finally:
            xlib.XUngrabServer(self._display)
            xlib.XSync(self._display, 0)

    def changed(self) -> bool:
        """Whether outputs came, went or changed since the last call."""
        events = xlib.XPending(self._display)
        for _ in range(events):
            xlib.XNextEvent(self._display, byref(xlib.XEvent()))
        return bool(events)

    def connectors(self) -> tuple[Connector, ...]:
        """The outputs that show something now."""
        resources = xrandr.XRRGetScreenResourcesCurrent(self._display, self._root)
        try:
            modes = {mode.id: mode for mode in resources.contents.modes[: resources.contents.nmode]}
            outputs = resources.contents.outputs[: resources.contents.noutput]
            return tuple(c for output in outputs for c in self._connector(resources, output, modes))
        finally:
            xrandr.XRRFreeScreenResources(resources)

    def _connector(self, resources: Any, output: int, modes: dict[int, Any]) -> Iterator[Connector]:
        info = xrandr.XRRGetOutputInfo(self._display, resources, output)
        if not info:
            return
        name, crtc = info.contents.name.decode(errors="replace"), info.contents.crtc
        xrandr.XRRFreeOutputInfo(info)
        place = xrandr.XRRGetCrtcInfo(self._display, resources, crtc) if crtc else None
        if not place:
            return
        found = place.contents
        mode: Any = modes.get(found.mode)
        pixels = mode.hTotal * mode.vTotal if mode else 0
        rate_hz = mode.dotClock / pixels if pixels else 0.0
        serials = serial_names(self._property(output, "EDID"))
        changed = "turned" if found.rotation & 0xFFFF != _UPRIGHT else "scaled" if self._is_scaled(crtc) else ""
        yield Connector(name, serials, found.x, found.y, found.width, found.height, rate_hz, output, crtc, changed)
        xrandr.XRRFreeCrtcInfo(place)

    def _is_scaled(self, crtc: int) -> bool:
        """Whether it scales or bends the picture (RandR 1.3, transforms)."""
        attributes = POINTER(_Transforms)()
        if not _get_transform(self._address, crtc, byref(attributes)) or not attributes:
            return False
        scaled = list(attributes.contents.current) != _UNSCALED
        xlib.XFree(attributes)
        return scaled

    def _property(self, output: int, name: str) -> bytes:
        """An output's property, empty where it has none of this name. Items of 32 bits are c_ulong, as in Xlib."""
        kind, width, count, left = c_ulong(), c_int(), c_ulong(), c_ulong()
        data = POINTER(c_ubyte)()
        atom = xlib.XInternAtom(self._display, name.encode(), 0)
        failed = _get_property(self._address, output, atom, 0, _LONGEST_PROPERTY_WORDS, 0, 0, 0, byref(kind),
                               byref(width), byref(count), byref(left), byref(data))  # fmt: skip
        if failed or not data:
            return b""
        item_bytes = {8: 1, 16: 2, 32: ctypes.sizeof(c_ulong)}.get(width.value, 0)
        found = ctypes.string_at(data, count.value * item_bytes)
        xlib.XFree(data)
        return found

    def make_plain(self, connector: Connector) -> None:
        """Take the output's gamma ramp and its limited range of values away: the frames are linearised already.

        Raises WorkError("output-gamma" or "output-range") if the driver does not let go of them.
        """
        if not self._gamma_is_plain(connector.crtc):
            self._set_plain_gamma(connector.crtc)
            if not self._gamma_is_plain(connector.crtc):
                raise _unfit(connector, "output-gamma", "changes brightness by a gamma ramp")
        full = xlib.XInternAtom(self._display, b"Full", 0)
        wanted = bytes(c_ulong(full))
        if self._property(connector.output, "Broadcast RGB") not in (b"", wanted):
            atom = xlib.XInternAtom(self._display, b"Broadcast RGB", 0)
            _change_property(self._address, connector.output, atom, _ATOM, 32, 0, byref(c_ulong(full)), 1)
            if self._property(connector.output, "Broadcast RGB") != wanted:
                raise _unfit(connector, "output-range", "sends a limited range of values (Broadcast RGB)")

    def _gamma_is_plain(self, crtc: int) -> bool:
        ramp = _get_gamma(self._address, crtc) if _gamma_size(self._address, crtc) > 1 else None
        if not ramp:
            return True
        channels = _channels(ramp.contents)
        plain = bool((abs(channels - _plain_ramp(ramp.contents.size)) <= _GAMMA_TOLERANCE).all())
        _free_gamma(ramp)
        return plain

    def _set_plain_gamma(self, crtc: int) -> None:
        size = _gamma_size(self._address, crtc)
        ramp = _alloc_gamma(size)
        for channel in (ramp.contents.red, ramp.contents.green, ramp.contents.blue):
            np.ctypeslib.as_array(channel, (size,))[:] = _plain_ramp(size)
        _set_gamma(self._address, crtc, ramp)
        _free_gamma(ramp)
        xlib.XSync(self._display, 0)

    def keep_awake(self) -> None:
        """Switch screen saver and power saving off, so that they do not blank the outputs."""
        xlib.XSetScreenSaver(self._display, 0, 0, 0, 0)
        xlib.XForceScreenSaver(self._display, 0)
        power = _power_saving()
        if power is not None:
            power(self._address)
        xlib.XSync(self._display, 0)

    def bypass_compositor(self, window: int) -> None:
        """Tell a compositing window manager to leave this window alone (EWMH, _NET_WM_BYPASS_COMPOSITOR)."""
        set_number(self._display, window, b"_NET_WM_BYPASS_COMPOSITOR", 1)
        xlib.XSync(self._display, 0)


def _channels(ramp: Any) -> npt.NDArray[np.int64]:
    return np.array([channel[: ramp.size] for channel in (ramp.red, ramp.green, ramp.blue)], np.int64)


def _plain_ramp(size: int) -> npt.NDArray[np.int64]:
    return np.arange(size) * 0xFFFF // (size - 1)


def _power_saving() -> Callable[[c_void_p], int] | None:
    """DPMSDisable, or None where the server has no power saving to switch off."""
    name = ctypes.util.find_library("Xext")
    library = ctypes.CDLL(name) if name else None
    if library is None:
        return None
    library.DPMSQueryExtension.argtypes = [c_void_p, POINTER(c_int), POINTER(c_int)]
    library.DPMSDisable.argtypes = [c_void_p]

    def disable(display: c_void_p) -> int:
        if library.DPMSQueryExtension(display, byref(c_int()), byref(c_int())):
            return int(library.DPMSDisable(display))
        return 0

    return disable


def _unfit(connector: Connector, code: str, detail: str) -> WorkError:
    return WorkError(
        code,
        what=f"Output {connector.name} {detail}, and its driver does not stop that.",
        remedy="Switch off colour management and limited range in the driver; see docs/how-to/install-kiosk.md.",
    )
