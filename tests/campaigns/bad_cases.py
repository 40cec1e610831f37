"""One case of the campaign ``bad_inputs``, and the ways in which a bad input is put in its place."""

from __future__ import annotations

import os
import socket
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

Prepare = Callable[[Path, Path], Sequence[str]]
"""From a sound stage's folder and an empty folder to the command's words; makes the bad input on the way."""
HUGE: Final = "9" * 400


@dataclass(frozen=True, slots=True)
class Case:
    """``refused``: whether the command must fail; else it may also cope."""

    name: str
    prepare: Prepare
    refused: bool = True


def edited(file: str, old: str, new: str, command: Sequence[str] = ("calibrate", "{stage}")) -> Prepare:
    def prepare(stage: Path, folder: Path) -> Sequence[str]:
        path = stage / file
        text = path.read_text()
        assert old in text, old
        path.write_text(text.replace(old, new, 1), encoding="utf-8")
        return filled(command, stage, folder)

    return prepare


def put(name: str, content: bytes, command: Sequence[str]) -> Prepare:
    """``content`` as the file ``name`` of the case's folder, or of the stage where the name begins with ``stage/``."""

    def prepare(stage: Path, folder: Path) -> Sequence[str]:
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
        return filled(command, stage, folder)

    return prepare


def odd(name: str, kind: str, command: Sequence[str]) -> Prepare:
    """In the place of the file ``name``, something that is no regular file."""

    def prepare(stage: Path, folder: Path) -> Sequence[str]:
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.unlink(missing_ok=True)
        if kind == "pipe":
            os.mkfifo(path)
        elif kind == "folder":
            path.mkdir()
        elif kind == "socket":
            here = Path.cwd()
            os.chdir(path.parent)  # the path of a socket must be short
            try:
                with socket.socket(socket.AF_UNIX) as bound:
                    bound.bind(path.name)
            finally:
                os.chdir(here)
        elif kind == "device":
            path.symlink_to("/dev/zero")
        elif kind == "loop":
            path.symlink_to(path.name)
        else:
            path.symlink_to("/nowhere/at/all")
        return filled(command, stage, folder)

    return prepare


def typed(words: Sequence[str]) -> Prepare:
    """Nothing but these words."""
    return lambda stage, folder: filled(words, stage, folder)


def filled(command: Sequence[str], stage: Path, folder: Path) -> list[str]:
    return [word.replace("{stage}", str(stage)).replace("{here}", str(folder)) for word in command]


ODD: Final = ("pipe", "folder", "socket", "device", "loop", "dangling")
