"""The shaders of the live mode (GLSL 3.30). They compute what ``bundle.live_maps.compensate`` does, step for step."""

from __future__ import annotations

from typing import Final

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
