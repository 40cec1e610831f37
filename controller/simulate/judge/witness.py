"""Checks after each step of a kiosk what it promises against what really is."""

from __future__ import annotations

from collections import Counter, deque
from typing import TYPE_CHECKING, Final

from controller.kiosk.decide.interfaces import Request
from controller.kiosk.decide.live_changes import LiveChanges
from controller.kiosk.interface import EventRow
from controller.kiosk.store.event_log import SHOWN
from controller.run.state_machine import State
from controller.simulate.judge.calendar import Calendar
from controller.simulate.judge.lamps import BACK_S, LampWitness
from controller.simulate.judge.promises import Broken
from controller.simulate.judge.wanted import SETTLING_S, Wanted
from controller.simulate.stage import OUTPUTS
from controller.simulate.world import SimulatedWorld

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
CHECK_BEGINS: Final = "Started: Drift check."
MOST_WORDS: Final = 240
MOST_AGAIN: Final = 20
"""Of the same words; the longest pause between two starts of the player is 30 s."""
WORDS_S: Final = 300.0
WORK_S: Final = 3600.0
_RESTING: Final = (State.OFF, State.COOLING, State.FAULT)


class Witness:
    """Sees what really is, and judges.

    ``disturbed_until_s``: until when a fault, or what follows of it, excuses; ``paused_long``: whether the reconciler's
    pause that begins now is stretched; ``here``: the folder of this life, which is left out of what is logged.
    """

    def __init__(self, world: SimulatedWorld, calendar: Calendar) -> None:
        self._world, self.wanted = world, Wanted(calendar, lambda: world.truth_s)
        self.lamps = LampWitness(world)
        self.paused_long = False
        self.disturbed_until_s = SETTLING_S
        self.player_disturbed_until_s = 0.0
        self.changed_s = 0.0
        self._was_open: bool | None = None
        self._began_s, self._stepped_s = 0.0, 0.0
        self.read = 0
        self.rows: dict[int, EventRow] = {}
        self._held: deque[EventRow] = deque(maxlen=SHOWN)
        self.digested: list[str] = []
        self.here = "\0"
        self._logged_state = self._logged_fault = ""
        self._black_since_s: float | None = None
        self._back_by_s: float | None = None
        self._missing_since_s: float | None = None
        self._found_since_s: dict[str, float] = {}
        self._alerted, self._alerted_number, self._kills = 0, 0, 0
        self.begun_checks: set[str] = set()
        self._due_check = ""
        self._recent: deque[tuple[float, str]] = deque()
        self._often: Counter[str] = Counter()
        self.minutes = {"open": 0.0, "closed": 0.0, "dark": 0.0, "away": 0.0}
        self._judged_s = 0.0
        self._work: Request | None = None
        self._work_since_s = 0.0

    # -- the service

    def begins(self) -> None:
        self._began_s = self._stepped_s = self._world.scheduler.now_s
        self.paused_long = True
        self._held.clear()
        self._found_since_s.pop("hangs", None)
        self._logged_state = State.OFF.value

    def player_fell(self) -> None:
        """The player died or hangs, and nothing else is wrong."""
        self._back_by_s = self._world.scheduler.now_s + BACK_S

    def killed(self) -> None:
        """The service was, perhaps between an alert and the note that it was sent."""
        # Sent before it was killed, and not yet looked at.
        self._alerted_number = max([self._alerted_number, *(row.number for row in self._world.alerted)])
        self._alerted = len(self._world.alerted)
        self._kills += 1
        self._missing_since_s = None

    def numbers_again(self) -> None:
        """What was logged from ``read`` on has numbers that others had, which were never written."""
        self._alerted_number = min(self._alerted_number, self.read)

    def disturb(self, for_s: float, after_s: float = REPAIR_S) -> None:
        """A fault, so long, and what it takes to get over it."""
        now_s = self._world.scheduler.now_s
        self._back_by_s, self.lamps.stays_lit = None, {}
        self.disturbed_until_s = max(self.disturbed_until_s, now_s + for_s + after_s)

    def disturb_player(self, for_s: float) -> None:
        """Trouble with the player, so long, and what it takes until it shows what it should."""
        self.player_disturbed_until_s = max(
            self.player_disturbed_until_s, self._world.scheduler.now_s + for_s + PLAYER_S
        )

    def disturb_picture(self, for_s: float) -> None:
        """Something between player and projectors fails for so long: both excuses end when the player shows again."""
        self.disturb(for_s, PLAYER_S)
        self.disturb_player(for_s)

    def next_edge_s(self) -> float:
        """When hours change next, in the world's time."""
        return self.wanted.edge_s() - self._world.begins_unix_s

    def lamps_that_stay(self) -> dict[str, float | None]:
        """Those that a restart now must leave lit, and since when they are."""
        if not (self.calm and self.wanted.open()):
            return {}
        return self.lamps.lit()

    # -- judging

    def judge(self, kiosk: StageKiosk, service: Service) -> bool:
        """After a step of the reconciler. Whether something changed in it. Raises Broken."""
        world, now_s = self._world, self._world.scheduler.now_s
        scheduler = world.scheduler
        if world.camera.sins:
            raise Broken("one owner", world.camera.sins[0])
        if world.screen.sins:
            raise Broken("bundle kept", world.screen.sins[0])
        if scheduler.crashes:
            name, error = scheduler.crashes[0]
            raise Broken("no crash", f"{name}: {type(error).__name__}: {error}")
        if now_s - self._stepped_s > DECIDES_S and not self.paused_long:
            raise Broken("decides always", f"it did not for {now_s - self._stepped_s:.1f} s")
        self._stepped_s = now_s
        news = self._listen(service)
        wanted = self.wanted.open()
        if wanted is not self._was_open:
            self._was_open, self.changed_s = wanted, now_s
            if wanted:
                self.lamps.forgive()
        state = service.reconciler.machine.state
        if self._logged_state != state.value:
            raise Broken("state", f"it says {self._logged_state}, but it is {state.value}")
        surely = wanted and self.wanted.sure
        self.lamps.judge(service, serving_s=now_s - self._began_s, open_surely=surely)
        self._works(service)
        self._alerts()
        self._player(service)
        self._devices(service)
        self._closed(service, state, wanted)
        self._opened(kiosk, service, state, wanted)
        elapsed_s, self._judged_s = now_s - self._judged_s, now_s
        self.minutes["open" if wanted else "closed"] += elapsed_s / 60
        return news

    def _listen(self, service: Service) -> bool:
        number, now_s = service.log.number, self._world.scheduler.now_s
        if service.log.problem is None:
            # What was logged while nothing could be written has been written now.
            self.rows.update((row.number, row) for row in self._held)
            self._held.clear()
        if number == self.read:
            return False
        for row in service.log.after(self.read):
            self.read = row.number
            text = row.text.replace(self.here, "")
            self.digested.append(f"{row.number} {row.unix_s!r} {row.level} {row.code} {text}")
            if service.log.problem is None:
                self.rows[row.number] = row
            else:
                self._held.append(row)
            self._said(row)
            if row.code == "crash":
                raise Broken("no crash", row.text)
            if row.level == "error" and row.code != "state" and row.text.count(".") < 2:
                raise Broken("remedy", f"{row.code}: {row.text}")
            if row.code == "state":
                self.lamps.off(row)
                if row.text.startswith("The stage is fault"):
                    self._logged_fault = row.text
                self._logged_state = row.text.removeprefix("The stage is ").partition(":")[0].partition(".")[0]
            elif row.code == "task-due":
                open_s = now_s - self.changed_s
                if self._was_open and self.wanted.open() and open_s > BLACK_S and self.wanted.sure:
                    raise Broken("at night", row.text)
                self._due_check = row.text.partition("(")[2].partition(")")[0]
            elif row.text == CHECK_BEGINS:
                self._check_begins(service)
        return True

    def _check_begins(self, service: Service) -> None:
        if self._due_check in self.begun_checks:
            raise Broken("once a night", f"{self._due_check} begins again")
        if service.log.problem is None:
            # What can't be written may be done again after a kill.
            self.begun_checks.add(self._due_check)

    def _said(self, row: EventRow) -> None:
        now_s, recent, often = self._world.scheduler.now_s, self._recent, self._often
        recent.append((now_s, row.text))
        often[row.text] += 1
        while now_s - recent[0][0] >= WORDS_S:
            often[recent.popleft()[1]] -= 1
        if len(recent) >= MOST_WORDS:
            raise Broken("few words", f"{MOST_WORDS} events in {now_s - recent[0][0]:.0f} s")
        if often[row.text] >= MOST_AGAIN:
            raise Broken("few words", f"{MOST_AGAIN} times in {WORDS_S:.0f} s: {row.text}")

    def _works(self, service: Service) -> None:
        now_s, running = self._world.scheduler.now_s, service.jobs.running
        if running is not self._work:
            self._work, self._work_since_s = running, now_s
        elif running is not None and now_s - self._work_since_s > WORK_S:
            raise Broken("work ends", f"{running.kind} runs for {now_s - self._work_since_s:.0f} s")

    def _alerts(self) -> None:
        world = self._world
        for row in world.alerted[self._alerted :]:
            if row.number <= self._alerted_number and not self._kills:
                raise Broken("alerts", f"event {row.number} was sent after {self._alerted_number}")
            if row.number > self._alerted_number:
                self._alerted_number, self._kills = row.number, 0
        self._alerted = len(world.alerted)

    def _player(self, service: Service) -> None:
        """A picture that stands still is no sign of a player that lives."""
        screen = self._world.screen
        hangs = screen.hung and screen.process is not None and screen.process.alive
        if self._found_s("hangs", hangs) > HANGS_S:
            raise Broken("picture back", f"the player hangs for {HANGS_S:.0f} s, and was not ended")
        self._outputs(service)

    def _outputs(self, service: Service) -> None:
        """What is said of the outputs while the player answers: exactly those that get no picture."""
        screen, problem = self._world.screen, service.player.view.problem
        text = "" if problem is None else problem.text
        said = {output for output in OUTPUTS.values() if output in text}
        wrong = sorted(said ^ screen.unplugged) if screen.serves else []
        if self._found_s("outputs", bool(wrong)) > BLACK_S:
            raise Broken("outputs named", f"{', '.join(wrong)} for {BLACK_S:.0f} s, and it says: {text or 'nothing'}")

    def _devices(self, service: Service) -> None:
        world, now_s = self._world, self._world.scheduler.now_s
        if world.camera.gone or service.devices.camera.device is not None:
            self._missing_since_s = None
        elif self._missing_since_s is None:
            self._missing_since_s = now_s
        elif now_s - self._missing_since_s > (OPENED_S if world.scheduler.stretch == 1 else REPAIR_S):
            raise Broken("devices back", f"the camera is there for {now_s - self._missing_since_s:.0f} s")

    @property
    def calm(self) -> bool:
        """Whether no fault, and nothing that follows of one, excuses anything now."""
        now_s = self._world.scheduler.now_s
        return now_s > self.disturbed_until_s and self.wanted.sure

    def _closed(self, service: Service, state: State, wanted: bool) -> None:
        world, now_s = self._world, self._world.scheduler.now_s
        if wanted or not self.wanted.sure:
            self._found_s("restless", False)
            return
        shut_s = now_s - max(self.changed_s, self._began_s)
        if shut_s > BLACK_S and service.reconciler.live != LiveChanges():
            raise Broken("as usual again", f"{service.reconciler.live}, {shut_s:.0f} s after it closed")
        reached = now_s > self.player_disturbed_until_s
        if shut_s > BLACK_S and reached and world.screen.appearance:
            raise Broken("black while closed", f"{world.screen.appearance} is shown, {shut_s:.0f} s after it closed")
        works = service.reconciler.working or now_s < self.light_until_s
        if works:
            self.changed_s = max(self.changed_s, now_s - BLACK_S - 1)
        restless = shut_s > BLACK_S and not works and state not in _RESTING
        # Work that is given up in a step leaves the stage as it is until the next.
        if self._found_s("restless", restless) > 0:
            raise Broken("rests while closed", f"it is {state.value}, {shut_s:.0f} s after it closed")
        burning = [name for name, lamp in world.lamps.items() if lamp.lit]
        if shut_s > DARK_S and burning and not works and self.calm:
            raise Broken("dark while closed", f"the lamp of {burning[0]} burns, {shut_s:.0f} s after it closed")

    light_until_s = 0.0

    def _opened(self, kiosk: StageKiosk, service: Service, state: State, wanted: bool) -> None:
        world, now_s = self._world, self._world.scheduler.now_s
        live, shown = service.reconciler.live, world.screen.appearance
        asked_black = live.black or service.player.identifying or service.reconciler.working
        dark = {name for name, output in OUTPUTS.items() if output in world.screen.unplugged}
        bright = any(lamp.shines and name not in dark for name, lamp in world.lamps.items()) and bool(shown)
        if not wanted or bright or asked_black:
            self._black_since_s = None
        elif self._black_since_s is None:
            self._black_since_s = now_s
        if not wanted or not self.wanted.sure:
            self._back_by_s = None
            self._found_s("unexplained", False)
            return
        self._back(shown, asked_black)
        open_s = now_s - max(self.changed_s, self._began_s)
        dark_s = 0.0 if self._black_since_s is None else now_s - self._black_since_s
        unexplained = dark_s > SETTLING_S and open_s > SETTLING_S and not self._explained(kiosk, service)
        if self._found_s("unexplained", unexplained) > BLACK_S:
            raise Broken("says why it is dark", f"for {dark_s:.0f} s, while it is {state.value}")
        if not self.calm or open_s < SETTLING_S or asked_black:
            if asked_black:
                self.disturb(0.0, SETTLING_S)
            return
        if state is not State.PLAYING:
            raise Broken("plays while open", f"it is {state.value}: {service.reconciler.machine.reason}")
        unlit = [name for name, lamp in world.lamps.items() if not lamp.shines]
        if unlit:
            raise Broken("plays while open", f"the lamp of {unlit[0]} gives no light")
        if dark_s > BACK_S:
            raise Broken("plays while open", f"black for {dark_s:.0f} s")
        wants = service.player.want
        if wants is not None and world.screen.process is not None and dark_s == 0:
            names = {name for name, _, _ in wants.in_turn} | {wants.appearance}
            brightness = world.screen.process.brightness
            if shown not in names or abs(brightness - live.brightness) > 0.01:
                raise Broken("plays while open", f"{shown} at {brightness:g} is shown instead of {wants.appearance}")

    def _found_s(self, what: str, now: bool) -> float:
        """For how long each step has found this. The step before the first of them may be minutes older."""
        now_s = self._world.scheduler.now_s
        if not now:
            self._found_since_s.pop(what, None)
            return 0.0
        return now_s - self._found_since_s.setdefault(what, now_s)

    def _back(self, shown: str, asked_black: bool) -> None:
        if self._back_by_s is not None and self._world.scheduler.now_s > self._back_by_s and not asked_black:
            if not shown:
                raise Broken("picture back", f"it is still black {BACK_S:.0f} s after the player fell")
            self._back_by_s = None

    def _explained(self, kiosk: StageKiosk, service: Service) -> bool:
        snapshot, state = kiosk.snapshot(), service.reconciler.machine.state
        player = service.player.view.problem
        if state is State.DEGRADED and player is not None:
            # What was wrong first may be over: people would look for it in the wrong place.
            return player.reason in snapshot.reason
        if state in (State.FAULT, State.DEGRADED) and snapshot.reason:
            return True
        before = snapshot.reason.partition("Before: ")[2].rstrip(".")
        if state in (State.POWERING, State.WARMING) and before and before in self._logged_fault:
            return True
        return (
            bool(snapshot.warnings)
            or any(row.problem for row in snapshot.devices)
            or any(row.code == "nothing-installed" for row in self.rows.values())
        )
