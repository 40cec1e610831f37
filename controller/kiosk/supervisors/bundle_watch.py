"""Says as long as it is so that the newest bundle does not play, because it showed no picture."""

from __future__ import annotations

import time
from collections.abc import Callable

from controller.kiosk.store.bundle_store import BundleStore
from controller.kiosk.store.event_log import Decision


class BundleWatch:
    """``warning``: what people must know, or None. One thread calls ``step`` about once a second."""

    def __init__(self, bundles: BundleStore, tell: Callable[[Decision], object]) -> None:
        self._bundles, self._tell = bundles, tell
        self.warning: Decision | None = None

    def step(self) -> None:
        before, self.warning = self.warning, self._look()
        if self.warning is not None and self.warning != before:
            self._tell(self.warning)
        elif self.warning is None and before is not None:
            self._tell(Decision("bundle-newest", "The newest bundle plays again."))

    def _look(self) -> Decision | None:
        bundle = self._bundles.bundle()
        if bundle is not None and self._bundles.index(bundle) is None:
            return Decision("bundle-bad", "The installed bundle can't be read, so nothing of it is shown.",
                            "Compute and publish the appearances again.", "error")  # fmt: skip
        if not self._bundles.given_up():
            return None
        index = self._bundles.index(bundle)
        made = "" if index is None else time.strftime(" of %Y-%m-%d %H:%M UTC", time.gmtime(index.created_unix_s))
        return Decision(
            "bundle-older-plays",
            f"The newest bundle showed no picture, so the previous one{made} plays.",
            "Compute and publish the appearances again.", "warning",
        )  # fmt: skip
