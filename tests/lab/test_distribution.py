"""The distribution velatura-lab: its commands, and what is installed with it."""

from __future__ import annotations

import re
import subprocess
import sys
import tomllib
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest

from controller import __main__ as shell
from controller.cli import groups
from hal.errors import DeviceError
from plugins.emulated.bench import EmulatedBench
from plugins.emulated.core import extensions

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "lab" / "pyproject.toml").read_text())
COMMANDS = PROJECT["project"]["entry-points"][groups.ENTRY_POINTS]


def test_every_package_of_the_lab_is_installed() -> None:
    folders = (file.parent.relative_to(ROOT) for file in (ROOT / "lab").rglob("__init__.py"))
    assert PROJECT["tool"]["setuptools"]["packages"] == sorted(".".join(folder.parts) for folder in folders)


def test_the_lab_needs_the_product_of_its_own_version() -> None:
    version = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    assert PROJECT["project"]["version"] == version
    assert all(requirement.endswith(f"=={version}") for requirement in PROJECT["project"]["dependencies"])


@pytest.mark.parametrize(
    "part", ["boards", "bumps", "dousers", "effects", "mitsuba", "scenario", "solids", "stands", "tape", "usb"]
)
def test_the_lab_brings_parts_of_the_bench(part: str, monkeypatch: pytest.MonkeyPatch) -> None:
    assert EntryPoint(part, PROJECT["project"]["entry-points"][extensions.GROUP][part], extensions.GROUP).load()
    for found in ((), (EntryPoint(part, "no_such_module_at_all:Part", extensions.GROUP),)):
        monkeypatch.setattr(extensions, "entry_points", lambda group, name, found=found: found)
        with pytest.raises(DeviceError, match="needs the distribution velatura-lab") as refused:
            extensions.extension(part, asked_by="This stage")
        assert refused.value.code == "bench-part-missing"


def test_a_hard_room_without_the_lab_is_refused_before_anything_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(extensions, "entry_points", lambda group, name: ())
    with pytest.raises(DeviceError, match='room "hard" needs the distribution velatura-lab') as refused:
        EmulatedBench(room="hard").prepare(tmp_path / "stage", size="small", object_file=None, seed=1)
    assert refused.value.code == "bench-part-missing"
    assert not list(tmp_path.iterdir())


_DEMO = """
import importlib, importlib.metadata as metadata, re, sys
plain = lambda name: re.sub("[-_.]+", "-", name).lower()
locked = {plain(name) for name in re.findall("^([A-Za-z0-9_.-]+)==", open("requirements-demo.lock").read(), re.M)}
locked |= {"velatura", "velatura-lab"}
kept = metadata.packages_distributions().items()
absent = {module for module, names in kept if not locked & set(map(plain, names))}
class Absent:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in absent:
            raise ModuleNotFoundError(name)
sys.meta_path.insert(0, Absent())
for module in sys.argv[1:]:
    importlib.import_module(module)
"""


def test_a_strangers_environment_is_enough_for_the_lab_which_the_first_tutorial_uses() -> None:
    """It moves a projector by ``bench/bumps.toml``; all that a reader has is what `make demo` set up."""
    page = (ROOT / "docs" / "tutorials" / "first-stage.md").read_text()
    assert "bench/bumps.toml" in page
    assert re.search(r'\[ "\$what" != player \]; then\n  install .*\./lab', (ROOT / ".ci" / "setup").read_text())
    entries = PROJECT["project"]["entry-points"]
    modules = {value.partition(":")[0] for group in entries.values() for value in group.values()}
    subprocess.run([sys.executable, "-c", _DEMO, *sorted(modules)], check=True, cwd=ROOT)
    for quoted in ("Ready. Ctrl-C ends.", "The stage is as it was set up, except for"):
        assert quoted in page
        assert quoted in (ROOT / "plugins" / "emulated" / "bench.py").read_text()


def installed(monkeypatch: pytest.MonkeyPatch, commands: dict[str, str]) -> None:
    """These commands are declared by a distribution, and no others."""
    found = {name: EntryPoint(name, value, groups.ENTRY_POINTS) for name, value in commands.items()}
    monkeypatch.setattr(groups, "installed_commands", lambda: found)


def test_the_help_shows_installed_commands_in_a_section_of_their_own(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    installed(monkeypatch, COMMANDS)
    assert shell.run(["--help"]) == 0
    shown = capsys.readouterr().out
    section = shown[shown.index(f"\n{groups.INSTALLED}:\n") :]
    assert all(f"\n  {name} " in section for name in COMMANDS)
    assert shell.run(["study", "--list"]) == 0


@pytest.mark.parametrize("name", groups.LAB)
def test_without_the_lab_its_commands_say_where_they_are(
    name: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    installed(monkeypatch, {})
    assert shell.run(["--help"]) == 0
    assert groups.INSTALLED not in capsys.readouterr().out
    assert shell.run([name, "--seed", "1"]) == 2
    assert "pip install velatura-lab" in capsys.readouterr().err


def test_the_product_knows_the_labs_commands() -> None:
    assert sorted(groups.LAB) == sorted(COMMANDS)


def test_a_command_that_can_not_be_loaded_says_so_and_harms_no_other(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    installed(monkeypatch, {"broken": "no_such_module_at_all:command"})
    assert shell.run(["--help"]) == 0
    assert shell.run(["--version"]) == 0
    capsys.readouterr()
    assert shell.run(["broken"]) == 2
    assert "no_such_module_at_all" in capsys.readouterr().err
