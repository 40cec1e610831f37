"""Bad files and words that people give to a command: pictures, meshes, videos, bundles, arguments."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator, Sequence

import cv2
import numpy as np

from tests.campaigns.bad_cases import HUGE, ODD, Case, odd, put, typed


def cases() -> Iterator[Case]:
    parts = (_meshes, _pictures, _videos, _plans, _sequences, _bundles, _words)
    for part in parts:
        yield from part()


def _meshes() -> Iterator[Case]:
    demo = ("demo", "--prepare-only", "--out", "{here}/out", "--object")
    square = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\n"
    for name, text in {
        "one point thrice": "v 1 1 1\nv 1 1 1\nv 1 1 1\nf 1 2 3\n", "a line": "v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n",
        "nan": "v nan 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "infinite": "v inf 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n",
        "huge": "v 1e300 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "tiny": "v 1e-300 0 0\nv 0 0 0\nv 0 1e-300 0\nf 1 2 3\n",
        "index zero": square + "f 0 1 2\n", "index beyond": square + "f 1 2 99\n",
        "index negative": square + "f -9 -8 -7\n",
        "index of digits": square + f"f 1 2 {HUGE}\n", "no faces": square, "words": "once upon a time\n" * 50,
        "two corners": square + "f 1 2\n", "text for numbers": "v a b c\nf 1 2 3\n", "empty": "", "nul": "\0" * 500,
    }.items():  # fmt: skip
        yield Case(f"mesh: {name}", put("m.obj", text.encode(), (*demo, "{here}/m.obj")))
    header = b"ply\nformat binary_little_endian 1.0\nelement vertex 999999999\nproperty float x\nproperty float y\n"
    for name, file, content in (
        ("promised vertices", "m.ply", header + b"property float z\nend_header\n"),
        ("half a header", "m.ply", header), ("stl of zeros", "m.stl", bytes(84)),
        ("stl of promises", "m.stl", bytes(80) + struct.pack("<I", 0xFFFFFFFF)),
        ("glb cut off", "m.glb", b"glTF\x02\0\0\0"),
        ("gltf of lists", "m.gltf", b"[[[[]]]]"), ("unknown ending", "m.xyzzy", b"v 0 0 0"),
        ("no ending", "m", b"v 0 0 0"),
        ("zip", "m.3mf", b"PK\x03\x04" + bytes(50)), ("a picture", "m.obj", _png(4, 4)),
    ):  # fmt: skip
        yield Case(f"mesh: {name}", put(file, content, (*demo, f"{{here}}/{file}")))
    for kind in ODD:
        yield Case(f"mesh a {kind}", odd("m.obj", kind, (*demo, "{here}/m.obj")))


def _png(width: int, height: int) -> bytes:
    return bytes(cv2.imencode(".png", np.full((height, width, 3), 120, np.uint8))[1])


def _declared_png(width: int, height: int) -> bytes:
    """A PNG that says it is so large, and whose packed rows would really fill it a good way."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    head = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    body = zlib.compress(bytes(1 << 24), 9) * 2
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", body) + chunk(b"IEND", b"")


def _pictures() -> Iterator[Case]:
    jpeg = bytes(cv2.imencode(".jpg", np.full((48, 64, 3), 90, np.uint8))[1])
    sof = jpeg.index(b"\xff\xc0")
    huge_jpeg = jpeg[: sof + 5] + struct.pack(">HH", 65535, 65535) + jpeg[sof + 9 :]
    contents = {
        "png of 30000 squared": ("p.png", _declared_png(30_000, 30_000)),
        "png of 2 thousand millions": ("p.png", _declared_png(2**31 - 1, 2**31 - 1)),
        "png without pixels": ("p.png", _declared_png(0, 0)), "png cut off": ("p.png", _png(64, 48)[:60]),
        "png with a wrong end": ("p.png", _png(64, 48)[:-12] + b"IEND"), "png of another size": ("p.png", _png(7, 5)),
        "jpeg of 65535 squared": ("p.jpg", huge_jpeg), "jpeg cut off": ("p.jpg", jpeg[:200]),
        "jpeg of its head": ("p.jpg", b"\xff\xd8\xff\xd9"), "empty png": ("p.png", b""), "empty exr": ("p.exr", b""),
        "exr of its head": ("p.exr", b"v/1\x01" + bytes(40)), "exr of zeros": ("p.exr", bytes(9000)),
        "text": ("p.png", b"Dear reader,"), "a gif": ("p.png", b"GIF89a" + bytes(20)),
        "a tiff of promises": (
            "p.tif", b"II*\0" + struct.pack("<IHHHIIHHIII", 8, 2, 256, 4, 1, 60000, 257, 4, 1, 60000, 0)
        ),
    }  # fmt: skip
    for name, (file, content) in contents.items():
        for command in (("read-target",), ("camera", "exif"), ("camera", "calibrate")):
            words = (*command, f"{{here}}/{file}", *(("--out", "{here}/lens.toml") if command[0] == "camera" else ()))
            yield Case(f"picture: {name} for {command[-1]}", put(file, content, words))
    for kind in ODD:
        for ending in ("png", "exr", "dng"):
            command = ("camera", "calibrate") if ending == "dng" else ("read-target",)
            more = ("--out", "{here}/lens.toml") if ending == "dng" else ()
            yield Case(
                f"picture a {kind} ({ending})", odd(f"p.{ending}", kind, (*command, f"{{here}}/p.{ending}", *more))
            )


def _videos() -> Iterator[Case]:
    for name, content in {
        "empty": b"", "zeros": bytes(5000), "text": b"once upon a time",
        "mp4 of its head": b"\0\0\0\x18ftypmp42" + bytes(90),
        "avi of its head": b"RIFF\xff\xff\xff\xffAVI LIST", "a picture": _png(8, 8),
    }.items():  # fmt: skip
        yield Case(f"video: {name}", put("v.mp4", content, ("read-live", "{here}/v.mp4")), refused=name != "a picture")
    for kind in ODD:
        yield Case(f"video a {kind}", odd("v.mp4", kind, ("read-live", "{here}/v.mp4")), refused=kind != "folder")
    yield Case("video: a folder of damaged pictures", put("v/1.png", b"PNG", ("read-live", "{here}/v")))
    yield Case("video: a folder with a huge picture",
               put("v/1.png", _declared_png(30_000, 30_000), ("read-live", "{here}/v")))  # fmt: skip
    yield Case("video: a folder with a pipe", odd("v/1.png", "pipe", ("read-live", "{here}/v")))


def _plans() -> Iterator[Case]:
    text = "[object]\nmesh = 'm.obj'\nheight_m = 0.3\n"
    for name, content in {
        "empty": "", "object alone": text, "nan": text.replace("0.3", "nan"), "zero": text.replace("0.3", "0.0"),
        "axes": text + "up = '+q'\n", "no text": "\0\0", "huge": text.replace("0.3", HUGE), "list": "object = [1, 2]\n",
    }.items():  # fmt: skip
        yield Case(f"plan: {name}", put("plan.toml", content.encode(), ("plan", "{here}/plan.toml")))
    for kind in ODD:
        yield Case(f"plan a {kind}", odd("plan.toml", kind, ("plan", "{here}/plan.toml")))


def _sequences() -> Iterator[Case]:
    for name, content in {
        "empty": b"", "no list": b"item = 1\n", "nan": b"[[item]]\nappearance = 'x'\nseconds = nan\n",
        "negative": b"repeat = -1\n[[item]]\nappearance = 'x'\n", "binary": bytes(range(256)),
        "deep": b"item = " + b"[" * 5000,
    }.items():  # fmt: skip
        yield Case(f"sequence: {name}", put("s.toml", content, ("play", "{stage}", "--sequence", "{here}/s.toml")))
    yield Case("sequence a pipe", odd("s.toml", "pipe", ("play", "{stage}", "--sequence", "{here}/s.toml")))


def _bundles() -> Iterator[Case]:
    for name, content in {
        "empty": b"", "zeros": bytes(8192), "text": b"once upon a time" * 300, "of its head": b"VELATURA" + bytes(120),
        "ones": b"\xff" * 9000,
    }.items():  # fmt: skip
        for word, more in (("verify", ()), ("inspect", ()), ("install", ("{stage}",))):
            yield Case(f"bundle: {name} for {word}", put("b.vel", content, ("bundle", word, "{here}/b.vel", *more)))
    for kind in ODD:
        yield Case(f"bundle a {kind}", odd("b.vel", kind, ("bundle", "verify", "{here}/b.vel")))
        yield Case(f"key a {kind}", odd("k.key", kind, ("bundle", "sign", "{here}/b.vel", "--key", "{here}/k.key")))
        yield Case(f"current bundle a {kind}", odd("stage/bundles/current", kind, ("play", "{stage}", "gloss")))


def _words() -> Iterator[Case]:
    lines: Sequence[Sequence[str]] = (
        ("calibrate", ""), ("calibrate", "{stage}\nx"), ("calibrate", "{stage}" + "/x" * 3000),
        ("calibrate", "{stage}", "--mode", "slow"), ("calibrate", "{stage}", "--dot-spacing", "9"),
        ("calibrate", "{stage}", "--mode", "paper", "--dot-spacing", HUGE),
        ("calibrate", "{stage}", "--mode", "paper", "--dot-spacing", "\u0663"),
        ("calibrate", "{stage}", "--projector", "nobody"),
        ("calibrate", "{stage}", "--quick", "--projector", "x" * 900),
        ("play", "{stage}", "x", "--fade", "nan"), ("play", "{stage}", "x", "--seconds", "-1"),
        ("play", "{stage}", "x", "--repeat", HUGE), ("play", "{stage}", "\udcff"),
        ("appearance", "{stage}", "\U0001f4a1"), ("appearance", "{stage}", "--device", "pink"),
        ("appearance", "{stage}", "--scheduler", "http://x"), ("keys", "{stage}", "--name", "../x"),
        ("keys", "{stage}", "--name", ""), ("keys", "{stage}", "--name", "x" * 4000),
        ("live", "{stage}", "{here}/nothing"), ("live", "{stage}", "{here}", "--fps", "nan"),
        ("demo", "--prepare-only", "--out", "/dev/null/x"), ("demo", "--prepare-only", "--out", "/proc/x"),
        ("demo", "--prepare-only", "--out", "{here}/" + "x" * 300), ("demo", "--prepare-only", "--size", ""),
        ("serve", "{stage}", "--panel", "nowhere"), ("serve", "{stage}", "--panel", "127.0.0.1:99999"),
        ("serve", "{stage}", "--panel", "203.0.113.9:8377"), ("serve", "{stage}", "--certificate", "{here}/no.pem"),
        ("serve", "{stage}", "--mqtt", "x:y"), ("serve", "{stage}", "--mqtt", "x", "--mqtt-password-file", "{here}/no"),
        ("events", "{stage}", "--level", "loud"), ("schedule", "{stage}", "--hours", "someday=1-2"),
        ("schedule", "{stage}", "--zone", "\0"), ("schedule", "{stage}", "--drift-check", "25:99"),
        ("compute", "{stage}", "\U0001f4a1", "{here}/no.png"), ("feasibility", "{stage}", "{here}/no.png"),
        ("show", "{stage}", "x" * 9000), ("remove", "{stage}", ".."), ("recalibrate", "{stage}"),
        ("init", "{stage}/stage.toml", "--yes"), ("emulate", "{stage}", "--scenario", "{here}/no.toml"),
        ("study", "no-such-experiment", "--out", "{here}/s"), ("bundle", "rollback", "{stage}"),
        ("bundle", "diff", "{here}/a", "{here}/b"), ("bundle", "export", "{here}/a", "--out", "{stage}"),
        ("camera", "calibrate", "{here}/no.jpg"), ("nonsense",), ("--no-such-option",),
    )  # fmt: skip
    for number, words in enumerate(lines):
        yield Case(f"words {number}: {' '.join(words)[:30]!a}", typed(words))
