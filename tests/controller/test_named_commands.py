"""Every command that a sentence names exists, with the options that it names."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import typer

from controller.__main__ import application

ROOT = Path(__file__).parents[2]
FORMATS = r"tape 1|bundle signature 1"
"""First words of file formats; no command is meant."""
NAMED = re.compile(rf"(?<![\w./-])(?:\.venv/bin/)?velatura (?!{FORMATS})([a-z][a-z-]*)((?: [\w./=-]+)*)")


def texts() -> Iterator[tuple[str, str]]:
    """Where, and what: the strings of the program, and the code in its documents."""
    for package in ("controller", "hal", "plugins"):
        for path in sorted((ROOT / package).rglob("*.py")):
            tree = ast.parse(path.read_text())
            for node in ast.walk(tree):
                if isinstance(node, ast.Constant) and isinstance(node.value, str):
                    yield f"{path.relative_to(ROOT)}:{node.lineno}", node.value
    documents = {*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md"), ROOT / "Makefile"}
    past = {ROOT / "CHANGELOG.md", *(ROOT / "docs" / "notes").rglob("*.md")}
    for path in sorted(documents - past):
        for number, line in enumerate(path.read_text().splitlines(), 1):
            code = [line] if line.startswith(("    ", "\t")) else re.findall(r"`([^`]+)`", line)
            for text in code:
                yield f"{path.relative_to(ROOT)}:{number}", text


def wrong(text: str, root: Any) -> list[str]:
    """The commands and options of ``text`` that do not exist."""
    found = []
    for match in NAMED.finditer(text):
        command, words = root, [match[1], *match[2].partition(" -- ")[0].split()]  # then come another program's words
        while words and hasattr(command, "commands") and command.get_command(None, words[0]):
            command = command.get_command(None, words.pop(0))
        if command is root or (hasattr(command, "commands") and words and words[0] not in ("VERB", "--help")):
            found.append(match[0])
            continue
        options = {option for parameter in command.params for option in parameter.opts} | {"--help"}
        found += [f"{match[0]} ({word})" for word in words if word.startswith("--") and word not in options]
    return found


@pytest.fixture(scope="module")
def root() -> Any:
    return typer.main.get_command(application())


def test_every_named_command_exists(root: Any) -> None:
    named = [(where, text) for where, text in texts() if NAMED.search(text)]
    assert len(named) > 20, "the search itself must work"
    assert [f"{where}: {problem}" for where, text in named for problem in wrong(text, root)] == []


@pytest.mark.parametrize(
    "text",
    [
        "Run `velatura repaint STAGE`.",
        "Type 'velatura bundle paint'.",
        "See velatura demo --no-such-option.",
        "Sign it with 'velatura bundle sign FILE --lock KEY'.",
    ],
)
def test_a_command_that_does_not_exist_is_found(text: str, root: Any) -> None:
    assert wrong(text, root)


@pytest.mark.parametrize(
    "text", ["`velatura bundle build STAGE`", "velatura bundle key", "/tmp/velatura is here", "velatura"]
)
def test_a_command_that_exists_is_not_complained_about(text: str, root: Any) -> None:
    assert wrong(text, root) == []
