"""What a person installs by the documentation is pinned by hash, as the lock files pin it."""

from __future__ import annotations

import re
from pathlib import Path

from typer.testing import CliRunner

from controller.__main__ import application

ROOT = Path(__file__).parents[2]


def test_every_package_of_a_kiosk_comes_from_a_lock_file_with_hashes_or_from_the_folder() -> None:
    page = (ROOT / "docs" / "how-to" / "install-kiosk.md").read_text()
    assert re.search(r"^(sudo )?apt install \./\S+\.deb$", page, re.MULTILINE)
    for typed in re.findall(r"pip install([^`]*)", page):
        assert "--require-hashes" in typed or "--no-deps" in typed, f"pip install{typed} goes past the lock files"
    package = (ROOT / ".ci" / "debian_package.py").read_text()
    locks = re.findall(r"requirements-[a-z]+\.lock", page + package)
    assert "requirements-kiosk.lock" in locks
    for lock in set(locks):
        text = (ROOT / lock).read_text()
        pinned = re.findall(r"^[A-Za-z0-9._-]+==", text, re.MULTILINE)
        assert pinned
        assert "setuptools==" in text or "player" in lock, "nothing is fetched to build Velatura itself"
        for block in re.split(r"^(?=[A-Za-z0-9._-]+==)", text, flags=re.MULTILINE)[1:]:
            assert "--hash=sha256:" in block, block.splitlines()[0]


def test_options_of_serve_in_the_documentation_are_those_of_the_program() -> None:
    told = CliRunner().invoke(application(), ["kiosk", "serve", "--help"], env={"COLUMNS": "200"}).output
    known = set(re.findall(r"--[a-z][a-z-]+", told))
    assert "--certificate" in known
    pages = [ROOT / "docs" / "how-to" / name for name in ("run-a-kiosk.md", "panel.md")]
    text = "\n".join([*(page.read_text() for page in pages), (ROOT / "docs/reference/http-api.md").read_text()])
    network = text[text.index("## Network") : text.index("## Security")] + text[: text.index("## First start")]
    named = set(re.findall(r"(?<![\w-])--[a-z][a-z-]+", network)) | set(re.findall(r"--mqtt[a-z-]*", text))
    assert named
    assert named <= known, named - known
