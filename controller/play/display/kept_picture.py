"""A picture that stays on the X server between two players: while the program becomes another version.

The root window's background shows wherever no other window is. The player that ends puts its picture there, so that
the server itself shows it, and the next player takes it away behind its own first picture. A property says that it is
there.
"""

from __future__ import annotations

import ctypes
from ctypes import POINTER, byref, c_int, c_ubyte, c_uint, c_ulong
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


_NAME: Final = b"_VELATURA_PICTURE"
"""Of the root window's property: 1 while the picture is there."""
_NO_PIXMAP: Final = 0
_BLACK: Final = 0


class KeptPicture:
    """``display``: a connection of Xlib; ``root``: its root window.

    ``there``: whether the player before has left its picture, and it was not dropped since
    """

    def __init__(self, display: Any, root: int) -> None:
        self._display, self._root = display, root
        self.there = bool(number_of(display, root, _NAME))

    def let_through(self, *windows: int) -> None:
        """Keep the server from painting these windows black when they appear."""
        for window in windows:
            xlib.XSetWindowBackgroundPixmap(self._display, window, _NO_PIXMAP)
        xlib.XSync(self._display, 0)

    def keep(self, window: int) -> None:
        """Show what this window shows, from the screen's corner on, also when the window is gone; black beside it.

        Does nothing where a pixel of the window has other bits than one of the screen, which an X server can't copy.
        """
        width, height, depth = self._shape(self._root)
        window_width, window_height, window_depth = self._shape(window)
        if window_depth != depth:
            return
        # As large as the root window: a smaller background is repeated.
        pixmap = xlib.XCreatePixmap(self._display, self._root, width, height, depth)
        context = xlib.XCreateGC(self._display, pixmap, 0, None)
        xlib.XSetForeground(self._display, context, _BLACK)
        xlib.XFillRectangle(self._display, pixmap, context, 0, 0, width, height)
        xlib.XCopyArea(self._display, window, pixmap, context, 0, 0, window_width, window_height, 0, 0)
        xlib.XSetWindowBackgroundPixmap(self._display, self._root, pixmap)
        set_number(self._display, self._root, _NAME, 1)
        # The server keeps what a window has as its background.
        xlib.XFreeGC(self._display, context)
        xlib.XFreePixmap(self._display, pixmap)
        xlib.XSync(self._display, 0)

    def drop(self) -> None:
        """Black again, wherever no window is."""
        self.there = False
        xlib.XSetWindowBackground(self._display, self._root, _BLACK)
        xlib.XClearWindow(self._display, self._root)
        xlib.XDeleteProperty(self._display, self._root, xlib.XInternAtom(self._display, _NAME, 0))
        xlib.XSync(self._display, 0)

    def _shape(self, window: int) -> tuple[int, int, int]:
        """Width and height in pixels, and the bits of a pixel."""
        root, left, top = c_ulong(), c_int(), c_int()
        width, height, border, depth = c_uint(), c_uint(), c_uint(), c_uint()
        xlib.XGetGeometry(self._display, window, byref(root), byref(left), byref(top), byref(width), byref(height),
                          byref(border), byref(depth))  # fmt: skip
        return width.value, height.value, depth.value
