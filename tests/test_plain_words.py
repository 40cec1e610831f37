"""Texts are in plain words: no archaic phrase, and in messages no sentence that needs a second reading.

They are the messages, help and templates of the product, the README and every page of the documentation, and for
developers the docstrings, comments and module names of all code.
"""

from __future__ import annotations

import ast
import io
import re
import tokenize
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import pytest

ROOT: Final = Path(__file__).parents[1]
FOLDERS: Final = ("controller", "hal", "plugins")
"""Folders whose messages, help and templates are in plain words."""
CODE: Final = (*FOLDERS, "lab", "tests", "firmware_configs")
"""Folders whose docstrings, comments and module names are in plain words."""
PAGES: Final = ("docs", "README.md")
"""Pages, and folders of them, in plain words."""
LONGEST: Final = 25
"""Words in a sentence of ``what`` and ``remedy``."""

PLAIN: Final = {
    r"anew|afresh": "again",
    r"mend(s|ed|ing)?": "repair, or correct",
    r"told|tells? (of|that|whether|apart)": "reported, shows",
    r"tell\w* .{0,40}\bapart": "distinguish",
    r"nobody": "no one is there, unknown, or the passive",
    r"(is|are|was|be) borne": "is supported",
    r"(gone|going|goes|go) on( with)?": "continue",
    r"comes? of": "results from",
    r"let(s)? nobody in": "refuses the connection",
    r"at hand": "available",
    r"what it is": "name the thing",
    r"wish(es|ed)?": "request, or setting",
    r"no lesser": "minimum",
    r"in vain": "without success",
    r"whoever|whomever": "the person who",
    r"of itself": "its own",
    r"the one before": "the previous one",
    r"come to its end": "finished",
    r"left out:": "if omitted:",
    r"hinders?": "prevents",
    r"heed(s|ed)?": "follow",
    r"amiss|awry|astray": "wrong, or stray",
    r"beforehand": "before, or in advance",
    r"besides": "also, or in addition",
    r"reckon(ed|ing|s)?": "calculate, or count",
    r"shall": "must, or will",
    r"hitherto|henceforth|thereof|wherein|lest|nought": "a modern word",
    r"spoken to": "accepts commands",
    r"bent into reach": "adapted to the available light",
    r"kept beside": "stored with",
    r"is no (bundle|demo|study|video|result|picture|file)": "is not a ...",
}  # fmt: skip
"""Expressions that must not appear, each with its plain replacement."""
PHRASE: Final = re.compile("|".join(rf"(?P<p{n}>\b(?:{text})(?!\w))" for n, text in enumerate(PLAIN)), re.IGNORECASE)


def texts(source: str) -> Iterator[tuple[int, str, str]]:
    """(line, name of the argument or "", text) of each literal of two words or more; docstrings are not among them.

    What a string inserts counts as one word.
    """
    tree = ast.parse(source)
    inside = {id(part) for node in ast.walk(tree) if isinstance(node, ast.JoinedStr) for part in ast.walk(node)}
    skipped = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    names = {
        id(part): keyword.arg or ""
        for node in ast.walk(tree)
        if isinstance(node, ast.Call)
        for keyword in node.keywords
        for part in ast.walk(keyword.value)
    }
    for node in ast.walk(tree):
        if id(node) in skipped:
            continue
        if isinstance(node, ast.JoinedStr):
            text = "".join(str(p.value) if isinstance(p, ast.Constant) else "{}" for p in node.values)
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in inside:
            text = node.value
        else:
            continue
        if len(text.split()) > 1:
            yield node.lineno, names.get(id(node), ""), text


def notes(source: str) -> Iterator[tuple[int, str]]:
    """(line, text) of each comment and docstring, without the code that it quotes: for developers."""
    statement = {tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.NL, tokenize.COMMENT, tokenize.ENCODING}
    before = tokenize.ENCODING
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        is_docstring = token.type == tokenize.STRING and token.string.endswith('"""') and before in statement
        if token.type == tokenize.COMMENT or is_docstring:
            yield token.start[0], re.sub(r"``.*?``|`.*?`", "", token.string, flags=re.DOTALL)
        before = token.type


def faults(argument: str, text: str) -> list[str]:
    """What is wrong with one text, each with what to write instead."""
    found = []
    for match in PHRASE.finditer(text):
        plain = list(PLAIN.values())[int((match.lastgroup or "p0")[1:])]
        found.append(f"{match[0]!r}: write {plain}")
    if argument in ("what", "remedy"):
        for sentence in re.split(r"[.!?;:](?:\s|$)", text):
            if len(sentence.split()) > LONGEST:
                found.append(f"{len(sentence.split())} words in a sentence: split it")
    return found


@pytest.mark.parametrize("folder", FOLDERS)
def test_messages_and_help_are_plain(folder: str) -> None:
    wrong = [
        f"{path.relative_to(ROOT)}:{line}: {fault} in {text[:80]!r}"
        for path in sorted((ROOT / folder).rglob("*.py"))
        for line, argument, text in texts(path.read_text())
        for fault in faults(argument, text)
    ]
    assert wrong == []


@pytest.mark.parametrize("folder", CODE)
def test_docstrings_comments_and_module_names_are_plain(folder: str) -> None:
    files = [path for path in sorted((ROOT / folder).rglob("*.py")) if path != Path(__file__)]
    wrong = [
        f"{path.relative_to(ROOT)}:{line}: {fault}"
        for path in files
        for line, text in [(1, path.stem.replace("_", " ")), *notes(path.read_text("utf-8"))]
        for fault in faults("", text)
    ]
    assert wrong == []


@pytest.mark.parametrize("folder", [*FOLDERS, *PAGES])
def test_templates_and_pages_are_plain(folder: str) -> None:
    pages = [path for path in (ROOT / folder, *(ROOT / folder).rglob("*")) if path.suffix in (".html", ".md")]
    wrong = [
        f"{path.relative_to(ROOT)}:{number}: {fault}"
        for path in sorted(pages)
        for number, line in enumerate(path.read_text().splitlines(), 1)
        for fault in faults("", line)
    ]
    assert wrong == []


def test_every_folder_and_page_exists() -> None:
    assert [folder for folder in FOLDERS if not (ROOT / folder).is_dir()] == []
    assert [page for page in PAGES if not (ROOT / page).exists()] == []


def test_faults_are_found() -> None:
    long = " ".join(["word"] * (LONGEST + 1))
    source = f'''
"""Nobody: a docstring."""
E = Error("code", what=f"The file {{name}} was told off.", remedy="Mend it. {long}")
HELP = {{"key": "made anew each time"}}
'''
    assert [faults("", text) for _, text in notes(source)] == [[f"'Nobody': write {PLAIN['nobody']}"]]
    assert list(notes("x = 1  # ``told`` is a name, anew\n")) == [(1, "#  is a name, anew")]
    found = {argument: faults(argument, text) for _, argument, text in texts(source)}
    assert [fault.split(":")[0] for fault in found["what"]] == ["'told'"]
    assert [fault.split(":")[0] for fault in found["remedy"]] == ["'Mend'", f"{LONGEST + 1} words in a sentence"]
    assert [fault.split(":")[0] for fault in found[""]] == ["'anew'"]
