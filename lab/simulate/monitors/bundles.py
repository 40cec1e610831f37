"""Checks the invariants of bundles: one that can be read is shown, and one that can't is named."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Final

from controller.bundle.install import Starts, chosen, previous
from controller.bundle.reader import Bundle
from controller.core.errors import VelaturaError
from lab.simulate.disk import STAGE
from lab.simulate.monitors.invariants import Durations, Violation
from lab.simulate.stage import OUTPUTS, TRUST
from lab.simulate.world import SimulatedWorld

if TYPE_CHECKING:
    from controller.kiosk.api.kiosk import StageKiosk
    from controller.kiosk.service import Service

NAMED_S: Final = 30.0
SHOWN_S: Final = 900.0
"""Until a player whose bundle is damaged goes back to the previous one: some starts fail, each after a longer wait."""
_FOLDER: Final = STAGE / "bundles"


class BundleMonitor:
    """``spoilt``: the names of the files that can't be read any more, and when each went bad; ``dark``: whether a
    picture is wanted and could be shown, and is not.
    """

    def __init__(self, world: SimulatedWorld) -> None:
        self._world = world
        self.spoilt: dict[str, float] = {}
        self.dark = False
        self._began_s = 0.0
        self._durations = Durations(world)

    def begins(self) -> None:
        """A service does."""
        self._began_s = self._world.scheduler.now_s
        self._durations.restart("dark")
        self._durations.restart("unnamed")

    def disturbed(self) -> None:
        """Something happened to the player or its display: it begins again."""
        self._durations.restart("dark")

    def check(self, kiosk: StageKiosk, service: Service) -> None:
        """After a step. Raises Violation."""
        unnamed = self._unnamed(kiosk, service) if self.spoilt else ""
        unnamed_s = self._durations.held_s("unnamed", bool(unnamed))
        if unnamed_s > NAMED_S:
            report = " ".join(kiosk.snapshot().warnings) or "nothing"
            raise Violation("bundle named", f"{unnamed} can't be read, for {unnamed_s:.0f} s it says: {report}")
        self.dark = self._is_dark(service)
        dark_s = self._durations.held_s("dark", self.dark)
        if dark_s > SHOWN_S:
            raise Violation("bundle shown", f"it is black for {dark_s:.0f} s")

    def _unnamed(self, kiosk: StageKiosk, service: Service) -> str:
        """The bundle that can't be read with which the service began, if it does not say so; else nothing."""
        bundle = service.bundles.bundle()
        if bundle is None or self.spoilt.get(bundle.name, self._began_s) >= self._began_s:
            return ""
        return "" if any("bundle" in text for text in kiosk.snapshot().warnings) else bundle.name

    def _is_dark(self, service: Service) -> bool:
        """Whether a picture is wanted and could be shown, and is not."""
        screen, want = self._world.screen, service.player.want
        if screen.appearance or want is None or want.bundle is None or service.player.identifying:
            return False
        crashes = screen.hung or screen.trouble or screen.dies_at_start or screen.dies_at_play
        shows = not screen.why_dark([(output, 0, 0) for output in OUTPUTS.values()])
        return shows and not crashes and not self._world.disk.blind and self._playable()

    def _playable(self) -> bool:
        """Whether the installed bundle can be read, or the previous one, which was not given up itself."""
        now, earlier = chosen(_FOLDER), previous(_FOLDER)
        if now is not None and now.name not in self.spoilt:
            return True
        given_up = Starts.read(_FOLDER).given_up
        return earlier is not None and earlier.name not in {given_up, *self.spoilt}


def is_sound(file: Path) -> bool:
    """Whether a bundle can be read."""
    try:
        Bundle.open_trusted(file, TRUST).close()
    except VelaturaError:
        return False
    return True
