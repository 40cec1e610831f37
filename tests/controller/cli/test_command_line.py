"""The first help, the nearest command, `--json` everywhere, and what the shell completes."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from importlib import metadata
from pathlib import Path
from typing import Any

import pytest
import typer

from controller.__main__ import MEMBERS, application, run
from controller.cli.groups import installed_commands, nearest, words_of
from tests.controller.kiosk.test_boot import STAGE


@pytest.fixture(scope="module")
def root() -> Any:
    return typer.main.get_command(application())


def commands(group: Any, before: str = "velatura") -> Iterator[tuple[str, Any]]:
    for name, command in group.commands.items():
        if hasattr(command, "commands"):
            yield from commands(command, f"{before} {name}")
        else:
            yield f"{before} {name}", command


def test_the_first_help_has_at_most_twenty_lines_of_commands(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["--help"]) == 0
    shown = capsys.readouterr().out
    places = [shown.index(f"\n{title}:\n") for title in MEMBERS if title]
    assert places == sorted(places)
    lines = [line for line in shown[places[0] :].splitlines() if line.startswith("  ")]
    assert len(lines) <= 20
    listed = sum(len(members) for title, members in MEMBERS.items() if title)
    assert len(lines) == listed + len(installed_commands()), "each command has one line"


def test_the_version_is_the_packages(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["--version"]) == 0
    assert capsys.readouterr().out == f"velatura {metadata.version('velatura')}\n"


def test_every_command_has_json_as_its_last_option_before_help(root: Any) -> None:
    for words, command in commands(root):
        options = [option.opts[0] for option in command.params if option.param_type_name == "option"]
        assert [option for option in options if option != "--help"][-1] == "--json", words


def test_options_with_choices_list_them(root: Any) -> None:
    named = {"mode", "photographs", "device", "size", "room", "kind", "level", "fit", "role"}
    for words, command in commands(root):
        context = command.context_class(command)
        for option in command.params:
            if option.param_type_name == "option" and option.name in named and not option.is_flag:
                assert "|" in option.get_help_record(context)[0], (words, option.name)


@pytest.mark.parametrize(
    ("typed", "meant"),
    [
        ("calibarte", "calibrate"),
        ("status", "kiosk status"),
        ("serve", "kiosk serve"),
        ("keys", "bundle key"),
        ("recalibrate", "kiosk calibrate"),
        ("compute", "kiosk add"),
        ("seen", "kiosk confirm"),
        ("feasibility", "kiosk reach"),
        ("brightnes", "kiosk brightness"),
    ],
)
def test_a_wrong_command_names_the_nearest(
    typed: str, meant: str, root: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    assert nearest(typed, list(words_of(root)))[0] == meant
    assert run([typed, "somewhere"]) == 2
    assert f"`velatura {meant}`" in capsys.readouterr().err


def test_a_wrong_option_names_the_nearest(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["calibrate", "somewhere", "--projecter", "left", "--json"]) == 2
    error = json.loads(capsys.readouterr().out)["error"]
    assert "--projector" in error["remedy"]


def completed(words: str) -> list[str]:
    environment = os.environ | {"_VELATURA_COMPLETE": "complete_bash", "COMP_WORDS": words}
    environment["COMP_CWORD"] = str(words.count(" "))
    done = subprocess.run(
        [sys.executable, "-m", "controller"], env=environment, capture_output=True, text=True, check=False, timeout=60
    )
    return done.stdout.split()


def test_the_shell_completes_stages_projectors_appearances_and_choices(tmp_path: Path) -> None:
    stage = tmp_path / "demo" / "stage"
    stage.mkdir(parents=True)
    (stage / "stage.toml").write_text(STAGE + '\n[[appearances]]\nname = "gold"\nkind = "gloss"\n')
    assert completed(f"velatura calibrate {tmp_path}/de") == [str(stage)]
    assert completed(f"velatura kiosk show {tmp_path}/demo/") == [str(stage)]
    assert completed(f"velatura calibrate {stage} --projector l") == ["left"]
    assert completed(f"velatura kiosk calibrate {stage} --projector l") == ["left"]
    assert completed(f"velatura appearance {stage} g") == ["gold"]
    assert completed(f"velatura play {stage} g") == ["gold"]
    assert completed(f"velatura kiosk show {stage} g") == ["gold"]
    assert completed(f"velatura calibrate {stage} --mode p") == ["paper"]
    assert "kiosk" in completed("velatura k")
