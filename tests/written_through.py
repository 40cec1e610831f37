"""What a program has not yet written through to the disk, as strace sees it: independent of the program's own words."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import pytest

BEGIN, END = "begin ", "end "
SEEN: Final = (
    "fsync,fdatasync,write,pwrite64,writev,ftruncate,sendfile,copy_file_range,openat,mkdir,mkdirat,"
    "rename,renameat,renameat2,symlink,symlinkat,link,linkat,unlink,unlinkat,rmdir"
)
CALL: Final = re.compile(r"^\d+ +(\w+)\((.*)$")
DESCRIPTOR: Final = re.compile(r"\d+<([^<>]*)>")
NAME: Final = re.compile(r'(?:(?:AT_FDCWD|\d+)<([^<>]*)>, )?"([^"]*)"')
REMADE: Final = re.compile(r"lock$|-shm$")
needs_strace = pytest.mark.skipif(shutil.which("strace") is None, reason="needs strace (a package of the test set-up)")


def left_over(module: str, arguments: Sequence[str], root: Path, folder: Path) -> dict[str, list[str]]:
    """Run a module that writes ``begin NAME`` and ``end NAME`` to its output around each piece of work.

    Returns for each piece what a power cut could take back below ``folder``: at its end, bytes of a file, or its name
    in its folder, that are not synced; and before, what went into or out of a folder whose new place was not. What is
    removed may come back; locks and SQLite's shared memory are made again.
    """
    trace = folder / "trace"
    command = ["strace", "-f", "--seccomp-bpf", "-y", "-s", "4096", "-e", f"trace={SEEN}", "-o", str(trace)]
    done = subprocess.run(
        [*command, sys.executable, "-m", module, *arguments], cwd=root, capture_output=True, text=True, check=False
    )
    if "PTRACE" in done.stderr or "ptrace" in done.stderr:
        pytest.skip("this computer does not let strace watch")
    assert done.returncode == 0, done.stderr
    found: dict[str, list[str]] = {}
    unsynced, names, early = set[Path](), set[Path](), set[Path]()
    begun: dict[str, str] = {}
    moved = set[Path]()
    for line in trace.read_text(errors="replace").splitlines():
        thread = line.split(maxsplit=1)[0]
        if line.endswith(" <unfinished ...>"):
            begun[thread] = line.removesuffix(" <unfinished ...>")
            continue
        whole = begun.pop(thread, "") + line if " resumed>" in line else line
        match = CALL.match(whole)
        if match is None or " = -1 " in whole:
            continue
        call, rest = match.groups()
        if call == "write" and (mark := re.search(rf'"({BEGIN}|{END})(.*?)\\n"', rest)):
            if mark[1] == END:
                left = {one for one in unsynced | names | early if one.is_relative_to(folder)}
                found[mark[2]] = sorted(str(one.relative_to(folder)) for one in left if not REMADE.search(one.name))
            unsynced, names, early = set(), set(), set()
            moved.clear()
        else:
            if call.startswith("rename"):
                source, target = _named(rest)
                for place in moved & names - {source}:
                    early |= {one for one in (source, target) if one.is_relative_to(place)}
                moved.add(target)
            _note(unsynced, names, call, rest)
    return found


def _named(rest: str) -> list[Path]:
    return [Path(base or "/", name) for base, name in NAME.findall(rest)]


def _note(unsynced: set[Path], names: set[Path], call: str, rest: str) -> None:
    """One call: ``unsynced`` files whose bytes, and ``names`` which, a power cut could take back."""
    named = _named(rest)
    opened = [Path(name) for name in DESCRIPTOR.findall(rest)]
    if call in ("fsync", "fdatasync"):
        unsynced -= set(opened[:1])
        names -= {name for name in names if name.parent in opened[:1]}
    elif call in ("write", "pwrite64", "writev", "ftruncate", "sendfile"):
        unsynced |= set(opened[:1])
    elif call == "copy_file_range":
        unsynced |= set(opened[1:2])
    elif (call == "openat" and "O_CREAT" in rest) or call.startswith(("mkdir", "symlink", "link")):
        names |= set(named[-1:])
    elif call.startswith("rename"):
        source, target = named
        for paths in (unsynced, names):
            for path in [one for one in paths if one.is_relative_to(source)]:
                paths.remove(path)
                paths.add(target / path.relative_to(source))
        names.add(target)
    elif call.startswith(("unlink", "rmdir")):
        for paths in (unsynced, names):
            paths -= {path for path in paths if path.is_relative_to(named[-1])}
