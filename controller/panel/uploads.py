"""Uploaded pictures: decoded in a separate process; only the new encoding is served. Files stay for another fit."""

from __future__ import annotations

import json
import re
import secrets
import subprocess
import sys
import sysconfig
import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from controller.core.errors import UsageError
from controller.core.storage import write_atomically
from controller.core.text import printable
from controller.kiosk.operations.fields import TARGET_KEY
from controller.kiosk.store import targets
from controller.kiosk.values import Fit
from controller.panel import decoder

WHOLE, OUTLINE, NAME = ".whole", ".json", ".name"
"""Beside a target: it without an outline, the regions of it that are used, and a name for its appearance."""
UPLOADED = "uploaded"
"""The folder of the files that were uploaded, beside that of the targets."""

LONGEST_REASON = 300

Fitted = Callable[[Path, Fit, str], bytes]
"""Fits a PNG file to the camera's view."""


@dataclass(frozen=True, slots=True)
class UploadLimits:
    """``most_bytes`` of the uploaded file; pixels, memory and time for decoding it."""

    most_bytes: int = 64 << 20
    most_pixels: int = 40_000_000
    memory_bytes: int = 2 << 30  # 40 million pixels of 16 bits with transparency
    seconds: int = 20


def decode_picture(file: Path, limits: UploadLimits, least_px: tuple[int, int] | None = None) -> bytes:
    """The picture in ``file``, encoded again as PNG (sRGB, no metadata); ``least_px``: see ``decoder.decode``.

    Raises UsageError("picture-refused") unless it is a PNG, JPEG, TIFF or WebP that decodes within ``limits``, and
    UsageError("picture-too-large") for one with too many pixels.
    """
    command = [sys.executable, "-I", "-S", str(Path(decoder.__file__))]
    wide, high = least_px or (0, 0)
    command += [str(number) for number in (limits.most_pixels, limits.memory_bytes, limits.seconds, wide, high)]
    command += dict.fromkeys(sysconfig.get_path(kind) for kind in ("purelib", "platlib"))
    try:
        with file.open("rb") as data:
            done = subprocess.run(  # noqa: S603 - our own file, with numbers as arguments
                command,
                stdin=data,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                env={"OPENBLAS_NUM_THREADS": "1"},
                cwd="/",
                timeout=limits.seconds + 5,
                check=False,
            )
    except subprocess.TimeoutExpired:
        raise _refused() from None
    if done.returncode == decoder.TOO_MANY_PIXELS:
        raise UsageError(
            "picture-too-large",
            what=f"The picture has more than {limits.most_pixels / 1e6:.0f} million pixels.",
            remedy="Scale it down. The resolution of the camera is enough.",
        )
    if done.returncode != 0 or not done.stdout.startswith(b"\x89PNG"):
        told = done.stdout[:LONGEST_REASON] if done.returncode == decoder.NOT_A_PICTURE else b""
        raise _refused(printable(told.decode("utf-8", "replace")))
    return done.stdout


def _refused(reason: str = "") -> UsageError:
    return UsageError(
        "picture-refused",
        what=f"The file could not be read as a picture{f': {reason}' if reason else ''}.",
        remedy="Save it as PNG or JPEG, and upload it again.",
    )


class Targets:
    """Uploaded targets as PNG files in ``folder``; the newest ``most`` are kept."""

    def __init__(
        self,
        folder: Path,
        limits: UploadLimits,
        *,
        most: int = 20,
        fitted: Fitted = lambda file, fit, points: file.read_bytes(),
        view_px: Callable[[], tuple[int, int] | None] = lambda: None,
    ) -> None:
        self._folder, self._limits, self._most = folder, limits, most
        self._fitted, self._view_px = fitted, view_px
        # One upload at a time, so that the limits hold for all together.
        self._decoding = threading.Lock()

    @property
    def limits(self) -> UploadLimits:
        return self._limits

    def add(self, uploaded: Path, fit: Fit = "fit", points: str = "") -> str:
        """Decode ``uploaded``, fit it to the camera's view, and return the key of the target made from it.

        Raises as ``decode_picture``.
        """
        with self._decoding:
            # Only a picture that keeps its own pixels needs all of them.
            png = decode_picture(uploaded, self._limits, None if fit == "crop" else self._view_px())
            key = secrets.token_hex(12)
            file = self._folder / f"{key}.png"
            write_atomically(file, png, mode=0o600)
            write_atomically(file, self._fitted(file, fit, points), mode=0o600)
            write_atomically(self._uploaded(key), uploaded.read_bytes(), mode=0o600)
            kept = sorted(self._folder.glob("*.png"), key=lambda file: file.stat().st_mtime, reverse=True)
            for old in kept[self._most :]:
                beside = (old.with_suffix(ending) for ending in (WHOLE, OUTLINE, NAME))
                for part in (old, *beside, self._uploaded(old.stem)):
                    part.unlink(missing_ok=True)
        return key

    def fit_again(self, key: str, fit: Fit, points: str = "") -> str:
        """The key of a target made of the same upload with another fit. Raises UsageError("target-unknown").

        ``points`` are places in the target as it is.
        """
        whole = self.path(key)
        uploaded = whole if points else self._uploaded(key)
        if not uploaded.is_file():
            raise UsageError("target-unknown", what="This picture no longer exists.", remedy="Upload it again.")
        again = self.add(uploaded, fit, points)
        self.propose(again, self.proposed(key))
        return again

    def _uploaded(self, key: str) -> Path:
        return self._folder.with_name(UPLOADED) / key

    def propose(self, key: str, name: str) -> None:
        """Keep a name for the appearance that is made of this target."""
        write_atomically(self.path(key).with_suffix(NAME), name.encode(), mode=0o600)

    def proposed(self, key: str) -> str:
        """That name; empty if there is none."""
        try:
            return self.path(key).with_suffix(NAME).read_text("utf-8")
        except OSError:
            return ""

    def restrict(self, key: str, text: str) -> None:
        """Use only the regions of an outline (JSON) of this target; with none, all of it again.

        Raises UsageError("target-unknown", "outline-wrong").
        """
        file = self.path(key)
        regions = targets.regions_of(text)
        whole = file.with_suffix(WHOLE)
        with self._decoding:
            if not whole.exists():
                write_atomically(whole, file.read_bytes(), mode=0o600)
            write_atomically(file, targets.restricted(whole.read_bytes(), regions), mode=0o600)
            write_atomically(file.with_suffix(OUTLINE), json.dumps(regions).encode(), mode=0o600)

    def outline(self, key: str) -> str:
        """The regions in use as JSON. Raises UsageError("target-unknown")."""
        try:
            return json.dumps(targets.regions_of(self.path(key).with_suffix(OUTLINE).read_text()))
        except OSError:
            return "[]"

    def path(self, key: str) -> Path:
        """Raises UsageError("target-unknown")."""
        file = self._folder / f"{key}.png"
        if not re.fullmatch(TARGET_KEY, key) or not file.is_file():
            raise UsageError("target-unknown", what="This target no longer exists.", remedy="Upload it again.")
        return file
