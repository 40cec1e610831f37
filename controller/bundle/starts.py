"""How often the player was started with the installed bundle without showing a picture; see ``fallback``.

It is kept in ``bundles/starts.json``. Where the disk takes nothing, because it is full or read-only, it is kept in the
stage's runtime folder, which is in memory: then it survives every end of the player, though not of the computer.
"""

from __future__ import annotations

import contextlib
import json
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, Final

from controller.core.errors import UsageError, VelaturaError
from controller.core.storage import runtime_path, write_atomically

NAME: Final = "starts.json"
_LARGEST_BYTES: Final = 4096


@dataclass(frozen=True, slots=True)
class Starts:
    """What is known of the starts with one bundle.

    ``bundle``: its file's name; ``failed``: starts in a row without a picture, the one that goes on now among them;
    ``given_up``: the file's name of a bundle that is not gone back to, because it failed itself.
    """

    bundle: str = ""
    failed: int = 0
    given_up: str | None = None

    @classmethod
    def read(cls, folder: Path) -> Starts:
        """The count of ``folder``; none where there is no file, or the file is not ours."""
        return Count(folder).read()

    def write(self, folder: Path) -> None:
        """Replace the count of ``folder``. Raises WorkError("cannot-write" or "no-space"), and OSError."""
        data, in_memory = json.dumps(asdict(self)).encode(), _in_memory(folder)
        try:
            write_atomically(folder / NAME, data)
        except (VelaturaError, OSError):
            if in_memory is None:
                raise
            write_atomically(in_memory, data)
        else:
            # Last: what is in memory counts, as long as it is there.
            if in_memory is not None:
                in_memory.unlink(missing_ok=True)


class Count:
    """The count of one folder of bundles, for those who read it again and again: where it is, is found out once."""

    def __init__(self, folder: Path) -> None:
        in_memory = _place_in_memory(folder)
        # As text, and without buffers: a kiosk reads it several times at each of its steps.
        self._files = [str(file) for file in (in_memory, folder / NAME) if file is not None]

    def read(self) -> Starts:
        """See ``Starts.read``."""
        for file in self._files:
            with contextlib.suppress(OSError), open(file, "rb", buffering=0) as stream:  # noqa: PTH123
                found = _parsed(stream.read(_LARGEST_BYTES))
                if found is not None:
                    return found
        return Starts()


@lru_cache(maxsize=16)
def _parsed(data: bytes) -> Starts | None:
    """None if it is not ours."""
    try:
        values: Any = json.loads(data)
        found = Starts(values["bundle"], values["failed"], values["given_up"])
    except (ValueError, TypeError, KeyError, RecursionError):
        return None
    sound = isinstance(found.bundle, str) and type(found.failed) is int and found.failed >= 0
    return found if sound and isinstance(found.given_up, str | None) else None


def forget(folder: Path) -> None:
    """Count anew: somebody installed a bundle, or went back to one. Raises OSError."""
    for file in (folder / NAME, _in_memory(folder)):
        if file is not None:
            file.unlink(missing_ok=True)


def _in_memory(folder: Path) -> Path | None:
    """The file in the runtime folder of the stage; None for bundles of which the player does not count the starts, and
    while nothing serves the stage.
    """
    place = _place_in_memory(folder)
    return place if place is not None and place.parent.is_dir() else None


def _place_in_memory(folder: Path) -> Path | None:
    """The same, whether something serves the stage or not."""
    if folder.name != "bundles":
        return None
    with contextlib.suppress(UsageError, OSError):
        return runtime_path(folder.parent) / NAME
    return None
