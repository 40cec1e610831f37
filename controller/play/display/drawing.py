"""Draws two pictures an output, or their mixture, with OpenGL 3.3; the caller has a context and makes it current."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from typing import Any, Final

from pyglet import gl

from controller.core.errors import WorkError
from controller.play.frames import FrameSet, OutputSize, Tiles, differing

_VERTEX: Final = """#version 330 core
out vec2 place;
void main() {
    vec2 corner = vec2((gl_VertexID << 1) & 2, gl_VertexID & 2);
    place = vec2(corner.x, 1.0 - corner.y);
    gl_Position = vec4(2.0 * corner - 1.0, 0.0, 1.0);
}
"""
_HEAD: Final = """#version 330 core
in vec2 place;
out vec4 colour;
uniform sampler2D before;
uniform sampler2D after;
uniform float share;
"""
_PLAIN: Final = _HEAD + "void main() { colour = vec4(texture(before, place).rgb, 1.0); }"
# The square stands for every projector's response, as in mixing.py.
_MIXED: Final = (
    _HEAD
    + """void main() {
    vec3 old = texture(before, place).rgb;
    vec3 new = texture(after, place).rgb;
    colour = vec4(sqrt((1.0 - share) * old * old + share * new * new), 1.0);
}
"""
)


class Canvas:
    """Textures for the pictures of all outputs, twice, and the program that draws them."""

    def __init__(self, sizes: Sequence[OutputSize]) -> None:
        """Raises WorkError("display-unfit")."""
        self._sizes = tuple(sizes)
        # Two programs, for drawing without a graphics card does all that a program may do, wanted or not.
        self._plain, self._mixed = _program(_PLAIN), _program(_MIXED)
        gl.glUseProgram(self._mixed)
        self._share_at = gl.glGetUniformLocation(self._mixed, b"share")
        for unit, name in enumerate((b"before", b"after")):
            gl.glUniform1i(gl.glGetUniformLocation(self._mixed, name), unit)
        _set_up()
        self._before = [_texture(size) for size in sizes]
        self._after: list[int] = []
        self._held: dict[int, Tiles] = {}

    @property
    def pictures(self) -> Sequence[int]:
        """The textures that are drawn with share 0: code that draws into them does what ``load`` does."""
        self._held.clear()
        return self._before

    def load(self, frames: FrameSet) -> None:
        """Take one set over; draw it with share 0."""
        self._upload(self._before, frames)

    def load_both(self, before: FrameSet, after: FrameSet) -> None:
        """Take two sets over; draw them with a share from 0 to 1."""
        # Made when first needed: most kiosks never fade.
        self._after = self._after or [_texture(size) for size in self._sizes]
        self._upload(self._before, before)
        self._upload(self._after, after)

    def _upload(self, textures: Sequence[int], frames: FrameSet) -> None:
        """Take over what a texture does not hold already."""
        gl.glActiveTexture(gl.GL_TEXTURE0)
        for number, (texture, size, image) in enumerate(zip(textures, self._sizes, frames.pixels, strict=True)):
            gl.glBindTexture(gl.GL_TEXTURE_2D, texture)
            gl.glPixelStorei(gl.GL_UNPACK_ROW_LENGTH, size.width_px)
            tiles = None if frames.tiles is None else frames.tiles[number]
            for rows, columns in differing(image.shape, tiles, self._held.pop(texture, None)):
                pointer = image[rows, columns].ctypes.data_as(ctypes.c_void_p)
                place = (columns.start, rows.start, columns.stop - columns.start, rows.stop - rows.start)
                gl.glTexSubImage2D(gl.GL_TEXTURE_2D, 0, *place, gl.GL_RGB, gl.GL_UNSIGNED_BYTE, pointer)
            if tiles is not None:
                self._held[texture] = tiles
        gl.glPixelStorei(gl.GL_UNPACK_ROW_LENGTH, 0)

    def draw(self, places: Sequence[tuple[int, int] | None], shape: tuple[int, int], share: float) -> None:
        """Draw into a black window of this (width, height); ``places``: upper left corners, None: not drawn."""
        gl.glViewport(0, 0, *shape)
        gl.glClear(gl.GL_COLOR_BUFFER_BIT)
        mixed = 0 < share < 1
        gl.glUseProgram(self._mixed if mixed else self._plain)
        if mixed:
            gl.glUniform1f(self._share_at, share)
        first = self._after if share >= 1 else self._before
        for number, (place, size) in enumerate(zip(places, self._sizes, strict=True)):
            if place is None:
                continue
            # OpenGL counts rows from below.
            gl.glViewport(place[0], shape[1] - place[1] - size.height_px, size.width_px, size.height_px)
            gl.glActiveTexture(gl.GL_TEXTURE0)
            gl.glBindTexture(gl.GL_TEXTURE_2D, first[number])
            if mixed:
                gl.glActiveTexture(gl.GL_TEXTURE1)
                gl.glBindTexture(gl.GL_TEXTURE_2D, self._after[number])
            gl.glDrawArrays(gl.GL_TRIANGLES, 0, 3)
        # Drawn before the deadline, so that the flip itself has nothing to wait for.
        gl.glFinish()


def _program(fragment: str) -> Any:
    """A drawing program."""
    program = gl.glCreateProgram()
    for kind, text in ((gl.GL_VERTEX_SHADER, _VERTEX), (gl.GL_FRAGMENT_SHADER, fragment)):
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
    return program


def _set_up() -> None:
    """What stays as it is while the window is there."""
    vertices = gl.GLuint()
    gl.glGenVertexArrays(1, ctypes.byref(vertices))
    gl.glBindVertexArray(vertices)
    for state in (gl.GL_DITHER, gl.GL_BLEND, gl.GL_DEPTH_TEST, gl.GL_FRAMEBUFFER_SRGB):
        gl.glDisable(state)
    gl.glClearColor(0, 0, 0, 1)
    gl.glPixelStorei(gl.GL_UNPACK_ALIGNMENT, 1)


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
