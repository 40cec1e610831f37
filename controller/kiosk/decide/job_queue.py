"""The queue of jobs: those that are due by the schedule, those that people request, and follow-up jobs."""

from __future__ import annotations

import contextlib
import json
import threading
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import Final

from controller.core.errors import WorkError
from controller.kiosk.decide.interfaces import (
    BACKGROUND,
    NOT_YET,
    Condition,
    Finished,
    Jobs,
    ProjectorView,
    Request,
    title_of,
)
from controller.kiosk.decide.planner import Plan, Task
from controller.kiosk.store.event_log import EventLog
from hal.notices import Level, Notice

_NAME: Final = "work"
_AGAIN: Final = "takeover"
"""It is asked for again as long as it is needed."""


def keep_work(log: EventLog, requests: Iterable[Request], again: frozenset[Request]) -> None:
    """Keep these requests, but those that are asked for again as long as they are needed.

    ``again``: those that were begun a second time.
    """
    rows = [[one.kind, one.light, list(one.arguments), one in again] for one in requests if _is_kept(one)]
    log.keep(_NAME, json.dumps(rows))


def unfinished_work(log: EventLog) -> list[tuple[Request, bool]]:
    """What the previous service left undone, in its order, and whether that was the second attempt.

    Nothing where what is kept can't be read: it must not keep a kiosk from starting.
    """
    with contextlib.suppress(ValueError, TypeError):
        rows = json.loads(log.value(_NAME) or "[]")
        return [
            (Request(str(kind), bool(light), arguments=tuple(map(str, arguments))), bool(again))
            for kind, light, arguments, again in rows
        ]
    return []


def _is_kept(request: Request) -> bool:
    return request.kind != _AGAIN


class JobQueue:
    """One job runs, the others wait. Call it only with the reconciler's lock held."""

    def __init__(self, jobs: Jobs, log: EventLog, *, monotonic: Callable[[], float], patience_s: float) -> None:
        self._jobs, self._log = jobs, log
        self._monotonic, self._patience_s = monotonic, patience_s
        self._waiting: tuple[Request | None, float] = (None, 0.0)
        self._queue: deque[Request] = deque()
        self._cancelled = self._makes_way = False
        self._holder: int | None = None
        self._again: frozenset[Request] = frozenset()

    def go_on(self) -> Sequence[tuple[Request, bool]]:
        """What the previous service left undone, and whether it is done again: once, and not what needs the lamps."""
        left = [
            (request, not (request.light or second) and self._possible(request))
            for request, second in unfinished_work(self._log)
        ]
        requests = [request for request, again in left if again]
        self._again = frozenset(requests)
        self._queue.extend(requests)
        self._keep()
        return left

    @property
    def head(self) -> Request | None:
        """The job that runs, or is next."""
        return self._jobs.running or (self._queue[0] if self._queue else None)

    @property
    def running(self) -> bool:
        return self._jobs.running is not None

    @property
    def needs_light(self) -> bool:
        """Whether the running or next job needs the lamps."""
        return self.head is not None and self.head.light

    def waits(self, number: int) -> bool:
        """Whether the job of this number waits to start."""
        return any(request.number == number for request in self._queue)

    def submit(self, *requests: Request) -> None:
        """Queue jobs; background jobs make way. Raises WorkError("busy") while another job runs or waits, or with the
        reason of a refusal.
        """
        self._check_idle()
        if (why := self._jobs.refusal(requests[0])) is not None:
            self._log.add(why)
            raise WorkError(why.code, what=why.what, remedy=why.remedy)
        self._make_way()
        self._queue.extendleft(reversed(requests))
        self._keep()

    def _check_idle(self) -> None:
        """Raises WorkError("busy") naming the job of people that runs or waits."""
        running = self._jobs.running
        head = next((one for one in (running, *self._queue) if one is not None and one.kind not in BACKGROUND), None)
        if head is not None:
            what = f"{title_of(head)} {'is running' if head is running else 'waits for its start'}."
            raise WorkError("busy", what=what, remedy="Wait until it ends, or cancel it.")
        if self._holder not in (None, threading.get_ident()):
            raise WorkError("busy", what="Somebody else is changing this stage.", remedy="Try again in a moment.")

    def _make_way(self) -> None:
        """End the background job that runs, and do it again after what people ask."""
        if (running := self._jobs.running) is not None and not self._makes_way:
            self._makes_way = True
            self._jobs.cancel()
            self._queue.append(running)
            self._log.add(Notice("work-waits", f"{title_of(running)} waits, and is done later."))

    def hold(self) -> None:
        """Start no job, and accept jobs only from the caller's thread, until ``release``; a background job that runs
        makes way. Raises as above.
        """
        self._check_idle()
        self._make_way()
        self._holder = threading.get_ident()

    def release(self) -> None:
        self._holder = None

    def offer(self, request: Request) -> bool:
        """Queue a background job if there is no other; returns whether it was queued."""
        if self.head is not None or self._holder is not None or self._jobs.refusal(request) is not None:
            return False
        self._queue.append(request)
        return True

    def cancel(self) -> None:
        """Drop the waiting jobs and cancel the running one, with its follow-up jobs."""
        if self._queue:
            self._settle("cancelled")
            self._log.add(_CANCELLED)
        if self._jobs.running is not None:
            self._cancelled = True
            self._jobs.cancel()
        self._keep()

    def take_finished(self) -> Finished | None:
        """The job that ended since the last call; its follow-up jobs are now first in the queue."""
        finished = self._jobs.finished()
        if finished is None:
            return None
        if not (self._makes_way and finished.failed):
            self._tell(finished.outcome)
        self._makes_way = False
        if self._cancelled and finished.then:
            finished = replace(finished, then=())
            self._log.add(_CANCELLED)
        self._cancelled = False
        self._queue = deque(one for one in self._queue if one not in finished.then)
        self._queue.extendleft(reversed(finished.then))
        self._keep()
        return finished

    def take_due(self, plan: Plan, *, playing: bool) -> None:
        """Queue the tasks that are due, except while ``playing``, and record the expired ones."""
        for task in plan.expired:
            self._log.mark_done(task.key, "left out")
            self._log.add(_expired(task))
        for task in plan.due:
            request = Request("drift", light=True, key=task.key)
            if playing or self.head is not None or self._holder is not None:
                continue
            if (why := self._jobs.refusal(request)) is not None:
                if why.code == NOT_YET:
                    continue
                self._log.mark_done(task.key, why.code)
                reason = f"The {task.what} ({task.key}) is skipped. {why.what}"
                self._log.add(replace(why, what=reason, level=Level.WARNING))
            else:
                self._log.add(Notice("task-due", f"The {task.what} ({task.key}) is due."))
                self._queue.append(request)

    def ready(self, views: Sequence[ProjectorView]) -> Request | None:
        """The job that can start with these lamps; one whose lamps do not light in time is dropped with the reason."""
        if not self._queue or self._jobs.running is not None or self._holder is not None:
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
            self.drop(Notice(
                "work-needs-all-lamps", f"The job was cancelled because the lamp of {', '.join(dark)} is not lit.",
                "Repair that projector first. Playback continues without it.", Level.ERROR,
            ))  # fmt: skip
            return None
        if all(view.stable_left_s <= 0 for view in views):
            return request
        if late:
            self.drop(_TOO_LATE)
        return None

    def begin(self) -> None:
        request = self._queue.popleft()
        if request.key:
            # Before it begins: one that ends the whole computer would be begun again and again all night.
            self._log.mark_done(request.key, "begun")
        self._jobs.begin(request)
        self._keep()

    def drop(self, why: Notice) -> None:
        """Drop all waiting jobs."""
        if self._queue:
            self._settle(why.code)
            self._tell(why)
            self._keep()

    def _possible(self, request: Request) -> bool:
        try:
            return self._jobs.refusal(request) is None
        except KeyError:  # a kind that another version of the program knew
            return False

    def _keep(self) -> None:
        running = () if self._jobs.running is None or self._cancelled else (self._jobs.running,)
        # A task of the schedule that was not begun is due again anyway.
        begun = self._log.done()
        waiting = [request for request in self._queue if not request.key or request.key in begun]
        keep_work(self._log, (*running, *waiting), self._again)

    def _tell(self, outcome: Notice) -> None:
        """Log it; a failure stays on the panel until an operator confirms it."""
        (self._log.add_failure if outcome.level is Level.ERROR else self._log.add)(outcome)

    def _settle(self, how: str) -> None:
        for request in self._queue:
            if request.key:
                self._log.mark_done(request.key, how)
        self._queue.clear()


_CANCELLED: Final = Notice("work-cancelled", "The waiting jobs were cancelled.")
_TOO_LATE: Final = Notice(
    "lamps-not-steady", "The job was cancelled because the lamps were not lit and stable in time.",
    "See the problems of the projectors, or increase power_up_s under [safety].", Level.ERROR,
)  # fmt: skip


def _expired(task: Task) -> Notice:
    return Notice(
        "task-left-out",
        f"The {task.what} ({task.key}) was not done in its time window.",
        "See the earlier events: the stage was open, without power, or busy.",
        Level.WARNING,
    )
