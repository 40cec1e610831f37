"""Live targets in shaders: OpenGL 3.3, in the context that is current; the player's window gives one.

What is drawn differs from ``bundle.live_maps.compensate`` by at most one device value: where a driver's
exponential rounds otherwise, a pixel on the edge of a dithering threshold falls on its other side.
"""

from __future__ import annotations

import ctypes
from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from pyglet import gl

from controller.bundle.live_maps import LiveMaps, OutputMaps, brightness_factor, light_table, sigma_table
from controller.core.errors import WorkError
from controller.play.frames import FrameSet, OutputSize

VERTEX: Final = """#version 330 core
void main() {
    vec2 corner = vec2((gl_VertexID << 1) & 2, gl_VertexID & 2);
    gl_Position = vec4(2.0 * corner - 1.0, 0.0, 1.0);
}
"""

SCALE: Final = """#version 330 core
out vec4 scale;
uniform usampler2D target;
uniform usampler2D present;
uniform sampler2D gain;
uniform sampler2D offset;
uniform sampler2D tables;
uniform sampler2D surface;
uniform sampler2D falling;
uniform sampler2D of_red;
uniform sampler2D of_green;
uniform sampler2D of_blue;
uniform float factor;
uniform float side;
float light(uint value) { return texelFetch(tables, ivec2(int(value), 0), 0).r; }
vec3 thrown(ivec2 at) {
    ivec2 size = textureSize(falling, 0);
    vec2 place = clamp((vec2(at) - (side - 1.0) / 2.0) / side, vec2(0.0), vec2(size - 1));
    ivec2 first = min(ivec2(place), max(size - 2, ivec2(0)));
    ivec2 next = min(first + 1, size - 1);
    vec2 part = place - vec2(first);
    vec3 above = mix(texelFetch(falling, first, 0).rgb, texelFetch(falling, ivec2(next.x, first.y), 0).rgb, part.x);
    vec3 below = mix(texelFetch(falling, ivec2(first.x, next.y), 0).rgb, texelFetch(falling, next, 0).rgb, part.x);
    return texelFetch(surface, at, 0).rgb * mix(above, below, part.y);
}
void main() {
    ivec2 at = ivec2(gl_FragCoord.xy);
    uvec3 value = texelFetch(target, at, 0).rgb;
    vec3 wanted = vec3(light(value.r), light(value.g), light(value.b));
    vec3 found = wanted * (texelFetch(gain, at, 0).rgb * factor) - texelFetch(offset, at, 0).rgb;
    if (side > 0.0) found -= thrown(at);
    if (textureSize(of_red, 0).x == textureSize(gain, 0).x) found += vec3(
        dot(texelFetch(of_red, at, 0).rgb, found), dot(texelFetch(of_green, at, 0).rgb, found),
        dot(texelFetch(of_blue, at, 0).rgb, found));
    scale = vec4(max(found, vec3(0.0)), float(texelFetch(present, at, 0).r) / 255.0);
}
"""
"""Step 1: C_s at every pixel of the target, and beside it where there is base light. ``side`` is 0 where no light comes
by way of other surfaces; ``of_red`` is one pixel where colours do not depend on the paint."""

FRAME: Final = """#version 330 core
out vec4 colour;
uniform sampler2D scale;
uniform sampler2D tables;
uniform sampler2D noise;
uniform usampler2D base;
uniform usampler2D centre;
uniform usampler2D shape;
uniform mat3 unmix;
uniform vec2 range;
uniform float segment;
uniform ivec2 phase;

float response(int channel, int level) { return texelFetch(tables, ivec2(level, 2 + channel), 0).r; }

vec3 mean(ivec2 at) {
    ivec2 size = textureSize(scale, 0);
    vec2 middle = vec2(texelFetch(centre, at, 0).rg) / 65535.0 * vec2(size - 1);
    uvec3 kept = texelFetch(shape, at, 0).rgb;
    if (kept.r == 0u) return vec3(0.0);
    vec2 sigma = vec2(texelFetch(tables, ivec2(int(kept.r), 1), 0).r, texelFetch(tables, ivec2(int(kept.g), 1), 0).r);
    float correlation = clamp((float(kept.b) - 128.0) / 127.0, -0.96, 0.96);
    vec2 reach = min(max(3.0 * sigma, vec2(0.5)), vec2(12.0));
    ivec2 first = max(ivec2(ceil(middle - reach)), ivec2(0));
    ivec2 last = min(ivec2(floor(middle + reach)), size - 1);
    vec4 total = vec4(0.0);
    for (int y = first.y; y <= last.y; ++y) {
        float dy = (float(y) - middle.y) / sigma.y;
        for (int x = first.x; x <= last.x; ++x) {
            float dx = (float(x) - middle.x) / sigma.x;
            float square = (dx * dx - 2.0 * correlation * dx * dy + dy * dy) / (1.0 - correlation * correlation);
            total += exp(-0.5 * square) * texelFetch(scale, ivec2(x, y), 0);
        }
    }
    return total.a > 0.0 ? total.rgb / total.a : vec3(0.0);
}

float device(int channel, float wanted, ivec2 at) {
    float value = clamp(wanted, response(channel, 0), response(channel, 255));
    int low = 0, high = 255;
    while (high - low > 1) {
        int middle = (low + high) / 2;
        if (response(channel, middle) <= value) low = middle; else high = middle;
    }
    float below = response(channel, low);
    float gap = response(channel, low + 1) - below;
    float part = gap > 0.0 ? (value - below) / gap : 0.0;
    ivec2 place = (at + phase + ivec2(43, 21) * channel) % 64;
    return float(part > texelFetch(noise, place, 0).r ? low + 1 : low) / 255.0;
}

void main() {
    ivec2 at = ivec2(gl_FragCoord.xy);
    vec3 light = range.x + vec3(texelFetch(base, at, 0).rgb) / 65535.0 * (range.y - range.x);
    vec3 shown = clamp(unmix * (mean(at) * light), 0.0, 1.0);
    vec3 own = (shown - segment * min(shown.r, min(shown.g, shown.b))) / (1.0 - segment);
    colour = vec4(device(0, own.r, at), device(1, own.g, at), device(2, own.b, at), 1.0);
}
"""
"""Steps 2 and 3: P_s, P_b x P_s, and its device values. ``phase`` is (columns, rows); ``tables`` has light and sigma
in its first two rows, then the response; ``segment`` is 0 where the projector has no white segment."""


_FORMATS: Final[Mapping[tuple[str, int], tuple[int, int, int]]] = {
    ("u1", 1): (gl.GL_R8UI, gl.GL_RED_INTEGER, gl.GL_UNSIGNED_BYTE),
    ("u1", 3): (gl.GL_RGB8UI, gl.GL_RGB_INTEGER, gl.GL_UNSIGNED_BYTE),
    ("u2", 2): (gl.GL_RG16UI, gl.GL_RG_INTEGER, gl.GL_UNSIGNED_SHORT),
    ("u2", 3): (gl.GL_RGB16UI, gl.GL_RGB_INTEGER, gl.GL_UNSIGNED_SHORT),
    ("f2", 3): (gl.GL_RGB16F, gl.GL_RGB, gl.GL_HALF_FLOAT),
    ("f4", 1): (gl.GL_R32F, gl.GL_RED, gl.GL_FLOAT),
    ("f4", 3): (gl.GL_RGB32F, gl.GL_RGB, gl.GL_FLOAT),
}
_KEPT: Final = (gl.GL_CURRENT_PROGRAM, gl.GL_DRAW_FRAMEBUFFER_BINDING, gl.GL_READ_FRAMEBUFFER_BINDING,
                gl.GL_VERTEX_ARRAY_BINDING)  # fmt: skip


class LiveRenderer:
    """The maps of a bundle as textures, and the two programs that make frames of a target with them."""

    def __init__(self, maps: LiveMaps) -> None:
        """Raises WorkError("display-unfit") where the driver can not do it."""
        self._maps = maps
        width, height = maps.target_px
        kept = _state()
        self._scaling, self._framing = _Program(SCALE), _Program(FRAME)
        self._target = _texture(np.zeros((height, width, 3), np.uint8))
        self._maps_of_target = [_texture(values) for values in (maps.present, maps.gain, maps.offset)]
        self._noise = _texture(maps.noise)
        self._light = light_table()
        indirect = maps.indirect
        grid = (1, 1) if indirect is None else indirect.grid
        surface = np.zeros((1, 1, 3), np.float16) if indirect is None else indirect.surface
        self._thrown = [_texture(surface), _texture(np.zeros((*grid, 3), np.float32))]
        paint = np.zeros((1, 1, 3, 3), np.float16) if maps.paint is None else maps.paint
        self._paint = [_texture(paint[:, :, colour]) for colour in range(3)]
        self._scale = _empty(width, height, gl.GL_RGBA32F)
        self._outputs = [_OutputTextures(output) for output in maps.outputs]
        self._buffer = _name(gl.glGenFramebuffers)
        self._vertices = _name(gl.glGenVertexArrays)
        _restore(kept)

    def render(
        self, target: npt.NDArray[np.uint8], brightness: float, into: Sequence[int] | None = None
    ) -> Sequence[int]:
        """Draw the frames for a target (height, width, 3) uint8 sRGB; returns the textures that hold them.

        ``into``: textures of the outputs' sizes, RGB8 or RGBA8, row 0 the image's first; own ones otherwise. The
        context's program, frame buffers and vertex array are left as they were. ValueError for a wrong size.
        """
        if target.shape != (*self._maps.gain.shape[:2], 3) or target.dtype != np.uint8:
            raise ValueError(f"a target of {target.shape}, {target.dtype} instead of {self._maps.gain.shape}, uint8")
        kept = _state()
        viewport = (gl.GLint * 4)()
        gl.glGetIntegerv(gl.GL_VIEWPORT, viewport)
        gl.glBindFramebuffer(gl.GL_FRAMEBUFFER, self._buffer)
        gl.glBindVertexArray(self._vertices)
        self._draw_scale(np.ascontiguousarray(target), brightness)
        textures = [output.frame for output in self._outputs] if into is None else into
        for output, texture in zip(self._outputs, textures, strict=True):
            self._draw_frame(output, texture)
        _restore(kept)
        gl.glViewport(*viewport)
        return textures

    def frames(self, target: npt.NDArray[np.uint8], brightness: float) -> FrameSet:
        """As ``render``, read back to memory; slower, for outputs that are no windows, and for tests."""
        return self.read_back(self.render(target, brightness))

    def read_back(self, textures: Sequence[int]) -> FrameSet:
        """What textures of the outputs' sizes hold."""
        gl.glPixelStorei(gl.GL_PACK_ALIGNMENT, 1)
        gl.glActiveTexture(gl.GL_TEXTURE0)
        found = FrameSet.black([OutputSize(output.name, *output.size_px) for output in self._maps.outputs])
        for texture, image in zip(textures, found.pixels, strict=True):
            gl.glBindTexture(gl.GL_TEXTURE_2D, texture)
            gl.glGetTexImage(gl.GL_TEXTURE_2D, 0, gl.GL_RGB, gl.GL_UNSIGNED_BYTE, image.ctypes.data_as(ctypes.c_void_p))
        return found

    def close(self) -> None:
        """Free the textures; the context must be current."""
        textures = [self._target, *self._maps_of_target, *self._thrown, *self._paint, self._noise, self._scale]
        for output in self._outputs:
            textures += [output.frame, *output.inputs.values()]
        gl.glDeleteTextures(len(textures), (gl.GLuint * len(textures))(*textures))
        gl.glDeleteFramebuffers(1, gl.GLuint(self._buffer))
        gl.glDeleteVertexArrays(1, gl.GLuint(self._vertices))
        for program in (self._scaling, self._framing):
            gl.glDeleteProgram(program.number)

    def _draw_scale(self, target: npt.NDArray[np.uint8], brightness: float) -> None:
        gl.glActiveTexture(gl.GL_TEXTURE0)
        gl.glBindTexture(gl.GL_TEXTURE_2D, self._target)
        _put(target, replace=True)
        self._put_falling(target, brightness)
        present, gain, offset = self._maps_of_target
        surface, falling = self._thrown
        of_red, of_green, of_blue = self._paint
        program, indirect = self._scaling, self._maps.indirect
        program.use(
            target=self._target, present=present, gain=gain, offset=offset, tables=self._outputs[0].tables,
            surface=surface, falling=falling, of_red=of_red, of_green=of_green, of_blue=of_blue,
        )  # fmt: skip
        gl.glUniform1f(program.at("side"), 0.0 if indirect is None else indirect.side)
        gl.glUniform1f(program.at("factor"), float(brightness_factor(self._maps, brightness)))
        _draw_to(self._scale, *self._maps.target_px)

    def _put_falling(self, target: npt.NDArray[np.uint8], brightness: float) -> None:
        """What falls on blocks by way of other surfaces, found here: the target's samples are few."""
        indirect = self._maps.indirect
        if indirect is None:
            return
        falling = indirect.falling((self._light * np.float32(brightness))[indirect.samples(target)])
        gl.glBindTexture(gl.GL_TEXTURE_2D, self._thrown[1])
        _put(np.ascontiguousarray(falling / np.float32(self._maps.unit), np.float32), replace=True)

    def _draw_frame(self, output: _OutputTextures, into: int) -> None:
        program, values = self._framing, output.values
        program.use(scale=self._scale, noise=self._noise, **output.inputs)
        matrix = (gl.GLfloat * 9)(*values.unmix.ravel())
        gl.glUniformMatrix3fv(program.at("unmix"), 1, gl.GL_TRUE, matrix)
        gl.glUniform2f(program.at("range"), *values.base_range)
        gl.glUniform1f(program.at("segment"), values.segment)
        gl.glUniform2i(program.at("phase"), values.dither[1], values.dither[0])
        _draw_to(into, *values.size_px)


class _OutputTextures:
    def __init__(self, values: OutputMaps) -> None:
        self.values = values
        self.tables = _texture(np.vstack([light_table(), sigma_table(), values.response]).astype(np.float32))
        maps: dict[str, npt.NDArray[Any]] = {"base": values.base, "centre": values.centre, "shape": values.shape}
        self.inputs = {"tables": self.tables, **{name: _texture(array) for name, array in maps.items()}}
        self.frame = _empty(*values.size_px, gl.GL_RGBA8)


class _Program:
    def __init__(self, fragment: str) -> None:
        self.number = int(gl.glCreateProgram())
        for kind, text in ((gl.GL_VERTEX_SHADER, VERTEX), (gl.GL_FRAGMENT_SHADER, fragment)):
            shader = gl.glCreateShader(kind)
            lines = ctypes.cast(
                ctypes.pointer(ctypes.c_char_p(text.encode())), ctypes.POINTER(ctypes.POINTER(gl.GLchar))
            )
            gl.glShaderSource(shader, 1, lines, None)
            gl.glCompileShader(shader)
            gl.glAttachShader(self.number, shader)
        gl.glLinkProgram(self.number)
        linked = gl.GLint()
        gl.glGetProgramiv(self.number, gl.GL_LINK_STATUS, ctypes.byref(linked))
        if not linked.value:
            raise WorkError(
                "display-unfit",
                what="The graphics driver could not build the live mode's programs.",
                remedy="Install the display's current graphics driver, or let the processor make live frames.",
            )

    def at(self, name: str) -> int:
        return int(gl.glGetUniformLocation(self.number, name.encode()))

    def use(self, **textures: int) -> None:
        gl.glUseProgram(self.number)
        for unit, (name, texture) in enumerate(textures.items()):
            gl.glActiveTexture(gl.GL_TEXTURE0 + unit)
            gl.glBindTexture(gl.GL_TEXTURE_2D, texture)
            gl.glUniform1i(self.at(name), unit)
        gl.glActiveTexture(gl.GL_TEXTURE0)


def _name(generate: Any) -> int:
    name = gl.GLuint()
    generate(1, ctypes.byref(name))
    return int(name.value)


def _texture(values: npt.NDArray[Any]) -> int:
    name = _nearest()
    _put(np.ascontiguousarray(values), replace=False)
    return name


def _empty(width: int, height: int, kind: int) -> int:
    name = _nearest()
    gl.glTexImage2D(gl.GL_TEXTURE_2D, 0, kind, width, height, 0, gl.GL_RGBA, gl.GL_UNSIGNED_BYTE, None)
    return name


def _nearest() -> int:
    name = _name(gl.glGenTextures)
    gl.glActiveTexture(gl.GL_TEXTURE0)
    gl.glBindTexture(gl.GL_TEXTURE_2D, name)
    for parameter in (gl.GL_TEXTURE_MIN_FILTER, gl.GL_TEXTURE_MAG_FILTER):
        gl.glTexParameteri(gl.GL_TEXTURE_2D, parameter, gl.GL_NEAREST)
    return name


def _put(values: npt.NDArray[Any], *, replace: bool) -> None:
    """Give the bound texture its content."""
    height, width = values.shape[:2]
    channels = values.shape[2] if values.ndim == 3 else 1
    inside, order, kind = _FORMATS[values.dtype.str[1:], channels]
    pointer = values.ctypes.data_as(ctypes.c_void_p)
    gl.glPixelStorei(gl.GL_UNPACK_ALIGNMENT, 1)
    if replace:
        gl.glTexSubImage2D(gl.GL_TEXTURE_2D, 0, 0, 0, width, height, order, kind, pointer)
    else:
        gl.glTexImage2D(gl.GL_TEXTURE_2D, 0, inside, width, height, 0, order, kind, pointer)


def _draw_to(texture: int, width: int, height: int) -> None:
    gl.glFramebufferTexture2D(gl.GL_FRAMEBUFFER, gl.GL_COLOR_ATTACHMENT0, gl.GL_TEXTURE_2D, texture, 0)
    gl.glViewport(0, 0, width, height)
    gl.glDrawArrays(gl.GL_TRIANGLES, 0, 3)


def _state() -> list[int]:
    found = []
    for what in _KEPT:
        value = gl.GLint()
        gl.glGetIntegerv(what, ctypes.byref(value))
        found.append(int(value.value))
    return found


def _restore(kept: Sequence[int]) -> None:
    program, drawing, reading, vertices = kept
    gl.glUseProgram(program)
    gl.glBindFramebuffer(gl.GL_DRAW_FRAMEBUFFER, drawing)
    gl.glBindFramebuffer(gl.GL_READ_FRAMEBUFFER, reading)
    gl.glBindVertexArray(vertices)
