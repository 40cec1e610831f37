"""The bundles of a stage: the installed one, and the failover bundles without some of its projectors."""

from __future__ import annotations

import contextlib
import shutil
import threading
import time
from collections.abc import Callable, Collection, Sequence
from pathlib import Path
from typing import Final

from controller.bundle.format import Index
from controller.bundle.install import Count, chosen, current, previous
from controller.bundle.reader import Bundle
from controller.bundle.signing import Trust
from controller.core.errors import BundleError, UsageError, VelaturaError
from controller.core.storage import write_atomically
from controller.kiosk.values import Turn
from controller.play.control.protocol import MAX_FADE_S, MAX_SECONDS
from controller.stage.artefacts.names import safe_name
from hal.notices import Level, Notice

PREVIEWS: Final = "kiosk/thumbnails"
OUTPUTS: Final = "kiosk/outputs"
OUTPUT_PX: Final = 320
"""The longer side of a small picture of what an output shows."""
UNREAD_S: Final = 20.0
"""A bundle that could not be read is read again after this time: the disk may have failed for a moment."""
QUALITY: Final = 75
"""Of the small JPEGs: the first page shows many of them."""
WITHOUT: Final = "bundles-without"
"""Folder of the stage with a subfolder like ``bundles`` for each set of missing projectors."""


def slots_without(stage: Path, missing: Collection[str]) -> Path:
    """The install folder of bundles without these projectors."""
    # "+" in a name is doubled, so that no two sets share a folder.
    return stage / WITHOUT / safe_name(" + ".join(name.replace("+", "++") for name in sorted(missing)))


def _as_jpeg(png: bytes) -> bytes | None:
    """None if it is not a picture."""
    import cv2
    import numpy as np

    picture = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR) if png else None
    return None if picture is None else cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])[1].tobytes()


class BundleStore:
    """Reads the installed bundles, again only when their links change, or after a while. See ``interfaces.Bundles``."""

    def __init__(self, stage: Path, trust: Trust, monotonic: Callable[[], float] = time.monotonic) -> None:
        self._stage, self._trust, self._monotonic = stage, trust, monotonic
        self._count = Count(stage / "bundles")
        self._known: dict[Path, tuple[Index | None, float]] = {}
        self._previewing = threading.Lock()

    def bundle(self) -> Path | None:
        """The installed bundle's file, even if it can't be read: the player then goes back to the previous one."""
        return chosen(self._stage / "bundles", self._count)

    def installed(self) -> Sequence[Path]:
        """The files of the bundle that plays and of the previous one."""
        folder = self._stage / "bundles"
        return tuple(path for path in (current(folder), previous(folder)) if path is not None)

    def names(self) -> Sequence[str]:
        index = self.index(self.bundle())
        return () if index is None else tuple(entry.name for entry in index.appearances)

    def playlist(self) -> Sequence[Turn]:
        """See ``interfaces.Bundles``."""
        index = self.index(self.bundle())
        hints = () if index is None else index.schedule
        # A bundle may say more than the player takes.
        return tuple(
            (hint.appearance, min(hint.duration_ms / 1000, MAX_SECONDS), min(hint.fade_ms / 1000, MAX_FADE_S))
            for hint in hints
        )

    def given_up(self) -> str:
        """The file's name of the bundle that showed no picture, so that the previous one plays; empty if none."""
        starts, now = self._count.read(), self.bundle()
        fell_back = starts.given_up is not None and now is not None and starts.bundle == now.name != starts.given_up
        return str(starts.given_up) if fell_back else ""

    def check_name(self, name: str | None) -> None:
        """Raises UsageError("appearance-unknown") for a name that the installed bundle does not have."""
        if name is not None and name not in self.names():
            raise UsageError("appearance-unknown", what=f"The installed bundle has no appearance {name[:64]!r}.",
                             remedy=f"It has {', '.join(self.names()) or 'none'}.")  # fmt: skip

    def without(self, missing: Collection[str], appearance: str) -> Path | None:
        path, whole = current(slots_without(self._stage, missing)), self.index(self.bundle())
        index = self.index(path)
        if index is None or whole is None or index.calibration != whole.calibration:
            return None
        return path if appearance in [entry.name for entry in index.appearances] else None

    def previews(self) -> dict[str, Path]:
        """A small JPEG of the bundle's preview of each installed appearance that has one.

        They are extracted once per bundle; those of older bundles are deleted.
        """
        path = self.bundle()
        index = self.index(path)
        if path is None or index is None:
            return {}
        folder = self._stage / PREVIEWS / path.stem
        with self._previewing:
            if not folder.is_dir():
                self._preview(path, index, folder)
        files = {entry.name: folder / f"{number}.jpg" for number, entry in enumerate(index.appearances)}
        return {name: file for name, file in files.items() if file.exists()}

    def _preview(self, path: Path, index: Index, folder: Path) -> None:
        shutil.rmtree(folder.parent, ignore_errors=True)
        # All or none, because the folder is not checked again. On a full disk there are no previews.
        fresh = folder.with_name(f"{folder.name}.part")
        with contextlib.suppress(BundleError, VelaturaError, OSError), Bundle.open_trusted(path, self._trust) as bundle:
            fresh.mkdir(parents=True)
            for number, entry in enumerate(index.appearances):
                if (data := bundle.thumbnail(entry.name)) is not None and (small := _as_jpeg(data)) is not None:
                    write_atomically(fresh / f"{number}.jpg", small)
            fresh.rename(folder)

    def output_picture(self, appearance: str, output: str) -> Path | None:
        """A small JPEG of what an output shows of an installed appearance, made once; None if it has none."""
        path = self.bundle()
        index = self.index(path)
        if path is None or index is None:
            return None
        outputs, names = [one.name for one in index.outputs], [one.name for one in index.appearances]
        if output not in outputs or appearance not in names:
            return None
        file = self._stage / OUTPUTS / path.stem / f"{names.index(appearance)}-{outputs.index(output)}.jpg"
        with self._previewing:
            if not file.exists() and not self._draw_output(path, appearance, output, file):
                return None
        return file

    def _draw_output(self, path: Path, appearance: str, output: str, file: Path) -> bool:
        import cv2

        try:
            with Bundle.open_trusted(path, self._trust) as bundle:
                image = bundle.decode(appearance, output)
            scale = OUTPUT_PX / max(image.shape[:2])
            size_px = (max(1, round(image.shape[1] * scale)), max(1, round(image.shape[0] * scale)))
            small = cv2.resize(image[..., ::-1], size_px, interpolation=cv2.INTER_AREA)
            if not file.parent.is_dir():
                # Those of older bundles.
                shutil.rmtree(file.parent.parent, ignore_errors=True)
            write_atomically(file, cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])[1].tobytes())
        except (BundleError, VelaturaError, OSError):
            return False
        return True

    def index(self, path: Path | None) -> Index | None:
        """The index of an installed bundle; None without one, and for one that this stage would not play."""
        if path is None:
            return None
        # Another thread may clear the cache at any time.
        now_s = self._monotonic()
        with contextlib.suppress(KeyError):
            index, again_at_s = self._known[path]
            if index is not None or now_s < again_at_s:
                return index
        if len(self._known) > 64:
            self._known.clear()
        index = None
        with contextlib.suppress(BundleError, VelaturaError, OSError), Bundle.open_trusted(path, self._trust) as bundle:
            index = bundle.index
        self._known[path] = index, now_s + UNREAD_S
        return index


class BundleWatch:
    """``warning``: what people must know, or None. One thread calls ``step`` about once a second."""

    def __init__(self, bundles: BundleStore, tell: Callable[[Notice], object]) -> None:
        self._bundles, self._tell = bundles, tell
        self.warning: Notice | None = None

    def step(self) -> None:
        before, self.warning = self.warning, self._look()
        if self.warning is not None and self.warning != before:
            self._tell(self.warning)
        elif self.warning is None and before is not None:
            self._tell(Notice("bundle-newest", "The newest bundle plays again."))

    def _look(self) -> Notice | None:
        bundle = self._bundles.bundle()
        if bundle is not None and self._bundles.index(bundle) is None:
            return Notice("bundle-bad", "The installed bundle can't be read, so nothing of it is shown.",
                            "Compute and publish the appearances again.", Level.ERROR)  # fmt: skip
        if not self._bundles.given_up():
            return None
        index = self._bundles.index(bundle)
        made = "" if index is None else time.strftime(" of %Y-%m-%d %H:%M UTC", time.gmtime(index.created_unix_s))
        return Notice(
            "bundle-older-plays",
            f"The newest bundle showed no picture, so the previous one{made} plays.",
            "Compute and publish the appearances again.", Level.WARNING,
        )  # fmt: skip
