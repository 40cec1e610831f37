"""Server-side sessions, the limit for log-in attempts, and refused ones for the event log."""

from __future__ import annotations

import contextlib
import hmac
import json
import secrets
import threading
import time
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from controller.core.errors import VelaturaError
from controller.core.files import read_text
from controller.core.storage import write_atomically
from controller.kiosk.store.accounts import digest_of

LONGEST_S: Final = 12 * 3600.0
"""After this time a user must log in again, even if active."""

IDLE_S: Final = 2 * 3600.0
MOST_SESSIONS: Final = 200


@dataclass(slots=True)
class Session:
    """A logged-in browser. ``notes``: (level, sentence) to show on its next page."""

    account: str
    csrf: str
    began_unix_s: float
    seen_unix_s: float
    notes: list[tuple[str, str]] = field(default_factory=list)

    def matches(self, token: str) -> bool:
        """Whether ``token`` is this session's CSRF token, compared in constant time."""
        return hmac.compare_digest(self.csrf.encode(), token.encode())


class Sessions:
    """Sessions by the digest of the cookie, so that neither memory nor ``file`` contains a secret.

    With ``file`` they survive a restart of the service. Thread-safe.
    """

    def __init__(self, file: Path | None = None, *, clock: Callable[[], float] = time.time) -> None:
        self._file, self._clock = file, clock
        self._lock = threading.Lock()
        self._sessions: OrderedDict[str, Session] = OrderedDict(_read(file))

    def begin(self, account: str) -> tuple[str, Session]:
        """A new session and the secret for the browser's cookie."""
        secret, now = secrets.token_urlsafe(32), self._clock()
        session = Session(account, secrets.token_urlsafe(32), now, now)
        with self._lock:
            self._sessions[digest_of(secret)] = session
            while len(self._sessions) > MOST_SESSIONS:
                self._sessions.popitem(last=False)
            # A disk error must not prevent a login; the session is then lost at the next start.
            with contextlib.suppress(VelaturaError, OSError):
                self._write()
        return secret, session

    def get(self, secret: str, *, touch: bool = True) -> Session | None:
        """The valid session of this cookie; with ``touch`` it counts as used now."""
        now, digest = self._clock(), digest_of(secret)
        with self._lock:
            session = self._sessions.get(digest)
            if session is None:
                return None
            # A session from the future began before the clock was set back: its age is unknown.
            if abs(now - session.began_unix_s) > LONGEST_S or abs(now - session.seen_unix_s) > IDLE_S:
                del self._sessions[digest]
                return None
            if touch:
                session.seen_unix_s = now
            return session

    def end(self, secret: str) -> None:
        with self._lock:
            if self._sessions.pop(digest_of(secret), None) is not None:
                self._write()

    def end_all(self, account: str, *, but: Session | None = None) -> None:
        """After a change of password or role, or when the account is removed."""
        with self._lock:
            mine = [key for key, session in self._sessions.items() if session.account == account and session is not but]
            for key in mine:
                del self._sessions[key]
            self._write()

    def _write(self) -> None:
        if self._file is None:
            return
        rows = {
            key: [session.account, session.csrf, session.began_unix_s, session.seen_unix_s]
            for key, session in self._sessions.items()
        }
        write_atomically(self._file, json.dumps(rows).encode(), mode=0o600)


def _read(file: Path | None) -> dict[str, Session]:
    """A damaged file only ends the sessions."""
    if file is None or not file.exists():
        return {}
    try:
        rows = json.loads(read_text(file))
        return {key: Session(str(row[0]), str(row[1]), float(row[2]), float(row[3])) for key, row in rows.items()}
    except (ValueError, TypeError, IndexError, AttributeError, OSError, RecursionError):
        return {}


class LoginLimit:
    """Allows ``burst`` failures, then one more every ``refill_s`` seconds, for each key (address, account).

    Keeps at most ``most_keys`` and drops the oldest, so that memory stays bounded.
    """

    def __init__(
        self,
        *,
        burst: int = 5,
        refill_s: float = 30.0,
        most_keys: int = 4096,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._burst, self._refill_s, self._most, self._clock = burst, refill_s, most_keys, clock
        self._lock = threading.Lock()
        self._used: OrderedDict[str, tuple[float, float]] = OrderedDict()

    def wait_s(self, *keys: str) -> float:
        """Seconds until another attempt is allowed for all ``keys``; 0: now."""
        with self._lock:
            excess = max((self._level(key) - (self._burst - 1) for key in keys), default=0.0)
        return max(0.0, excess * self._refill_s)

    def failed(self, *keys: str) -> None:
        with self._lock:
            for key in keys:
                self._used[key] = (min(self._burst, self._level(key) + 1), self._clock())
                self._used.move_to_end(key)
            while len(self._used) > self._most:
                self._used.popitem(last=False)

    def succeeded(self, *keys: str) -> None:
        with self._lock:
            for key in keys:
                self._used.pop(key, None)

    def _level(self, key: str) -> float:
        level, then = self._used.get(key, (0.0, self._clock()))
        return max(0.0, level - (self._clock() - then) / self._refill_s)


EVERY_S: Final = 10.0


class Refusals:
    """``record``: adds a line to the event log. Many wrong names or tokens must not push all else out of it."""

    def __init__(self, record: Callable[..., Any], clock: Callable[[], float] = time.monotonic) -> None:
        self._record, self._clock = record, clock
        self._lock = threading.Lock()
        self._told_s, self._untold = float("-inf"), 0

    def add(self, what: str) -> None:
        """``what`` without its full stop; one line in ``EVERY_S``, which counts those in between."""
        with self._lock:
            if self._clock() - self._told_s < EVERY_S:
                self._untold += 1
                return
            more, self._untold, self._told_s = self._untold, 0, self._clock()
        self._record("refused", f"{what}, and {more} before it." if more else f"{what}.", "warning")
