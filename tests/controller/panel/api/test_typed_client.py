"""A client that a foreign generator makes from the API's document, and the commands of the API's page, as they stand
there.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from controller.core.errors import UsageError
from controller.kiosk.operations.table import OPERATIONS
from controller.kiosk.store.accounts import Role
from tests.controller.panel.served import Served
from tests.controller.panel.test_uploads import jpeg

ROOT = Path(__file__).parents[4]
FILES = ROOT / "docs" / "examples" / "http-client"
PAGE = (ROOT / "docs" / "reference" / "http-api.md").read_text()
GENERATOR = ROOT / ".venv-openapi" / "bin" / "openapi-python-client"
USUAL = "http://127.0.0.1:8377"

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not GENERATOR.exists(), reason="needs openapi-python-client (.ci/setup-peer openapi)"),
]


def typed(fresh: Served, folder: Path, command: str, **names: str) -> str:
    """Run a command of the page; what it printed."""
    for name, value in {USUAL: fresh.address, **names}.items():
        command = command.replace(name, value)
    token = fresh.token(Role.TECHNICIAN)["authorization"].removeprefix("Bearer ")
    # The generator tidies its files with a program beside it.
    path = f"{GENERATOR.parent}:{os.environ['PATH']}"
    done = subprocess.run(
        ["bash", "-c", command], cwd=folder, text=True, capture_output=True, check=False,
        env=os.environ | {"TOKEN": token, "PATH": path, "NO_PROXY": "*", "PYTHONPATH": str(folder / "velatura-client")},
    )  # fmt: skip
    assert done.returncode == 0, f"{command}\n{done.stdout}{done.stderr}"
    assert "WARNING parsing" not in done.stdout + done.stderr, "the generator left a part of the document out"
    return done.stdout


def commands(program: str) -> list[str]:
    return re.findall(rf"^    ({program} .*)$", PAGE, re.MULTILINE)


def test_the_pages_curl_commands_work_as_they_stand_there(fresh: Served, tmp_path: Path) -> None:
    (tmp_path / "target.png").write_bytes(jpeg())
    run = next(iter(fresh.kiosk.runs()))
    printed = [typed(fresh, tmp_path, line.replace("curl", "curl -sS --fail"), NAME=run) for line in commands("curl")]
    assert '"state":' in printed[0]
    assert (tmp_path / "report.html").read_text().startswith("<!doctype html>")
    assert re.search(r'"target":"[0-9a-f]{24}"', printed[2])
    assert len(printed) == 4


def test_a_generated_client_is_typed_and_shows_an_appearance(fresh: Served, tmp_path: Path) -> None:
    for file in FILES.iterdir():
        shutil.copy(file, tmp_path)
    fetch = commands("curl")[-1]
    (generate,) = commands("openapi-python-client")
    (show,) = commands("python")
    typed(fresh, tmp_path, f"{fetch} && {generate}")
    requests = list((tmp_path / "velatura-client" / "velatura_client" / "api").rglob("*.py"))
    assert len(requests) > len(OPERATIONS)
    assert not [file.name for file in requests if re.search(r"-> Any\b", file.read_text())]
    checked = typed(fresh, tmp_path, f"{sys.executable} -m mypy --strict show.py", USUAL=USUAL)
    assert "Success" in checked
    wrong = (tmp_path / "show.py").read_text().replace("now.stage} shows", "now.stages} shows")
    (tmp_path / "wrong.py").write_text(wrong)
    with pytest.raises(AssertionError, match='"KioskState" has no attribute "stages"'):
        typed(fresh, tmp_path, f"{sys.executable} -m mypy --strict wrong.py")
    show = show.replace("python", sys.executable, 1)
    name = fresh.kiosk.appearances()[-1].name
    assert f"shows {name}." in typed(fresh, tmp_path, show, NAME=f"'{name}'")
    with pytest.raises(UsageError) as refused:
        fresh.kiosk.play("nothing-of-that-name")
    told = typed(fresh, tmp_path, show, NAME="nothing-of-that-name")
    assert told.strip() == f"{refused.value.what} {refused.value.remedy}"
