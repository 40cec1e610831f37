from __future__ import annotations

import errno
import hashlib
import os
import subprocess
import sys
from pathlib import Path
from typing import BinaryIO

import pytest

from controller.core.errors import UsageError, WorkError
from controller.core.storage import exclusive, runtime_folder, sha256_of, stream_atomically, write_atomically


def test_a_file_is_replaced_as_a_whole_with_its_mode(tmp_path: Path) -> None:
    path = tmp_path / "new" / "folder" / "file"
    write_atomically(path, b"old", mode=0o600)
    write_atomically(path, b"new", mode=0o640)
    assert path.read_bytes() == b"new"
    assert path.stat().st_mode & 0o777 == 0o640
    assert list(path.parent.iterdir()) == [path]


@pytest.mark.parametrize(("number", "code"), [(errno.ENOSPC, "no-space"), (errno.EIO, "cannot-write")])
def test_a_write_that_fails_leaves_the_old_file_and_nothing_else(tmp_path: Path, number: int, code: str) -> None:
    path = tmp_path / "file"
    write_atomically(path, b"old")

    def fails(file: BinaryIO) -> None:
        file.write(b"half")
        raise OSError(number, os.strerror(number))

    with pytest.raises(WorkError) as error:
        stream_atomically(path, fails)
    assert error.value.code == code
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


def test_a_full_disk_is_told_in_a_sentence_with_a_remedy(tmp_path: Path) -> None:
    def write(file: BinaryIO) -> None:
        with Path("/dev/full").open("wb") as full:  # the kernel itself says that there is no space
            full.write(b"x" * 100_000)

    with pytest.raises(WorkError, match="disk has no space for file") as error:
        stream_atomically(tmp_path / "file", write)
    assert "Free space on the disk" in error.value.remedy
    assert list(tmp_path.iterdir()) == []


def test_the_order_is_write_sync_rename_sync_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    order: list[str] = []
    fsync, replace = os.fsync, Path.replace

    def noted_fsync(handle: int) -> None:
        order.append("folder" if Path(f"/proc/self/fd/{handle}").is_dir() else "file")
        fsync(handle)

    def noted_replace(self: Path, target: Path) -> Path:
        order.append("rename")
        return replace(self, target)

    monkeypatch.setattr(os, "fsync", noted_fsync)
    monkeypatch.setattr(Path, "replace", noted_replace)
    write_atomically(tmp_path / "file", b"data")
    assert order == ["file", "rename", "folder"]


def test_the_hash_is_that_of_the_bytes(tmp_path: Path) -> None:
    data = os.urandom(300_000)
    write_atomically(tmp_path / "file", data)
    assert sha256_of(tmp_path / "file") == hashlib.sha256(data).hexdigest()


HOLDER = """
import sys
from pathlib import Path
from controller.core.storage import exclusive
with exclusive(Path(sys.argv[1]), what_is_running="Calibration"):
    print("held", flush=True)
    sys.stdin.read()
"""


def test_a_lock_is_held_by_one_process_and_dies_with_it(tmp_path: Path) -> None:
    lock = tmp_path / "lock"
    with subprocess.Popen(
        [sys.executable, "-c", HOLDER, lock], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as holder:
        assert holder.stdout is not None
        assert holder.stdout.readline() == b"held\n"
        second = exclusive(lock, what_is_running="Calibration")
        with pytest.raises(UsageError, match="Calibration is already running"):
            second.__enter__()
        holder.kill()
        holder.wait()
        with exclusive(lock, what_is_running="Calibration"):
            assert lock.exists()


@pytest.mark.parametrize("there", [True, False])
def test_on_a_read_only_disk_a_lock_is_held_by_one_process_also_without_its_file(tmp_path: Path, there: bool) -> None:
    lock = tmp_path / "lock"
    lock.touch() if there else None
    own = [] if os.geteuid() == 0 else ["--map-root-user"]
    mounts = 'mount --bind "$1" "$1" && mount -o remount,bind,ro "$1" && exec "$0" -c "$2" "$3"'
    command = ["unshare", *own, "--mount", "sh", "-c", mounts, sys.executable, str(tmp_path), HOLDER, str(lock)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as holder:
        assert holder.stdout is not None
        assert holder.stdout.readline() == b"held\n"
        second = subprocess.run(command, capture_output=True, text=True, check=False)
        assert "Calibration is already running" in second.stderr
        holder.kill()
    assert lock.exists() is there


def test_the_runtime_folder_is_short_private_and_the_same_each_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    folder = runtime_folder(Path("stage"))
    assert folder == runtime_folder(Path("stage").resolve())
    assert folder != runtime_folder(Path("other"))
    assert folder.stat().st_mode & 0o777 == 0o700
    assert len(folder.name) < 40


@pytest.mark.parametrize("spoil", ["open to others", "a link"])
def test_a_runtime_folder_that_others_could_use_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, spoil: str
) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    folder = runtime_folder(Path("stage"))
    if spoil == "a link":
        folder.rename(tmp_path / "elsewhere")
        folder.symlink_to(tmp_path / "elsewhere")
    else:
        folder.chmod(0o755)
    with pytest.raises(UsageError) as error:
        runtime_folder(Path("stage"))
    assert error.value.code == "runtime-folder-unsafe"
