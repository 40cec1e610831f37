"""Checks after each step of a kiosk its invariants against the lamps and the screen."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from controller.kiosk.decide.interfaces import Request
from controller.kiosk.decide.operator_overrides import LiveChanges
from controller.kiosk.service import Service
from controller.kiosk.store.event_log import SHOWN
from controller.run.state_machine import State
from lab.simulate.disk import STAGE
from lab.simulate.monitors.bundles import SHOWN_S, BundleMonitor
from lab.simulate.monitors.expectation import SETTLING_S, Calendar, OpeningExpectation
from lab.simulate.monitors.invariants import Durations, Violation
from lab.simulate.monitors.lamps import BACK_S, LampMonitor
from lab.simulate.monitors.log import LogMonitor
from lab.simulate.stage import OUTPUTS
from lab.simulate.world import SimulatedWorld

if TYPE_CHECKING:
    from controller.kiosk.api.kiosk import StageKiosk
    from controller.kiosk.service import Service

REPAIR_S: Final = 2000.0
"""After a fault: the longest retry out of the state fault, and the lamps' times."""
PLAYER_S: Final = 120.0
"""After trouble with the player: its longest pause before a start, and a start that fails."""
BLACK_S: Final = 30.0
DARK_S: Final = 240.0
HANGS_S: Final = 45.0
"""A start, two questions without an answer, and the pauses between them."""
OPENED_S: Final = 200.0
DECIDES_S: Final = 0.3
WORK_S: Final = 3600.0
CANCELLED_S: Final = 120.0
"""Of one step of work: an exposure, and three questions on lines that are silent."""
_RESTING: Final = (State.OFF, State.COOLING, State.FAULT)


class KioskMonitor:
    """Sees what the simulated kiosk cannot see, and checks it after each step.

    ``disturbed_until_s``: until when a fault, or what follows of it, excuses; ``paused_long``: whether the reconciler's
    pause that begins now is stretched.
    """

    def __init__(self, world: SimulatedWorld, calendar: Calendar) -> None:
        self._world, self.expectation = world, OpeningExpectation(calendar, lambda: world.truth_s)
        self.lamps = LampMonitor(world)
        self.bundles = BundleMonitor(world)
        self.log = LogMonitor(world)
        self.paused_long = False
        self.disturbed_until_s = SETTLING_S
        self.player_disturbed_until_s = self.bundle_bad_until_s = 0.0
        self.changed_s = 0.0
        self._was_open: bool | None = None
        self._began_s, self._stepped_s = 0.0, 0.0
        self._back_by_s: float | None = None
        self._durations = Durations(world)
        self.minutes = {"open": 0.0, "closed": 0.0, "dark": 0.0, "away": 0.0}
        self._judged_s = 0.0
        self._work: Request | None = None
        self._work_since_s = 0.0
        self._cancelled: tuple[Request | None, float] = (None, 0.0)

    # -- the service

    def begins(self) -> None:
        self._began_s = self._stepped_s = self._world.scheduler.now_s
        self.paused_long = True
        self._durations.restart("hangs")
        self.log.begins()
        self.bundles.begins()

    def player_fell(self) -> None:
        """The player died or hangs, and nothing else is wrong with it."""
        self._back_by_s = self._world.scheduler.now_s + BACK_S

    @property
    def player_well(self) -> bool:
        """Whether the player has long shown what it should, whatever is wrong with lamps."""
        since_s = max(self.player_disturbed_until_s, self._began_s + SETTLING_S, self.changed_s + SETTLING_S)
        well = self._world.scheduler.now_s > since_s and not self._world.disk.full and not self._world.disk.blind
        return well and self.expectation.sure and self.expectation.open() and bool(self._world.screen.appearance)

    def killed(self) -> None:
        """The service was, perhaps between an alert and the note that it was sent."""
        self.log.killed()
        self._durations.restart("camera")

    def disturb(self, duration_s: float, recovery_s: float = REPAIR_S) -> None:
        """A fault, so long, and what it takes to get over it."""
        self._back_by_s = None
        self.disturb_lamps(duration_s, recovery_s)

    def disturb_lamps(self, duration_s: float, recovery_s: float = REPAIR_S) -> None:
        """A fault of lamps or their lines: a player that dies meanwhile has no excuse."""
        self.lamps.stays_lit = {}
        self.disturbed_until_s = max(self.disturbed_until_s, self._world.scheduler.now_s + duration_s + recovery_s)

    def disturb_player(self, duration_s: float) -> None:
        """Trouble with the player, so long, and what it takes until it shows what it should."""
        self.bundles.disturbed()
        self.player_disturbed_until_s = max(
            self.player_disturbed_until_s, self._world.scheduler.now_s + duration_s + PLAYER_S
        )

    def disturb_picture(self, duration_s: float) -> None:
        """Something between player and projectors fails for so long: both excuses end when the player shows again."""
        again_s = SHOWN_S if self._world.scheduler.now_s + duration_s < self.bundle_bad_until_s else 0.0
        self.disturb(duration_s + again_s, PLAYER_S)
        self.disturb_player(duration_s + again_s)

    def next_edge_s(self) -> float:
        """When hours change next, in the world's time."""
        return self.expectation.edge_s() - self._world.begins_unix_s

    def lamps_that_stay(self) -> dict[str, float | None]:
        """Those that a restart now must leave lit, and since when they are."""
        if not (self.calm and self.expectation.open()):
            return {}
        return self.lamps.lit()

    # -- checks

    def check(self, kiosk: StageKiosk, service: Service) -> bool:
        """After a step of the reconciler. Whether something changed in it. Raises Violation."""
        world, now_s = self._world, self._world.scheduler.now_s
        scheduler = world.scheduler
        if world.camera.violations:
            raise Violation("one owner", world.camera.violations[0])
        if world.screen.violations:
            raise Violation(*world.screen.violations[0])
        if scheduler.crashes:
            name, error = scheduler.crashes[0]
            raise Violation("no crash", f"{name}: {type(error).__name__}: {error}")
        if now_s - self._stepped_s > DECIDES_S and not self.paused_long:
            raise Violation("decides always", f"it did not for {now_s - self._stepped_s:.1f} s")
        self._stepped_s = now_s
        self.expectation.ran(remembers=not world.disk.full and service.log.problem is None)
        news = self.log.check(service, self._check_may_begin)
        for row in news:
            self.lamps.off(row)
            if row.code == "task-due":
                self.light_needed()
        wanted = self.expectation.open()
        if wanted is not self._was_open:
            self._was_open, self.changed_s = wanted, now_s
            if wanted:
                self.lamps.forgive()
        state = service.reconciler.machine.state
        if self.log.state != state.value:
            raise Violation("state", f"it says {self.log.state}, but it is {state.value}")
        surely = wanted and self.expectation.sure
        self.lamps.check(service, serving_s=now_s - self._began_s, open_surely=surely)
        self._works(service)
        self.log.alerts()
        self._player(service)
        self._devices(service)
        self.bundles.check(kiosk, service)
        self._closed(service, state, wanted)
        self._opened(kiosk, service, state, wanted)
        elapsed_s, self._judged_s = now_s - self._judged_s, now_s
        self.minutes["open" if wanted else "closed"] += elapsed_s / 60
        return bool(news)

    def _check_may_begin(self) -> bool:
        open_s = self._world.scheduler.now_s - self.changed_s
        return not (self._was_open and self.expectation.open() and open_s > BLACK_S and self.expectation.sure)

    def light_needed(self) -> None:
        """Work is asked for that needs light, which an open stage has."""
        if not (self.expectation.open() and self.expectation.sure):
            self.lamps.needed()

    def work_cancelled(self, service: Service) -> None:
        """A person cancelled what runs."""
        self._cancelled = (service.jobs.running, self._world.scheduler.now_s)

    def _works(self, service: Service) -> None:
        now_s, running = self._world.scheduler.now_s, service.jobs.running
        cancelled, since_s = self._cancelled
        if running is not self._work:
            self._work, self._work_since_s = running, now_s
        elif running is not None and now_s - self._work_since_s > WORK_S:
            raise Violation("work ends", f"{running.kind} runs for {now_s - self._work_since_s:.0f} s")
        elif running is not None and running is cancelled and now_s - since_s > CANCELLED_S:
            raise Violation("work ends", f"{running.kind} runs for {now_s - since_s:.0f} s after it was cancelled")

    def _player(self, service: Service) -> None:
        """A picture that stands still is no sign of a player that lives."""
        screen = self._world.screen
        hangs = screen.hung and screen.process is not None and screen.process.alive
        if self._durations.held_s("hangs", hangs) > HANGS_S:
            raise Violation("picture back", f"the player hangs for {HANGS_S:.0f} s, and was not ended")
        self._outputs(service)

    def _outputs(self, service: Service) -> None:
        """What is said of the outputs while the player answers: exactly those that get no picture."""
        screen, problem = self._world.screen, service.player.view.problem
        text = "" if problem is None else problem.text
        report = {output for output in OUTPUTS.values() if output in text}
        wrong = sorted(report ^ screen.unplugged) if screen.serves else []
        if self._durations.held_s("outputs", bool(wrong)) > BLACK_S:
            raise Violation(
                "outputs named", f"{', '.join(wrong)} for {BLACK_S:.0f} s, and it says: {text or 'nothing'}"
            )

    def _devices(self, service: Service) -> None:
        world = self._world
        there_s = self._durations.held_s("camera", not world.camera.gone and service.devices.camera.device is None)
        if there_s > (OPENED_S if world.scheduler.stretch == 1 else REPAIR_S):
            raise Violation("devices back", f"the camera is there for {there_s:.0f} s")

    @property
    def calm(self) -> bool:
        """Whether no fault, and nothing that follows of one, excuses anything now."""
        now_s = self._world.scheduler.now_s
        return now_s > self.disturbed_until_s and self.expectation.sure

    def _closed(self, service: Service, state: State, wanted: bool) -> None:
        world, now_s = self._world, self._world.scheduler.now_s
        if wanted or not self.expectation.sure:
            self._durations.held_s("restless", False)
            return
        shut_s = now_s - max(self.changed_s, self._began_s)
        if shut_s > BLACK_S and service.reconciler.live != LiveChanges():
            raise Violation("as usual again", f"{service.reconciler.live}, {shut_s:.0f} s after it closed")
        reached = now_s > self.player_disturbed_until_s
        if shut_s > BLACK_S and reached and world.screen.appearance:
            raise Violation("black while closed", f"{world.screen.appearance} is shown, {shut_s:.0f} s after it closed")
        works = service.reconciler.working or now_s < self.light_until_s
        if works:
            self.changed_s = max(self.changed_s, now_s - BLACK_S - 1)
        restless = shut_s > BLACK_S and not works and state not in _RESTING
        # Work that is given up in a step leaves the stage as it is until the next.
        if self._durations.held_s("restless", restless) > 0:
            raise Violation("rests while closed", f"it is {state.value}, {shut_s:.0f} s after it closed")
        burning = [name for name, lamp in world.lamps.items() if lamp.lit]
        if shut_s > DARK_S and burning and not works and self.calm:
            raise Violation("dark while closed", f"the lamp of {burning[0]} burns, {shut_s:.0f} s after it closed")

    light_until_s = 0.0

    def _opened(self, kiosk: StageKiosk, service: Service, state: State, wanted: bool) -> None:
        world, now_s = self._world, self._world.scheduler.now_s
        live, shown = service.reconciler.live, world.screen.appearance
        asked_black = live.black or service.player.identifying or service.reconciler.working
        dark = {name for name, output in OUTPUTS.items() if output in world.screen.unplugged}
        bright = any(lamp.shines and name not in dark for name, lamp in world.lamps.items()) and bool(shown)
        dark_s = self._durations.held_s("black", wanted and not bright and not asked_black)
        if not wanted or not self.expectation.sure:
            self._back_by_s = None
            self._durations.held_s("unexplained", False)
            return
        self._back(shown, asked_black)
        open_s = now_s - max(self.changed_s, self._began_s)
        unexplained = dark_s > SETTLING_S and open_s > SETTLING_S and not self._explained(kiosk, service)
        if self._durations.held_s("unexplained", unexplained) > BLACK_S:
            raise Violation("says why it is dark", f"for {dark_s:.0f} s, while it is {state.value}")
        if not self.calm or open_s < SETTLING_S or asked_black:
            if asked_black:
                self.disturb(0.0, SETTLING_S)
            return
        if state is not State.PLAYING:
            raise Violation("plays while open", f"it is {state.value}: {service.reconciler.machine.reason}")
        unlit = [name for name, lamp in world.lamps.items() if not lamp.shines]
        if unlit:
            raise Violation("plays while open", f"the lamp of {unlit[0]} gives no light")
        if dark_s > BACK_S:
            raise Violation("plays while open", f"black for {dark_s:.0f} s")
        wants = service.player.want
        if wants is not None and world.screen.process is not None and dark_s == 0:
            names = {name for name, _, _ in wants.in_turn} | {wants.appearance}
            brightness = world.screen.process.brightness
            if shown not in names or abs(brightness - live.brightness) > 0.01:
                raise Violation("plays while open", f"{shown} at {brightness:g} is shown instead of {wants.appearance}")

    def _back(self, shown: str, asked_black: bool) -> None:
        if self._back_by_s is not None and self._world.scheduler.now_s > self._back_by_s and not asked_black:
            if not shown:
                raise Violation("picture back", f"it is still black {BACK_S:.0f} s after the player fell")
            self._back_by_s = None

    def _explained(self, kiosk: StageKiosk, service: Service) -> bool:
        snapshot, state = kiosk.snapshot(), service.reconciler.machine.state
        player = service.player.view.problem
        if state is State.DEGRADED and player is not None:
            # What was wrong first may be over: people would look for it in the wrong place.
            return player.what in snapshot.reason
        if state in (State.FAULT, State.DEGRADED) and snapshot.reason:
            return True
        if state is State.POWERING and self._world.scheduler.now_s - self.log.unlit_s < DARK_S:
            # Lamps that are struck again and again: the log says of each attempt that it gave no light.
            return True
        before = snapshot.reason.partition("Before: ")[2].rstrip(".")
        if state in (State.POWERING, State.WARMING) and before and before in self.log.fault:
            return True
        return (
            bool(snapshot.warnings)
            or any(row.problem for row in snapshot.devices)
            or any(row.code == "nothing-installed" for row in self.log.rows.values())
        )


def check_restart(monitor: KioskMonitor, service: Service, *, damaged: frozenset[str]) -> None:
    """Checks that a restarted service has what its predecessor logged. ``damaged``: files. Raises Violation."""
    rows = list(service.log.after(0))
    # What could not be written before the end is gone, and its numbers are given again.
    monitor.log.read = next(
        (row.number - 1 for row in reversed(rows) if row.code == "service-started"), monitor.log.read
    )
    monitor.log.numbers_again()
    there = {row.number: row for row in rows}
    # A full log forgets its oldest; one that is not full has all of them.
    least = min(there) if len(rows) >= SHOWN else 0
    for number, row in list(monitor.log.rows.items()):
        if number < least:
            del monitor.log.rows[number]
        elif there.get(number) != row:
            raise Violation("nothing lost", f"event {number} is gone from the log: {row.text}")
    if not (STAGE / "stage.toml").exists() and "stage.toml" not in damaged:
        raise Violation("nothing lost", "stage.toml is gone")
