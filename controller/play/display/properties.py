"""Properties of an X server's windows that are one number, through a connection of Xlib."""

from __future__ import annotations

import ctypes
from ctypes import POINTER, byref, c_int, c_ubyte, c_ulong
from typing import Any, Final

from pyglet.libs.x11 import xlib

_CARDINAL: Final = 6
_BITS: Final = 32
"""Xlib keeps each number of 32 bits in a c_ulong."""


def number_of(display: Any, window: int, name: bytes) -> int:
    """The number, 0 where the window has none of this name."""
    kind, width, count, left = c_ulong(), c_int(), c_ulong(), c_ulong()
    data = POINTER(c_ubyte)()
    atom = xlib.XInternAtom(display, name, 0)
    xlib.XGetWindowProperty(display, window, atom, 0, 1, 0, _CARDINAL, byref(kind), byref(width),
                            byref(count), byref(left), byref(data))  # fmt: skip
    if not data:
        return 0
    number = c_ulong.from_address(ctypes.addressof(data.contents)).value if count.value else 0
    xlib.XFree(data)
    return number


def set_number(display: Any, window: int, name: bytes, number: int) -> None:
    """Give the window this number; the request is not sent yet."""
    value = ctypes.cast(byref(c_ulong(number)), POINTER(c_ubyte))
    xlib.XChangeProperty(display, window, xlib.XInternAtom(display, name, 0), _CARDINAL, _BITS, 0, value, 1)
