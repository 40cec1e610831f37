"""The computer as the installation changes it: every program that it runs and every file that it writes."""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Callable, Mapping
from pathlib import Path

from controller.core.errors import WorkError
from controller.core.storage import sync_folder, write_atomically


class System:
    """``dry``: nothing is changed; ``tell`` hears what would be. ``root``: below it lie all the paths (for tests)."""

    def __init__(self, tell: Callable[[str], None], *, dry: bool = False, root: Path = Path("/")) -> None:
        self.dry, self._tell, self._root = dry, tell, root

    def at(self, path: Path) -> Path:
        """Where ``path``, which begins with /, lies."""
        return self._root / path.relative_to("/")

    def read(self, path: Path) -> str | None:
        """A file's text; None where there is none."""
        try:
            return self.at(path).read_text()
        except FileNotFoundError:
            return None

    def write(self, path: Path, text: str, *, mode: int = 0o644, owner: str = "root:root") -> bool:
        """Whether the file had to be changed."""
        if self.read(path) == text:
            return False
        self._tell(f"write {path}")
        if not self.dry:
            new = self.at(path).with_name(f".{path.name}.new")
            write_atomically(new, text.encode(), mode=mode)
            self._own(new, owner)
            new.replace(self.at(path))
            sync_folder(new.parent)
        return True

    def folder(self, path: Path, *, mode: int = 0o755, owner: str = "root:root") -> None:
        if not self.at(path).is_dir():
            self._tell(f"make folder {path}")
            if not self.dry:
                new = self.at(path).with_name(f".{path.name}.new")
                new.mkdir(parents=True, exist_ok=True)
                new.chmod(mode)
                self._own(new, owner)
                new.rename(self.at(path))

    def remove(self, path: Path) -> None:
        """A file, or a folder with everything in it."""
        place = self.at(path)
        if place.is_dir():
            self._tell(f"remove folder {path}")
            if not self.dry:
                shutil.rmtree(place)
        elif os.path.lexists(place):
            self._tell(f"remove {path}")
            if not self.dry:
                place.unlink()

    def look(self, *words: str, more: Mapping[str, str] | None = None) -> str | None:
        """What a program prints that changes nothing; None where it fails, or is not there."""
        try:
            done = subprocess.run(  # noqa: S603 - words of ours
                words, capture_output=True, text=True, errors="replace", check=False, timeout=60,
                env={**os.environ, **(more or {})},
            )  # fmt: skip
        except (FileNotFoundError, subprocess.TimeoutExpired):
            return None
        return done.stdout if done.returncode == 0 else None

    def run(self, *words: str, may_fail: bool = False) -> None:
        """Run a program that changes something. Raises WorkError("kiosk-step-failed") with what it said."""
        self._tell(" ".join(words))
        if self.dry:
            return
        try:
            done = subprocess.run(  # noqa: S603 - words of ours
                words, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, errors="replace", check=False,
                env={**os.environ, "DEBIAN_FRONTEND": "noninteractive"},
            )  # fmt: skip
            code, said = done.returncode, done.stdout
        except FileNotFoundError:
            code, said = 127, "there is no such program"
        if code and not may_fail:
            raise WorkError(
                "kiosk-step-failed",
                what=f"`{' '.join(words)}` failed: {' '.join(said.split())[-400:] or f'exit code {code}'}",
                remedy="Correct the cause, and type the same command again: it continues from there.",
            )

    def _own(self, place: Path, owner: str) -> None:
        user, _, group = owner.partition(":")
        # Below another root there are no such users.
        if self._root == Path("/"):
            shutil.chown(place, user, group)
