"""For how long a judge has found something in each of its steps."""

from __future__ import annotations

from lab.simulate.world import SimulatedWorld


class Found:
    """What was found in each step until now, and since when, in the world's time."""

    def __init__(self, world: SimulatedWorld) -> None:
        self._world = world
        self._since_s: dict[str, float] = {}

    def for_s(self, what: str, now: bool) -> float:
        """For how long each step has found this. The step before the first of them may be minutes older."""
        now_s = self._world.scheduler.now_s
        if not now:
            self.forget(what)
            return 0.0
        return now_s - self._since_s.setdefault(what, now_s)

    def forget(self, what: str) -> None:
        """Begin again with this."""
        self._since_s.pop(what, None)
