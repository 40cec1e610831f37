"""The planted bugs are bugs of the code as it is now."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

from tests.campaigns.planted import ROOT, patches


@pytest.mark.parametrize("patch", patches(), ids=lambda patch: patch.stem)
def test_a_planted_bug_still_fits_the_code(patch: Path) -> None:
    done = subprocess.run(
        ["git", "apply", "--check", str(patch)], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
