"""What several workers use and one of them makes: a folder and a JSON value, made once in a test session.

A worker that comes while another one makes it waits. Where it could not be made, it fails at once for all.
"""

from __future__ import annotations

import fcntl
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest


def session_folder(factory: pytest.TempPathFactory) -> Path:
    """One for all workers of this test session. Without workers, it is the session's own."""
    own = factory.getbasetemp()
    return own.parent if own.name.startswith("popen-") else own


def made_once(factory: pytest.TempPathFactory, name: str, make: Callable[[Path], Any]) -> tuple[Path, Any]:
    """The folder ``name`` and what ``make`` returned when it filled that folder, which has to survive JSON.

    All workers see the same folder: copy what you change. Raises what ``make`` raises, or for the workers that come
    later AssertionError with its text.
    """
    folder = session_folder(factory) / "shared" / name
    folder.mkdir(parents=True, exist_ok=True)
    done, failed, content = folder / "done.json", folder / "failed.txt", folder / "content"
    with (folder / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        assert not failed.exists(), f"{name} could not be made: {failed.read_text()}"
        if not done.exists():
            content.mkdir()
            try:
                done.write_text(json.dumps(make(content)))
            except BaseException as error:
                failed.write_text(f"{error!r}")
                raise
    return content, json.loads(done.read_text())
