"""Work in its order: what the schedule makes due, what people ask for, and what follows from other work."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Final

from controller.core.errors import WorkError
from controller.kiosk.decide.interfaces import Condition, Finished, ProjectorView, Request, Works
from controller.kiosk.decide.planner import Plan, Task
from controller.kiosk.store.event_log import Decision, EventLog


class Agenda:
    """One piece of work at a time; the rest waits. For the holder of the conductor's lock."""

    def __init__(self, works: Works, log: EventLog, *, monotonic: Callable[[], float], patience_s: float) -> None:
        self._works, self._log = works, log
        self._monotonic, self._patience_s = monotonic, patience_s
        self._waiting: tuple[Request | None, float] = (None, 0.0)
        self._queue: deque[Request] = deque()
        self._cancelled = False
        self._holder: int | None = None

    @property
    def head(self) -> Request | None:
        """What is being done, or is next."""
        return self._works.running or (self._queue[0] if self._queue else None)

    @property
    def needs_light(self) -> bool:
        """Whether work waits for, or uses, the lamps."""
        return self.head is not None and self.head.light

    def waits(self, number: int) -> bool:
        """Whether the job that was promised this number has not begun yet, and will."""
        return any(request.number == number for request in self._queue)

    def ask(self, *requests: Request) -> None:
        """Queue work. Raises WorkError("busy") while there is other work, and with the reason why it can't be done."""
        self.check_idle()
        if (why := self._works.refusal(requests[0])) is not None:
            self._log.tell(why)
            raise WorkError(why.code, what=why.reason, remedy=why.remedy)
        self._queue.extend(requests)

    def check_idle(self) -> None:
        """Raises WorkError("busy")."""
        if self.head is not None or self._holder not in (None, threading.get_ident()):
            raise WorkError("busy", what="Other work is going on.", remedy="Wait for it to end, or cancel it.")

    def hold(self) -> None:
        """Let no work begin, and be asked for by nobody but the caller's thread, until ``let_go``. Raises as above."""
        self.check_idle()
        self._holder = threading.get_ident()

    def let_go(self) -> None:
        self._holder = None

    def offer(self, request: Request) -> bool:
        """Queue work that nobody waits for, if there is no other; whether it was queued."""
        if self.head is not None or self._holder is not None or self._works.refusal(request) is not None:
            return False
        self._queue.append(request)
        return True

    def cancel(self) -> None:
        """Drop what waits, and ask what runs to end: nothing follows from it any more, should it end well."""
        if self._queue:
            self._settle("cancelled")
            self._log.tell(_CANCELLED)
        if self._works.running is not None:
            self._cancelled = True
            self._works.cancel()

    def take_finished(self) -> Finished | None:
        """The work that ended since the last call; what follows from it stands first in the queue now."""
        finished = self._works.finished()
        if finished is None:
            return None
        self._tell(finished.outcome)
        if self._cancelled and finished.then:
            finished = replace(finished, then=())
            self._log.tell(_CANCELLED)
        self._cancelled = False
        key = finished.request.key
        if key and not any(one.key == key for one in finished.then):
            self._log.mark_done(key, finished.outcome.code)
        self._queue.extendleft(reversed(finished.then))
        return finished

    def take_due(self, plan: Plan, *, playing: bool) -> None:
        """Queue what the schedule wants now, and write down what can't be done any more. Not while ``playing``."""
        for task in plan.expired:
            self._log.mark_done(task.key, "left out")
            self._log.tell(_left_out(task))
        for task in plan.due:
            request = Request("drift", light=True, key=task.key)
            if playing or self.head is not None or self._holder is not None:
                continue
            if (why := self._works.refusal(request)) is not None:
                self._log.mark_done(task.key, why.code)
                reason = f"The {task.what} ({task.key}) is left out: {why.reason}"
                self._log.tell(replace(why, reason=reason, level="warning"))
            else:
                self._log.tell(Decision("task-due", f"It is time for the {task.what} ({task.key})."))
                self._queue.append(request)

    def ready(self, views: Sequence[ProjectorView]) -> Request | None:
        """The work that can begin with these lamps; what can't for want of a lamp is dropped, with the reason."""
        if not self._queue or self._works.running is not None or self._holder is not None:
            return None
        request = self._queue[0]
        if not request.light:
            return request
        if self._waiting[0] is not request:
            self._waiting = (request, self._monotonic())
        late = self._monotonic() - self._waiting[1] > self._patience_s
        if not late and any(view.coming or view.condition is Condition.LIGHTING for view in views):
            return None
        dark = [view.name for view in views if view.condition is not Condition.LIT]
        if dark:
            self.drop(Decision(
                "work-needs-all-lamps", f"The work was given up: the lamp of {', '.join(dark)} is not lit.",
                "Mend that projector first; playback goes on without it.", "error",
            ))  # fmt: skip
            return None
        if all(view.stable_left_s <= 0 for view in views):
            return request
        if late:
            self.drop(_TOO_LATE)
        return None

    def begin(self) -> None:
        self._works.begin(self._queue.popleft())

    def drop(self, why: Decision) -> None:
        """Give up everything that waits."""
        if self._queue:
            self._settle(why.code)
            self._tell(why)

    def _tell(self, outcome: Decision) -> None:
        """What failed stays in sight until somebody has seen it."""
        (self._log.tell_failure if outcome.level == "error" else self._log.tell)(outcome)

    def _settle(self, how: str) -> None:
        for request in self._queue:
            if request.key:
                self._log.mark_done(request.key, how)
        self._queue.clear()


_CANCELLED: Final = Decision("work-cancelled", "Work that waited was cancelled.")
_TOO_LATE: Final = Decision(
    "lamps-not-steady", "The work was given up: the lamps were not lit and steady in time.",
    "See the projectors' own problems, or give them a longer power_up_s under [safety].", "error",
)  # fmt: skip


def _left_out(task: Task) -> Decision:
    return Decision(
        "task-left-out",
        f"The {task.what} ({task.key}) could not be done in its time.",
        "The events before say why: the stage was open, without power, or busy.",
        "warning",
    )
