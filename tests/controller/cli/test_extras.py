"""Commands without the packages that they need: one sentence says which extra to install; never a traceback."""

from __future__ import annotations

import ast
import json
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import pytest
import typer

from controller.core.extras import EXTRA_OF, EXTRAS, extra_missing

ROOT = Path(__file__).parents[3]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
NAMES = {
    "OpenEXR": "openexr", "PIL": "pillow", "StreamDeck": "streamdeck", "argon2": "argon2-cffi", "hid": "hidapi",
    "cv2": "opencv-contrib-python-headless", "multipart": "python-multipart", "nacl": "pynacl", "serial": "pyserial",
    "prometheus_client": "prometheus-client", "python_multipart": "python-multipart",
    "usb": "pyusb", "pythonosc": "python-osc", "zenoh": "eclipse-zenoh",
}  # fmt: skip
"""The distribution of a module, where it is called otherwise."""
INDIRECT = {
    "anyio": "starlette", "cycler": "matplotlib", "llvmlite": "numba", "pydantic_core": "pydantic",
}  # fmt: skip
"""Modules that come with another distribution."""
OWN_PROCESS = {"bpy", "mathutils", "scenes"}
BLOCKED = """
import contextlib, io, json, sys
blocked = set(sys.argv[1].split())
class Blocker:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in blocked:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
sys.meta_path.insert(0, Blocker())
from controller.__main__ import run
for line in sys.stdin:
    words = json.loads(line)
    out = io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(out):
        code = run(words)
    print(json.dumps({"words": words, "code": code, "text": out.getvalue()}), flush=True)
"""


def distributions(requirements: Iterable[str]) -> set[str]:
    return {re.split(r"[^\w.-]", requirement)[0].lower() for requirement in requirements}


def imported() -> dict[str, set[str]]:
    """Each module of others that the product imports, and the files that do."""
    found: dict[str, set[str]] = {}
    own = {"controller", "hal", "plugins", "firmware_configs", "__future__"}
    for file in (file for top in ("controller", "hal", "plugins") for file in (ROOT / top).rglob("*.py")):
        for node in ast.walk(ast.parse(file.read_text("utf-8"))):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            if isinstance(node, ast.ImportFrom) and node.module and not node.level:
                names = [node.module]
            for top in {name.partition(".")[0] for name in names} - own - sys.stdlib_module_names:
                found.setdefault(top, set()).add(file.relative_to(ROOT).as_posix())
    return found


def test_every_import_of_the_product_has_its_extra() -> None:
    needed = {name for name, files in imported().items() if not all("hal/conformance" in file for file in files)}
    assert needed - OWN_PROCESS <= set(EXTRA_OF)
    assert set(EXTRA_OF.values()) - {""} == set(EXTRAS)


@pytest.mark.parametrize("module", EXTRA_OF)
def test_the_extra_named_brings_the_module(module: str) -> None:
    extra = EXTRA_OF[module]
    listed = PROJECT["optional-dependencies"][extra] if extra else PROJECT["dependencies"]
    wanted = INDIRECT.get(module, NAMES.get(module, module))
    assert wanted.lower() in distributions(listed)
    error = extra_missing(f"{module}.inside")
    assert error is not None
    assert error.code == "extra-missing"
    assert (f"velatura[{extra}]" if extra else "pip install velatura") in error.remedy


@pytest.mark.parametrize(
    ("name", "wanted"),
    [
        ("demo", ("controller", "panel", "bench")),
        ("kiosk", ("controller", "panel", "bench", "building", "gphoto2", "mains")),
    ],
)
def test_an_environment_has_what_its_commands_use(name: str, wanted: Sequence[str]) -> None:
    lock = set(re.findall(r"^([\w.-]+)==", (ROOT / f"requirements-{name}.lock").read_text(), re.MULTILINE))
    for extra in wanted:
        assert distributions(PROJECT["optional-dependencies"][extra]) <= lock
    assert distributions(PROJECT["dependencies"]) <= lock


def outcomes(blocked: Iterable[str], commands: Sequence[Sequence[str]]) -> list[dict[str, Any]]:
    done = subprocess.run(
        [sys.executable, "-c", BLOCKED, " ".join(blocked)],
        input="".join(json.dumps(list(words)) + "\n" for words in commands),
        capture_output=True, text=True, cwd=ROOT, timeout=600, check=True,
    )  # fmt: skip
    return [json.loads(line) for line in done.stdout.splitlines()]


def every_command() -> list[list[str]]:
    from controller.__main__ import application
    from controller.cli.groups import words_of

    return [words.split() for words in words_of(typer.main.get_command(application()))]


WORKS = ("status", "settings", "backup", "lamps", "events", "schedule", "appearances", "diagnostics")
"""Of ``velatura kiosk``: what works on a stage that no kiosk runs."""


def of_extras(*names: str) -> set[str]:
    return {module for module, extra in EXTRA_OF.items() if extra in names}


def cheap(stage: Path, away: Path) -> dict[str, list[str]]:
    """An invocation of each command that opens no device and ends at once, whatever is installed."""
    picture, bundle = str(away / "no.png"), str(away / "no.vel")
    given: Mapping[str, list[str]] = {
        "demo": ["--object", str(stage / "stage.toml"), "--out", str(away / "d")],
        "emulate": [str(away / "nowhere")], "record": [str(away / "nowhere")], "export": [str(away)],
        "plan": [str(away / "no.toml")],
        "report": [str(away)],
        "kiosk serve": [str(stage), "--panel", "none"], "init": [str(stage), "--yes"],
        "kiosk install": ["--dry-run", "--backup", picture], "kiosk uninstall": ["--dry-run", "none"],
        "kiosk add": [str(stage), "x", picture], "kiosk reach": [str(stage), picture], "bundle key": [str(stage)],
        "kiosk restore": [str(stage), picture], "live": [str(stage), picture],
        **{f"kiosk {verb}": [str(stage)] for verb in WORKS},
        "bundle build": [str(stage)], "bundle diff": [bundle, bundle], "bundle sign": [bundle, "--key", picture],
        "bundle install": [bundle, str(stage)], "bundle rollback": [str(stage)],
        "bundle export": [bundle, "--out", picture],
        "camera board": ["--out", str(away / "board.png")], "kiosk account list": [str(stage)],
    }  # fmt: skip
    found = {}
    for words in every_command():
        name = " ".join(words)
        usual = [bundle] if words[0] == "bundle" else [picture] if words[0] == "camera" else [str(stage), "x"]
        if len(words) == 1:
            usual = [str(stage)]
        found[name] = [*words, *given.get(name, usual), "--json"]
    return found


@pytest.fixture
def stage(tmp_path: Path) -> Path:
    folder = tmp_path / "stage"
    folder.mkdir()
    text = '[stage]\nname = "x"\n[[projectors]]\nname = "a"\noutput = "P"\ndriver = "pjlink"\naddress = "192.0.2.7"\n'
    text += (
        '[camera]\ndriver = "ptp"\naddress = "ptpip:192.0.2.9"\niso = 100\nfocal_length_px = 900.0\ndistance_m = 1.0\n'
    )
    (folder / "stage.toml").write_text(text + '[display]\ndriver = "player"\n')
    return folder


@pytest.mark.parametrize("missing", [("panel",), ("bench",), ("panel", "bench", "cluster", "gphoto2"), ("controller",)])
def test_without_an_extra_every_command_works_or_names_it(
    missing: tuple[str, ...], stage: Path, tmp_path: Path
) -> None:
    blocked = of_extras(*missing) - {"typer", "pydantic", "pydantic_core"}  # without these, there are no commands
    commands = list(cheap(stage, tmp_path).values())
    skipped = ("doctor", "init")  # they look at every bus of this machine
    commands = [words for words in commands if words[0] not in skipped]
    named = 0
    for one in outcomes(blocked, commands):
        assert one["code"] in (0, 1, 2, 3), one
        assert "Traceback" not in one["text"]
        lines = [json.loads(line) for line in one["text"].splitlines() if line.startswith("{")]
        codes = [line["error"]["code"] for line in lines if "error" in line]
        assert "crash" not in codes, one
        if "extra-missing" in codes:
            named += 1
            assert any(f"velatura[{extra}]" in one["text"] for extra in missing), one
    assert named


def test_in_the_demos_environment_no_command_misses_anything(stage: Path, tmp_path: Path) -> None:
    tests = distributions(PROJECT["optional-dependencies"]["test"]) | {"pytest", "gphoto2", "dask", "distributed"}
    blocked = {name.replace("-", "_") for name in tests} - {"gphoto2"}
    helps = [[*words, "--help"] for words in every_command()]
    for one in outcomes(blocked, helps):
        assert one["code"] == 0, one
        assert "Usage" in one["text"]
    used = cheap(stage, tmp_path)
    works = {"bundle key", "kiosk account list", *(f"kiosk {verb}" for verb in WORKS)}
    for one in outcomes(blocked, [words for name, words in used.items() if name not in ("doctor", "init")]):
        assert "extra-missing" not in one["text"], one
        assert '"crash"' not in one["text"], one
        words = " ".join(one["words"])
        assert one["code"] == 0 or not any(words.startswith(f"{name} ") for name in works), one
