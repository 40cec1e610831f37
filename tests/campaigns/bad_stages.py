"""Bad files of a stage's own: its settings, profiles, kiosk files and folders."""

from __future__ import annotations

import io
import json
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from tests.campaigns.bad_cases import HUGE, ODD, Case, Prepare, edited, filled, odd, put


def cases() -> Iterator[Case]:
    parts = (_stage_texts, _stage_files, _profiles, _lenses, _kiosk_files, _folders, _bench_files)
    for part in parts:
        yield from part()


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
        yield Case(f"stage: {name}", edited("stage.toml", old, new))
    wholes = {
        "empty": b"", "zeros": bytes(4096), "utf-16": "[stage]".encode("utf-16"),
        "latin-1": b'[stage]\nname = "\xe4"\n',
        "binary": bytes(range(256)) * 64, "two megabytes": b"# x\n" * 600_000, "mark only": b"\xef\xbb\xbf",
        "json": b'{"stage": {"name": "x"}}', "xml": b"<stage/>", "newlines": b"\n" * 1_000_000,
        "many tables": b"[[projectors]]\n" * 60_000,
    }  # fmt: skip
    for name, content in wholes.items():
        yield Case(f"stage: {name}", put("stage/stage.toml", content, ("calibrate", "{stage}")))
    for command in ("status", "settings", "doctor", "keys", "appearance", "play", "backup"):
        yield Case(f"stage: nan for {command}", edited("stage.toml", "iso = 100", "iso = nan", (command, "{stage}")),
                   refused=command not in ("settings", "backup", "doctor"))  # fmt: skip


def _stage_files() -> Iterator[Case]:
    for kind in ODD:
        for command in ("calibrate", "status", "settings"):
            yield Case(f"stage file a {kind} for {command}", odd("stage/stage.toml", kind, (command, "{stage}")),
                       refused=command != "settings")  # fmt: skip
        yield Case(f"stage given as a {kind}", odd("given", kind, ("calibrate", "{here}/given")))


def _profiles() -> Iterator[Case]:
    for kind in ODD:
        yield Case(f"profile a {kind}", odd("stage/bench/optoma-fast.toml", kind, ("calibrate", "{stage}")))
    for name, content in {
        "empty": b"", "zeros": bytes(999), "wrong": b'protocol = "serial"\nbaud = "fast"\n', "mark": b"\xef\xbb\xbf",
        "huge number": f"protocol = 'serial'\n[serial]\nbaud = {HUGE}\n".encode(), "list": b"protocol = [1]\n",
        "large": b"#" * 2_000_000,
    }.items():  # fmt: skip
        path = "stage/bench/optoma-fast.toml"
        yield Case(f"profile: {name}", put(path, content, ("calibrate", "{stage}")))


def _lenses() -> Iterator[Case]:
    for kind in ODD:
        yield Case(f"lens a {kind}", odd("stage/camera-intrinsics.toml", kind, ("calibrate", "{stage}")))
    for name, content in {
        "empty": b"", "zeros": bytes(999), "nan": b"focal_length_px = nan\n", "list": b"size_px = [[1], 2]\n",
        "negative": b"focal_length_px = -5.0\nsize_px = [10, 10]\n", "large": b"#" * 2_000_000,
    }.items():  # fmt: skip
        path = "stage/camera-intrinsics.toml"
        yield Case(f"lens: {name}", put(path, content, ("calibrate", "{stage}")))


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
            yield Case(f"{Path(file).name}: {name}", put(file, content, command), refused=False)
        for kind in ("pipe", "folder", "device"):
            yield Case(f"{Path(file).name} a {kind}", odd(file, kind, command), refused=False)
    for name, content in {"empty": b"", "text": b"no", "gzip cut off": b"\x1f\x8b\x08\0"}.items():
        yield Case(f"backup: {name}", put("b.tar.gz", content, ("restore", "{stage}", "{here}/b.tar.gz")))
    for kind in ODD:
        yield Case(f"backup a {kind}", odd("b.tar.gz", kind, ("restore", "{stage}", "{here}/b.tar.gz")))
        yield Case(f"settings a {kind}", odd("s.toml", kind, ("settings", "{stage}", "--check", "{here}/s.toml")))


def _folders() -> Iterator[Case]:
    def run_of(content: bytes) -> Prepare:
        return put("stage/runs/20260101-000000-calibrate/journal.sqlite", content, ("appearance", "{stage}"))

    for name, content in {"empty": b"", "zeros": bytes(5000), "text": b"no journal"}.items():
        yield Case(f"journal: {name}", run_of(content))
    journal = "stage/runs/20260101-000000-calibrate/journal.sqlite"
    for kind in ("pipe", "folder", "device", "dangling"):
        yield Case(f"journal a {kind}", odd(journal, kind, ("appearance", "{stage}")))
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
        yield Case(f"wrong folder: {' '.join(words)}", partial(filled, words))


def _bench_files() -> Iterator[Case]:
    emulate = ("emulate", "{stage}")
    for name, content in {
        "empty": b"",
        "zeros": bytes(900),
        "nan": b"latency_s = nan\n",
        "list": b"camera = []\n",
    }.items():
        yield Case(f"bench: {name}", put("stage/bench.toml", content, emulate))
    for kind in ODD:
        yield Case(f"bench a {kind}", odd("stage/bench.toml", kind, emulate))
        yield Case(f"scenario a {kind}", odd("s.toml", kind, (*emulate, "--scenario", "{here}/s.toml")))
    damaged = io.BytesIO()
    np.save(damaged, np.zeros(3))
    yield Case("bench: object damaged", _object(damaged.getvalue()))
    yield Case("usb devices damaged", put("stage/bench/usb.toml", json.dumps([1]).encode(), emulate))
    yield Case("usb devices a folder", odd("stage/bench/usb.toml", "folder", emulate))


def _object(content: bytes) -> Prepare:
    def prepare(stage: Path, folder: Path) -> Sequence[str]:
        (stage / "bench" / "object.npz").write_bytes(content)
        text = (stage / "bench.toml").read_text()
        text = text.replace('kind = "vase-and-bust"', 'kind = "mesh"').replace('file = ""', 'file = "bench/object.npz"')
        (stage / "bench.toml").write_text(text)
        return ["emulate", str(stage)]

    return prepare
