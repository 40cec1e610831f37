"""Sphinx builds the documentation as a website with this file: ``make docs``."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import Any

from pygments.lexers.special import TextLexer
from sphinx.util import logging

DOCS = Path(__file__).resolve().parent
sys.path[:0] = [str(DOCS.parent), str(DOCS)]

import generate  # noqa: E402 - it lies beside this file
import pyglet  # noqa: E402

# pyglet opens a window when its OpenGL module is imported, and there may be no display.
pyglet.options["shadow_window"] = False

project = "Velatura"
extensions = ["myst_parser", "sphinx.ext.autodoc"]
# The pages in generated/ itself are included by pages in reference/; those in generated/api/ are pages of their own.
exclude_patterns = ["generated/*.md"]
nitpicky = True
# Docstrings are plain prose: only base classes of other libraries would be looked up.
nitpick_ignore_regex = [("py:.*", ".*")]
html_theme = "furo"
html_title = "Velatura"
html_copy_source = False
html_show_copyright = False
html_show_sphinx = False
myst_heading_anchors = 4

add_module_names = False
# Without this every page would carry every name of the API in its navigation: half of the build.
toc_object_entries = False
autodoc_default_options = {"members": True, "ignore-module-all": True}
autodoc_member_order = "bysource"
autodoc_mock_imports = ["bpy", "mathutils"]
autodoc_typehints = "none"


def as_text(_app: Any, _what: str, _name: str, _obj: Any, _options: Any, lines: list[str]) -> None:
    """Docstrings are prose with ``literals``; make reStructuredText of it that shows what stands there."""
    paragraphs = re.split(r"\n\s*\n", "\n".join(lines).strip())
    made: list[str] = []
    code = False
    for paragraph in paragraphs:
        code = code and paragraph.startswith("    ")
        before_code = paragraph.endswith("::")
        text = paragraph.removesuffix("::") + ":" if before_code and paragraph != "::" else paragraph.removesuffix("::")
        made += [*(text.splitlines() if code else _paragraph(text.splitlines())), ""]
        if before_code:  # what is indented below it is shown as it stands
            made += ["::", ""]
            code = True
    lines[:] = made


def _paragraph(lines: list[str]) -> list[str]:
    if len(lines) > 1 and set(lines[1].strip()) == {"-"}:  # a heading in the style of numpydoc
        return [f"**{lines[0].strip()}**", "", *_paragraph(lines[2:])]
    if sum(re.match(r"``[^`]+`` |[\w, ]+ : |- ", line) is not None for line in lines) > 1:
        return [("  " if line.startswith(" ") else "| ") + _escaped(line.strip()) for line in lines]
    return [_escaped(line.strip()) for line in lines]


def _escaped(line: str) -> str:
    parts = re.split(r"(``[^`]+``)", line)
    return "".join(
        part if part.startswith("``") and len(part) > 4 else re.sub(r"([\\*`_|:])", r"\\\1", part) for part in parts
    )


def setup(app: Any) -> None:
    generate.write_all()
    for problem in generate.missing_paths():
        logging.getLogger(__name__).warning(problem)
    app.connect("autodoc-process-docstring", as_text)
    app.add_lexer("mermaid", TextLexer)  # diagrams that code hosts draw; shown as text here
