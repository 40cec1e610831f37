"""One borderless window over all projectors, by pyglet: one context, one flip, so no projector is ahead of another."""

from __future__ import annotations

import ctypes
import time
from collections.abc import Sequence
from typing import Any, Final

import pyglet

# Must be set before pyglet.window is imported: error checks after every call, and a hidden window, cost time.
pyglet.options["debug_gl"] = False
pyglet.options["shadow_window"] = False

from pyglet import gl  # noqa: E402

from controller.errors import UsageError, WorkError  # noqa: E402
from controller.play.frames import FrameSet, OutputSize  # noqa: E402

_VERTEX: Final = """#version 330 core
out vec2 place;
void main() {
    vec2 corner = vec2((gl_VertexID << 1) & 2, gl_VertexID & 2);
    place = vec2(corner.x, 1.0 - corner.y);
    gl_Position = vec4(2.0 * corner - 1.0, 0.0, 1.0);
}
"""
_FRAGMENT: Final = """#version 330 core
in vec2 place;
out vec4 colour;
uniform sampler2D picture;
void main() { colour = vec4(texture(picture, place).rgb, 1.0); }
"""


class WindowOutput:
    """Real outputs of an X server (or whatever window system pyglet finds).

    Outputs whose names are connectors of the X server (``xrandr``: DP-1, HDMI-2) are placed where those are; if none
    of the names is one, they lie side by side from the upper left corner, in stage order.
    """

    def __init__(self, sizes: Sequence[OutputSize]) -> None:
        """Open the window. Raises WorkError("display-gone"), UsageError("output-missing" or "output-size-differs")."""
        try:
            display = pyglet.display.get_display()
            screens = {str(getattr(screen, "name", "")): screen for screen in display.get_screens()}
            places = _places(sizes, screens)
            self._window = _open_window(places, sizes)
        except (pyglet.display.xlib.NoSuchDisplayException, pyglet.window.NoSuchConfigException) as error:
            raise WorkError(
                "display-gone",
                what="The player found no display with OpenGL 3.3 to show its window on.",
                remedy="Start the X server and set DISPLAY, or use --frames on a machine without one.",
            ) from error
        self._window.switch_to()
        self._window.set_vsync(True)
        height = max(y + size.height_px for (_, y), size in zip(places, sizes, strict=True))
        # OpenGL counts rows from below.
        self._areas = [(x, height - y - s.height_px, s) for (x, y), s in zip(places, sizes, strict=True)]
        self._program = _program()
        self._textures = [_texture(size) for size in sizes]
        self._damaged = False
        self._window.push_handlers(on_expose=self._on_expose, on_draw=self._on_expose, on_close=_stay)

    def _on_expose(self) -> bool:
        self._damaged = True
        return True

    def prepare(self, frames: FrameSet) -> None:
        self._window.switch_to()
        for texture, (_, _, size), image in zip(self._textures, self._areas, frames.pixels, strict=True):
            gl.glBindTexture(gl.GL_TEXTURE_2D, texture)
            pointer = image.ctypes.data_as(ctypes.c_void_p)
            shape = (size.width_px, size.height_px)
            gl.glTexSubImage2D(gl.GL_TEXTURE_2D, 0, 0, 0, *shape, gl.GL_RGB, gl.GL_UNSIGNED_BYTE, pointer)
        self._draw()

    def _draw(self) -> None:
        gl.glViewport(0, 0, *self._window.get_framebuffer_size())
        gl.glClear(gl.GL_COLOR_BUFFER_BIT)
        for texture, (x, y, size) in zip(self._textures, self._areas, strict=True):
            gl.glViewport(x, y, size.width_px, size.height_px)
            gl.glBindTexture(gl.GL_TEXTURE_2D, texture)
            gl.glDrawArrays(gl.GL_TRIANGLES, 0, 3)
        # Drawn before the deadline, so that the flip itself has nothing to wait for.
        gl.glFinish()

    def flip(self) -> float:
        self._window.flip()
        gl.glFinish()
        return time.monotonic()

    def pump(self) -> None:
        self._window.dispatch_events()
        if self._damaged:
            self._damaged = False
            self._window.switch_to()
            self._draw()
            self._window.flip()

    def close(self) -> None:
        self._window.close()


def _stay() -> bool:
    """Nobody closes a kiosk's window from its frame."""
    return True


def _places(sizes: Sequence[OutputSize], screens: dict[str, Any]) -> list[tuple[int, int]]:
    """Upper left corner of each output on the X screen."""
    known = [screens.get(size.name) for size in sizes]
    if all(screen is None for screen in known):
        return [(sum(s.width_px for s in sizes[:number]), 0) for number in range(len(sizes))]
    for size, screen in zip(sizes, known, strict=True):
        if screen is None:
            raise UsageError(
                "output-missing",
                what=f"The X server has no output {size.name}; it has {', '.join(screens)}.",
                remedy="Check the cable and stage.toml, and force the output on if the projector is off.",
            )
        if (screen.width, screen.height) != (size.width_px, size.height_px):
            raise UsageError(
                "output-size-differs",
                what=f"Output {size.name} is {screen.width}x{screen.height}; the stage says "
                f"{size.width_px}x{size.height_px}.",
                remedy="Set the output's mode with xrandr, or correct stage.toml and calibrate again.",
            )
    return [(screen.x, screen.y) for screen in known if screen is not None]


def _open_window(places: Sequence[tuple[int, int]], sizes: Sequence[OutputSize]) -> Any:
    width = max(x + size.width_px for (x, _), size in zip(places, sizes, strict=True))
    height = max(y + size.height_px for (_, y), size in zip(places, sizes, strict=True))
    config = gl.Config(  # type: ignore[abstract]
        double_buffer=True, red_size=8, green_size=8, blue_size=8, major_version=3, minor_version=3, depth_size=0
    )
    window = pyglet.window.Window(
        width, height, caption="Velatura", style="borderless", vsync=True, visible=False, config=config
    )
    window.set_location(0, 0)
    window.set_visible(True)
    # A window manager may have moved it while it was mapped.
    window.set_location(0, 0)
    window.set_mouse_visible(False)
    return window


def _program() -> Any:
    """Make the drawing program current; it stays current, there is no other."""
    program = gl.glCreateProgram()
    for kind, text in ((gl.GL_VERTEX_SHADER, _VERTEX), (gl.GL_FRAGMENT_SHADER, _FRAGMENT)):
        shader = gl.glCreateShader(kind)
        source = ctypes.cast(ctypes.pointer(ctypes.c_char_p(text.encode())), ctypes.POINTER(ctypes.POINTER(gl.GLchar)))
        gl.glShaderSource(shader, 1, source, None)
        gl.glCompileShader(shader)
        gl.glAttachShader(program, shader)
    gl.glLinkProgram(program)
    linked = gl.GLint()
    gl.glGetProgramiv(program, gl.GL_LINK_STATUS, ctypes.byref(linked))
    if not linked.value:
        raise WorkError(
            "display-unfit",
            what="The graphics driver could not build the player's drawing program.",
            remedy="Install the display's current graphics driver, or Mesa (libgl1-mesa-dri).",
        )
    gl.glUseProgram(program)
    vertices = gl.GLuint()
    gl.glGenVertexArrays(1, ctypes.byref(vertices))
    gl.glBindVertexArray(vertices)
    for state in (gl.GL_DITHER, gl.GL_BLEND, gl.GL_DEPTH_TEST, gl.GL_FRAMEBUFFER_SRGB):
        gl.glDisable(state)
    gl.glClearColor(0, 0, 0, 1)
    gl.glPixelStorei(gl.GL_UNPACK_ALIGNMENT, 1)
    return program


def _texture(size: OutputSize) -> int:
    name = gl.GLuint()
    gl.glGenTextures(1, ctypes.byref(name))
    gl.glBindTexture(gl.GL_TEXTURE_2D, name.value)
    for parameter, value in (
        (gl.GL_TEXTURE_MIN_FILTER, gl.GL_NEAREST),
        (gl.GL_TEXTURE_MAG_FILTER, gl.GL_NEAREST),
        (gl.GL_TEXTURE_WRAP_S, gl.GL_CLAMP_TO_EDGE),
        (gl.GL_TEXTURE_WRAP_T, gl.GL_CLAMP_TO_EDGE),
    ):
        gl.glTexParameteri(gl.GL_TEXTURE_2D, parameter, value)
    shape = (size.width_px, size.height_px)
    gl.glTexImage2D(gl.GL_TEXTURE_2D, 0, gl.GL_RGB8, *shape, 0, gl.GL_RGB, gl.GL_UNSIGNED_BYTE, None)
    return int(name.value)
