"""Programs from npm that judge ours: ``.ci/setup-npm`` installs them."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path
from typing import Final

import pytest

PACKAGES: Final = Path(__file__).parents[1] / ".venv-npm" / "node_modules"
needs_npm: Final = pytest.mark.skipif(
    not PACKAGES.exists() or shutil.which("node") is None, reason="needs npm packages (.ci/setup-npm)"
)


def run_node(script: Path, *words: str, folder: Path | None = None, check: bool = True) -> str:
    """What a script prints, with the packages available."""
    environment = {**os.environ, "NODE_PATH": str(PACKAGES), "NODE_NO_WARNINGS": "1"}
    done = subprocess.run(
        ["node", str(script), *words], cwd=folder, env=environment, text=True, capture_output=True, timeout=120,
        check=False,
    )  # fmt: skip
    assert not check or done.returncode == 0, done.stdout + done.stderr
    return done.stdout
