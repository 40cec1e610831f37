"""The bad inputs of the campaign ``bad_inputs``: files that are damaged, absurd, or no files at all."""

from __future__ import annotations

import io
import json
import os
import socket
import struct
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Final

import cv2
import numpy as np

Prepare = Callable[[Path, Path], Sequence[str]]
"""From a sound stage's folder and an empty folder to the command's words; makes the bad input on the way."""
HUGE: Final = "9" * 400


@dataclass(frozen=True, slots=True)
class Case:
    """``refused``: whether the command must fail; else it may also cope."""

    name: str
    prepare: Prepare
    refused: bool = True


def cases() -> list[Case]:
    """All of them, in an order that mixes nothing: the same on every machine."""
    parts = (_stage_texts, _stage_files, _profiles, _lenses, _meshes, _pictures, _videos, _plans, _sequences, _bundles,
             _kiosk_files, _folders, _words, _bench_files)  # fmt: skip
    return [case for part in parts for case in part()]


def _edit(file: str, old: str, new: str, command: Sequence[str] = ("calibrate", "{stage}")) -> Prepare:
    def prepare(stage: Path, folder: Path) -> Sequence[str]:
        path = stage / file
        text = path.read_text()
        assert old in text, old
        path.write_text(text.replace(old, new, 1), encoding="utf-8")
        return _filled(command, stage, folder)

    return prepare


def _put(name: str, content: bytes, command: Sequence[str]) -> Prepare:
    """``content`` as the file ``name`` of the case's folder, or of the stage where the name begins with ``stage/``."""

    def prepare(stage: Path, folder: Path) -> Sequence[str]:
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
        return _filled(command, stage, folder)

    return prepare


def _odd(name: str, kind: str, command: Sequence[str]) -> Prepare:
    """In the place of the file ``name``, something that is no regular file."""

    def prepare(stage: Path, folder: Path) -> Sequence[str]:
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.unlink(missing_ok=True)
        if kind == "pipe":
            os.mkfifo(path)
        elif kind == "folder":
            path.mkdir()
        elif kind == "socket":
            here = Path.cwd()
            os.chdir(path.parent)  # the path of a socket must be short
            try:
                with socket.socket(socket.AF_UNIX) as bound:
                    bound.bind(path.name)
            finally:
                os.chdir(here)
        elif kind == "device":
            path.symlink_to("/dev/zero")
        elif kind == "loop":
            path.symlink_to(path.name)
        else:
            path.symlink_to("/nowhere/at/all")
        return _filled(command, stage, folder)

    return prepare


def _typed(words: Sequence[str]) -> Prepare:
    """Nothing but these words."""
    return lambda stage, folder: _filled(words, stage, folder)


def _filled(command: Sequence[str], stage: Path, folder: Path) -> list[str]:
    return [word.replace("{stage}", str(stage)).replace("{here}", str(folder)) for word in command]


ODD: Final = ("pipe", "folder", "socket", "device", "loop", "dangling")


def _stage_texts() -> Iterator[Case]:
    edits: Mapping[str, tuple[str, str]] = {
        "iso negative": ("iso = 100", "iso = -1"),
        "iso huge": ("iso = 100", f"iso = {HUGE}"),
        "iso nan": ("iso = 100", "iso = nan"),
        "iso text": ("iso = 100", 'iso = "\\u0000"'),
        "iso list": ("iso = 100", "iso = [1, [2, [3]]]"),
        "iso table": ("iso = 100", "iso = {a = 1}"),
        "iso date": ("iso = 100", "iso = 2026-11-22"),
        "iso boolean": ("iso = 100", "iso = true"),
        "distance zero": ("distance_m = ", "distance_m = 0.0 # "),
        "distance nan": ("distance_m = ", "distance_m = nan # "),
        "distance infinite": ("distance_m = ", "distance_m = inf # "),
        "distance of digits": ("distance_m = ", f"distance_m = {HUGE}.0 # "),
        "width zero": ("width_px = 280", "width_px = 0"),
        "width huge": ("width_px = 280", "width_px = 999999999999"),
        "width beyond 64 bits": ("width_px = 280", "width_px = 99999999999999999999999"),
        "name empty": ('name = "left"', 'name = ""'),
        "name long": ('name = "left"', f'name = "{"x" * 5000}"'),
        "name of controls": ('name = "left"', 'name = "\\u001b[31mred"'),
        "name a path": ('name = "left"', 'name = "../../etc/passwd"'),
        "name of emoji": ('name = "left"', 'name = "\U0001f4a1"'),
        "name right to left": ('name = "left"', 'name = "\u202eleft"'),
        "names twice": ('name = "right"', 'name = "left"'),
        "outputs twice": ('output = "P2"', 'output = "P1"'),
        "driver unknown": ('driver = "ptp"', 'driver = "cam"'),
        "driver a number": ('driver = "ptp"', "driver = 7"),
        "port of nul": ('port = "run/tty-left"', 'port = "\\u0000"'),
        "port empty": ('port = "run/tty-left"', 'port = ""'),
        "port a folder": ('port = "run/tty-left"', 'port = "."'),
        "port a file": ('port = "run/tty-left"', 'port = "stage.toml"'),
        "port long": ('port = "run/tty-left"', f'port = "{"p" * 4000}"'),
        "address empty": ('address = "ptpip', 'address = "" # "'),
        "address strange": ('address = "ptpip', 'address = "ptpip:[::1]:x" # "'),
        "address of digits": ('address = "ptpip', f'address = "ptpip:127.0.0.1:{HUGE}" # "'),
        "lens missing": ('intrinsics = "camera-intrinsics.toml"', 'intrinsics = "nowhere.toml"'),
        "lens a folder": ('intrinsics = "camera-intrinsics.toml"', 'intrinsics = "bench"'),
        "lens left out": ('intrinsics = "camera-intrinsics.toml"', ""),
        "profile a folder": ('profile = "bench/optoma-fast.toml"', 'profile = "bench.toml/x.toml"'),
        "profile of nul": ('profile = "bench/optoma-fast.toml"', 'profile = "\\u0000.toml"'),
        "section twice": ("[camera]", "[safety]\n[camera]"),
        "nested deep": ("[camera]", "x = " + "[" * 3000 + "]" * 3000 + "\n[camera]"),
        "dotted deep": ("[camera]", ".".join("a" * 800) + " = 1\n[camera]"),
        "open string": ("iso = 100", 'iso = "'),
        "open table": ("[camera]", "[camera"),
        "power negative": ("power_down_s = 10.0", "power_down_s = -10.0"),
        "power huge": ("power_down_s = 10.0", "power_down_s = 1e308"),
        "unknown section": ("[camera]", "[wärme]\nx = 1\n[camera]"),
        "frames of nul": ('frames = "run/outputs.frame"', 'frames = "\\u0000"'),
        "zone unknown": ("[safety]", '[schedule]\ntime_zone = "Mars/Base"\n[safety]'),
        "keys wrong": ("trusted_keys = [", 'trusted_keys = ["zz", '),
    }
    for name, (old, new) in edits.items():
        yield Case(f"stage: {name}", _edit("stage.toml", old, new))
    wholes = {
        "empty": b"", "zeros": bytes(4096), "utf-16": "[stage]".encode("utf-16"),
        "latin-1": b'[stage]\nname = "\xe4"\n',
        "binary": bytes(range(256)) * 64, "two megabytes": b"# x\n" * 600_000, "mark only": b"\xef\xbb\xbf",
        "json": b'{"stage": {"name": "x"}}', "xml": b"<stage/>", "newlines": b"\n" * 1_000_000,
        "many tables": b"[[projectors]]\n" * 60_000,
    }  # fmt: skip
    for name, content in wholes.items():
        yield Case(f"stage: {name}", _put("stage/stage.toml", content, ("calibrate", "{stage}")))
    for command in ("status", "settings", "doctor", "keys", "appearance", "play", "backup"):
        yield Case(f"stage: nan for {command}", _edit("stage.toml", "iso = 100", "iso = nan", (command, "{stage}")),
                   refused=command not in ("settings", "backup", "doctor"))  # fmt: skip


def _stage_files() -> Iterator[Case]:
    for kind in ODD:
        for command in ("calibrate", "status", "settings"):
            yield Case(f"stage file a {kind} for {command}", _odd("stage/stage.toml", kind, (command, "{stage}")),
                       refused=command != "settings")  # fmt: skip
        yield Case(f"stage given as a {kind}", _odd("given", kind, ("calibrate", "{here}/given")))


def _profiles() -> Iterator[Case]:
    for kind in ODD:
        yield Case(f"profile a {kind}", _odd("stage/bench/optoma-fast.toml", kind, ("calibrate", "{stage}")))
    for name, content in {
        "empty": b"", "zeros": bytes(999), "wrong": b'protocol = "serial"\nbaud = "fast"\n', "mark": b"\xef\xbb\xbf",
        "huge number": f"protocol = 'serial'\n[serial]\nbaud = {HUGE}\n".encode(), "list": b"protocol = [1]\n",
        "large": b"#" * 2_000_000,
    }.items():  # fmt: skip
        path = "stage/bench/optoma-fast.toml"
        yield Case(f"profile: {name}", _put(path, content, ("calibrate", "{stage}")))


def _lenses() -> Iterator[Case]:
    for kind in ODD:
        yield Case(f"lens a {kind}", _odd("stage/camera-intrinsics.toml", kind, ("calibrate", "{stage}")))
    for name, content in {
        "empty": b"", "zeros": bytes(999), "nan": b"focal_length_px = nan\n", "list": b"size_px = [[1], 2]\n",
        "negative": b"focal_length_px = -5.0\nsize_px = [10, 10]\n", "large": b"#" * 2_000_000,
    }.items():  # fmt: skip
        path = "stage/camera-intrinsics.toml"
        yield Case(f"lens: {name}", _put(path, content, ("calibrate", "{stage}")))


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
        yield Case(f"mesh: {name}", _put("m.obj", text.encode(), (*demo, "{here}/m.obj")))
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
        yield Case(f"mesh: {name}", _put(file, content, (*demo, f"{{here}}/{file}")))
    for kind in ODD:
        yield Case(f"mesh a {kind}", _odd("m.obj", kind, (*demo, "{here}/m.obj")))


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
            yield Case(f"picture: {name} for {command[-1]}", _put(file, content, words))
    for kind in ODD:
        for ending in ("png", "exr", "dng"):
            command = ("camera", "calibrate") if ending == "dng" else ("read-target",)
            more = ("--out", "{here}/lens.toml") if ending == "dng" else ()
            yield Case(
                f"picture a {kind} ({ending})", _odd(f"p.{ending}", kind, (*command, f"{{here}}/p.{ending}", *more))
            )


def _videos() -> Iterator[Case]:
    for name, content in {
        "empty": b"", "zeros": bytes(5000), "text": b"once upon a time",
        "mp4 of its head": b"\0\0\0\x18ftypmp42" + bytes(90),
        "avi of its head": b"RIFF\xff\xff\xff\xffAVI LIST", "a picture": _png(8, 8),
    }.items():  # fmt: skip
        yield Case(f"video: {name}", _put("v.mp4", content, ("read-live", "{here}/v.mp4")), refused=name != "a picture")
    for kind in ODD:
        yield Case(f"video a {kind}", _odd("v.mp4", kind, ("read-live", "{here}/v.mp4")), refused=kind != "folder")
    yield Case("video: a folder of damaged pictures", _put("v/1.png", b"PNG", ("read-live", "{here}/v")))
    yield Case("video: a folder with a huge picture",
               _put("v/1.png", _declared_png(30_000, 30_000), ("read-live", "{here}/v")))  # fmt: skip
    yield Case("video: a folder with a pipe", _odd("v/1.png", "pipe", ("read-live", "{here}/v")))


def _plans() -> Iterator[Case]:
    text = "[object]\nmesh = 'm.obj'\nheight_m = 0.3\n"
    for name, content in {
        "empty": "", "object alone": text, "nan": text.replace("0.3", "nan"), "zero": text.replace("0.3", "0.0"),
        "axes": text + "up = '+q'\n", "no text": "\0\0", "huge": text.replace("0.3", HUGE), "list": "object = [1, 2]\n",
    }.items():  # fmt: skip
        yield Case(f"plan: {name}", _put("plan.toml", content.encode(), ("plan", "{here}/plan.toml")))
    for kind in ODD:
        yield Case(f"plan a {kind}", _odd("plan.toml", kind, ("plan", "{here}/plan.toml")))


def _sequences() -> Iterator[Case]:
    for name, content in {
        "empty": b"", "no list": b"item = 1\n", "nan": b"[[item]]\nappearance = 'x'\nseconds = nan\n",
        "negative": b"repeat = -1\n[[item]]\nappearance = 'x'\n", "binary": bytes(range(256)),
        "deep": b"item = " + b"[" * 5000,
    }.items():  # fmt: skip
        yield Case(f"sequence: {name}", _put("s.toml", content, ("play", "{stage}", "--sequence", "{here}/s.toml")))
    yield Case("sequence a pipe", _odd("s.toml", "pipe", ("play", "{stage}", "--sequence", "{here}/s.toml")))


def _bundles() -> Iterator[Case]:
    for name, content in {
        "empty": b"", "zeros": bytes(8192), "text": b"once upon a time" * 300, "of its head": b"VELATURA" + bytes(120),
        "ones": b"\xff" * 9000,
    }.items():  # fmt: skip
        for word, more in (("verify", ()), ("inspect", ()), ("install", ("{stage}",))):
            yield Case(f"bundle: {name} for {word}", _put("b.vel", content, ("bundle", word, "{here}/b.vel", *more)))
    for kind in ODD:
        yield Case(f"bundle a {kind}", _odd("b.vel", kind, ("bundle", "verify", "{here}/b.vel")))
        yield Case(f"key a {kind}", _odd("k.key", kind, ("bundle", "sign", "{here}/b.vel", "--key", "{here}/k.key")))
        yield Case(f"current bundle a {kind}", _odd("stage/bundles/current", kind, ("play", "{stage}", "gloss")))


def _kiosk_files() -> Iterator[Case]:
    for file, command in (
        ("stage/kiosk/panel/accounts.json", ("account", "list", "{stage}")),
        ("stage/schedule.toml", ("schedule", "{stage}")),
        ("stage/lamps.json", ("lamps", "{stage}")),
        ("stage/kiosk/events.sqlite", ("events", "{stage}")),
    ):
        for name, content in {
            "empty": b"", "zeros": bytes(3000), "list": b"[1, 2]", "deep": b"[" * 9000,
            "nan": b'{"left": {"hours": NaN}}',
            "text": b"once upon a time",
        }.items():  # fmt: skip
            yield Case(f"{Path(file).name}: {name}", _put(file, content, command), refused=False)
        for kind in ("pipe", "folder", "device"):
            yield Case(f"{Path(file).name} a {kind}", _odd(file, kind, command), refused=False)
    for name, content in {"empty": b"", "text": b"no", "gzip cut off": b"\x1f\x8b\x08\0"}.items():
        yield Case(f"backup: {name}", _put("b.tar.gz", content, ("restore", "{stage}", "{here}/b.tar.gz")))
    for kind in ODD:
        yield Case(f"backup a {kind}", _odd("b.tar.gz", kind, ("restore", "{stage}", "{here}/b.tar.gz")))
        yield Case(f"settings a {kind}", _odd("s.toml", kind, ("settings", "{stage}", "--check", "{here}/s.toml")))


def _folders() -> Iterator[Case]:
    def run_of(content: bytes) -> Prepare:
        return _put("stage/runs/20260101-000000-calibrate/journal.sqlite", content, ("appearance", "{stage}"))

    for name, content in {"empty": b"", "zeros": bytes(5000), "text": b"no journal"}.items():
        yield Case(f"journal: {name}", run_of(content))
    journal = "stage/runs/20260101-000000-calibrate/journal.sqlite"
    for kind in ("pipe", "folder", "device", "dangling"):
        yield Case(f"journal a {kind}", _odd(journal, kind, ("appearance", "{stage}")))
    for file in ("run", "runs", "kiosk", "bundles", "keys"):

        def prepare(stage: Path, folder: Path, file: str = file) -> Sequence[str]:
            if (stage / file).is_dir():
                (stage / file).rename(stage / f"{file}.away")
            (stage / file).write_text("a file in the place of a folder")
            command = {"run": "calibrate", "runs": "appearance", "kiosk": "backup", "bundles": "play", "keys": "keys"}
            return [command[file], str(stage), *(["x"] if file == "bundles" else [])]

        yield Case(f"a file for the folder {file}", prepare)
    for words in (("export", "{here}/nothing"), ("report", "{here}"), ("report", "{stage}/stage.toml"),
                  ("export", "{stage}/stage.toml"), ("emulate", "{here}"),
                  ("emulate", "{stage}/stage.toml")):  # fmt: skip
        yield Case(f"wrong folder: {' '.join(words)}", partial(_filled, words))


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
        ("appearance", "{stage}", "\U0001f4a1"), ("appearance", "{stage}", "--base", "pink"),
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
        yield Case(f"words {number}: {' '.join(words)[:30]!a}", _typed(words))


def _bench_files() -> Iterator[Case]:
    emulate = ("emulate", "{stage}")
    for name, content in {
        "empty": b"",
        "zeros": bytes(900),
        "nan": b"latency_s = nan\n",
        "list": b"camera = []\n",
    }.items():
        yield Case(f"bench: {name}", _put("stage/bench.toml", content, emulate))
    for kind in ODD:
        yield Case(f"bench a {kind}", _odd("stage/bench.toml", kind, emulate))
        yield Case(f"scenario a {kind}", _odd("s.toml", kind, (*emulate, "--scenario", "{here}/s.toml")))
    damaged = io.BytesIO()
    np.save(damaged, np.zeros(3))
    yield Case("bench: object damaged", _object(damaged.getvalue()))
    yield Case("usb devices damaged", _put("stage/bench/usb.toml", json.dumps([1]).encode(), emulate))
    yield Case("usb devices a folder", _odd("stage/bench/usb.toml", "folder", emulate))


def _object(content: bytes) -> Prepare:
    def prepare(stage: Path, folder: Path) -> Sequence[str]:
        (stage / "bench" / "object.npz").write_bytes(content)
        text = (stage / "bench.toml").read_text()
        text = text.replace('kind = "vase-and-bust"', 'kind = "mesh"').replace('file = ""', 'file = "bench/object.npz"')
        (stage / "bench.toml").write_text(text)
        return ["emulate", str(stage)]

    return prepare
