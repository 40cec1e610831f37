"""The distribution velatura-lab: its commands, and what is installed with it."""

from __future__ import annotations

import tomllib
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest

from controller import __main__ as shell
from controller.cli import groups
from hal.errors import DeviceError
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


@pytest.mark.parametrize("part", ["boards", "bumps", "dousers", "mitsuba", "scenario", "tape", "usb"])
def test_the_lab_brings_parts_of_the_bench(part: str, monkeypatch: pytest.MonkeyPatch) -> None:
    assert EntryPoint(part, PROJECT["project"]["entry-points"][extensions.GROUP][part], extensions.GROUP).load()
    for found in ((), (EntryPoint(part, "no_such_module_at_all:Part", extensions.GROUP),)):
        monkeypatch.setattr(extensions, "entry_points", lambda group, name, found=found: found)
        with pytest.raises(DeviceError, match="needs the distribution velatura-lab") as refused:
            extensions.extension(part, asked_by="This stage")
        assert refused.value.code == "bench-part-missing"


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
