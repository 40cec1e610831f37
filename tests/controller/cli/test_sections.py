"""`velatura --help` in groups, and `velatura --version`."""

from __future__ import annotations

from collections import Counter
from importlib import metadata

import pytest

from controller.__main__ import COMMANDS, GROUPS, run
from controller.cli.sections import OTHERS, SECTIONS


def test_every_command_is_in_exactly_one_group() -> None:
    names = [command.__name__.replace("_", "-") for command in COMMANDS] + list(GROUPS)
    assert Counter(name for section in SECTIONS.values() for name in section) == Counter(names)


def test_the_help_shows_the_groups_in_order(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["--help"]) == 0
    shown = capsys.readouterr().out
    places = [shown.index(f"\n{title}:\n") for title in SECTIONS]
    assert places == sorted(places)
    assert f"\n{OTHERS}:\n" not in shown


def test_the_version_is_the_packages(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["--version"]) == 0
    assert capsys.readouterr().out == f"velatura {metadata.version('velatura')}\n"
