"""What is kept outside a stage: listed, and removed where no program uses it."""

from __future__ import annotations

import os
import shutil
import socket
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from hal.runtime.caches import RUNTIME, kept, remove, runtime_base, summary, temporary


@pytest.fixture
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Every place that the user's settings decide lies in the test's folder, and so does the shortest one."""
    for variable, name in {"VELATURA_CACHE": "cache", "XDG_STATE_HOME": "state"}.items():
        monkeypatch.setenv(variable, str(tmp_path / name))
    short = tempfile.mkdtemp()  # the path of a socket must be short, and pytest's folders are not
    monkeypatch.setenv("XDG_RUNTIME_DIR", short)
    (tmp_path / "tmp").mkdir()
    monkeypatch.setenv("TMPDIR", str(tmp_path / "tmp"))
    monkeypatch.setattr("tempfile.tempdir", None)
    monkeypatch.setattr("hal.runtime.caches.SHORTEST", tmp_path / "tmp")
    yield tmp_path
    shutil.rmtree(short)


def test_what_nobody_uses_is_listed_and_removed_and_the_rest_stays(elsewhere: Path) -> None:
    assert kept() == []
    (elsewhere / "cache" / "kernels").mkdir(parents=True)
    (elsewhere / "cache" / "kernels" / "k").write_bytes(bytes(1000))
    (elsewhere / "state" / "velatura").mkdir(parents=True)
    served, left = (runtime_base() / RUNTIME.format(uid=os.getuid()).replace("*", name) for name in ("a", "b"))
    for folder in (served, left):
        folder.mkdir(parents=True)
    with temporary() as held, socket.socket(socket.AF_UNIX) as server:
        server.bind(str(served / "s"))
        server.listen()
        found = {one.path: one.in_use for one in kept()}
        assert found[elsewhere / "cache"] is False
        assert found[held] is True
        assert sum(one.size_bytes for one in kept()) >= 1000
        assert any("compiled kernels" in line for line in summary(kept()))
        remove()
        assert held.is_dir()
        assert served.is_dir()
        assert not left.exists()
        assert not (elsewhere / "cache").exists()
        assert not (elsewhere / "state" / "velatura").exists()
    assert not held.exists()


def test_a_killed_process_leaves_what_is_then_removed(elsewhere: Path) -> None:
    code = "import os\nfrom hal.runtime.caches import temporary\nwith temporary():\n    os.kill(os.getpid(), 9)"
    subprocess.run([sys.executable, "-c", code], check=False, env=os.environ)
    (left,) = (elsewhere / "tmp").iterdir()
    assert [one.path for one in remove()] == [left]
    assert list((elsewhere / "tmp").iterdir()) == []


def test_a_user_without_a_home_folder_has_a_list_too(elsewhere: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for variable in ("VELATURA_CACHE", "XDG_STATE_HOME", "XDG_CACHE_HOME"):
        monkeypatch.delenv(variable, raising=False)

    def no_home(cls: type[Path]) -> Path:
        raise RuntimeError("no home")

    monkeypatch.setattr(Path, "home", classmethod(no_home))
    assert kept() == []


def test_the_module_is_a_program_that_needs_nothing_but_python(elsewhere: Path) -> None:
    (elsewhere / "cache").mkdir()
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[3])}
    for words, expected in ((["remove"], "Removed "), ([], "")):
        done = subprocess.run(
            [sys.executable, "-S", "-m", "hal.runtime.caches", *words],
            capture_output=True,
            text=True,
            env=environment,
            check=True,
        )
        assert done.stdout.startswith(expected)
    assert not (elsewhere / "cache").exists()
