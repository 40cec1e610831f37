"""Jobs that run or wait, kept in the log's file: work that a power cut ended is not forgotten."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Iterable
from typing import Final

from controller.kiosk.decide.interfaces import Request
from controller.kiosk.store.event_log import EventLog

_NAME: Final = "work"
_BACKGROUND: Final = "takeover"
"""It is asked for again as long as it is needed."""


def keep(log: EventLog, requests: Iterable[Request], again: frozenset[Request]) -> None:
    """Keep these requests, but those that are asked for again as long as they are needed.

    ``again``: those that were begun a second time.
    """
    rows = [[one.kind, one.light, list(one.arguments), one in again] for one in requests if _is_kept(one)]
    log.keep(_NAME, json.dumps(rows))


def unfinished(log: EventLog) -> list[tuple[Request, bool]]:
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
    return request.kind != _BACKGROUND
