"""Sends what happened to those who are not there: gathers events, tries again, and never holds anything else up."""

from __future__ import annotations

import http.client
import json
import smtplib
import ssl
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Sequence
from dataclasses import asdict
from email.message import EmailMessage
from pathlib import Path
from typing import Any, Final
from urllib.parse import urlsplit

from controller.config.models import AlertsTable
from controller.core.errors import UsageError, WorkError
from controller.core.files import read_text
from controller.core.text import printable
from controller.kiosk.state import EventRow
from controller.kiosk.store.event_log import EventLog
from hal.notices import Level, Notice
from hal.secret_words import concealed

PATIENCE_S: Final = 20.0
SUBJECT: Final = 120


def mail(stage: Path, name: str, table: AlertsTable, rows: Sequence[EventRow]) -> None:
    """One mail with these events. Raises WorkError("alert-not-sent")."""
    message = EmailMessage()
    message["From"], message["To"] = table.mail_from, ", ".join(table.mail_to)
    worst = next((row for row in rows if row.level == "error"), rows[0])
    message["Subject"] = printable(f"{name}: {worst.text}")[:SUBJECT]
    message.set_content("\n".join(f"{_when(row)} {row.level}: {printable(row.text)}" for row in rows) + "\n")
    try:
        with _connected(stage, table) as server:
            if table.mail_user is not None and table.mail_password_file is not None:
                server.login(table.mail_user, read_text(stage / table.mail_password_file).strip())
            server.send_message(message)
    except (OSError, ValueError, smtplib.SMTPException) as error:
        raise _not_sent(f"The mail server {table.mail_host}", error) from error


def _connected(stage: Path, table: AlertsTable) -> smtplib.SMTP:
    host, port = str(table.mail_host), table.mail_port
    if table.mail_security == "tls":
        return smtplib.SMTP_SSL(host, port, timeout=PATIENCE_S, context=_context(stage, table))
    server = smtplib.SMTP(host, port, timeout=PATIENCE_S)
    if table.mail_security == "starttls":
        try:
            server.starttls(context=_context(stage, table))
        except BaseException:
            server.close()
            raise
    return server


def webhook(stage: Path, name: str, table: AlertsTable, rows: Sequence[EventRow]) -> None:
    """One POST with these events. Raises WorkError("alert-not-sent") for any answer but success."""
    events: list[dict[str, Any]] = [asdict(row) for row in rows]
    body = json.dumps({"stage": name, "events": events}).encode()
    address = str(table.webhook)
    headers = {"content-type": "application/json", "user-agent": "velatura"}
    # The settings allow http and https only.
    request = urllib.request.Request(address, body, headers, method="POST")  # noqa: S310
    handlers: list[urllib.request.BaseHandler] = [_NoRedirects()]
    try:
        if address.startswith("https:"):
            handlers.append(urllib.request.HTTPSHandler(context=_context(stage, table)))
        with urllib.request.build_opener(*handlers).open(request, timeout=PATIENCE_S):
            return
    except (OSError, ValueError, http.client.HTTPException) as error:
        # Who knows its path may write there.
        raise _not_sent("The webhook", error, (address, urlsplit(address).path)) from error


class _NoRedirects(urllib.request.HTTPRedirectHandler):
    """What was moved has to be written into the settings: a POST would be repeated as a GET without its body."""

    def redirect_request(self, *_: Any, **__: Any) -> None:
        return None


def _context(stage: Path, table: AlertsTable) -> ssl.SSLContext:
    """Raises OSError, which names a file of certificates that has none."""
    file = None if table.certificates is None else str(stage / table.certificates)
    try:
        return ssl.create_default_context(cafile=file)
    except ssl.SSLError as error:
        raise OSError(f"{file} has no certificate in PEM format") from error


def _not_sent(who: str, error: Exception, secrets: Sequence[str] = ()) -> WorkError:
    detail = printable(concealed(str(error), secrets) or type(error).__name__)[:200]
    return WorkError("alert-not-sent", what=f"{who} took no alert: {detail}.",
                     remedy="Check [alerts] in stage.toml and the network; it is tried again.")  # fmt: skip


def _when(row: EventRow) -> str:
    return time.strftime("%Y-%m-%d %H:%M:%S UTC", time.gmtime(row.unix_s))


GATHER_S: Final = 5.0
"""From the first event to the message, because a fault seldom comes as one event."""
PAUSE_S: Final = 60.0
"""Between two messages of a channel, so that a device that fails every second fills no mailbox."""
AGAIN_S: Final = (30.0, 60.0, 300.0, 900.0)
MOST_EVENTS: Final = 50
"""In one message: the newest."""
_OWN: Final = "alert-not-sent"
_LEVELS: Final = {"warning": ("warning", "error"), "error": ("error",)}

Send = Callable[[Path, str, AlertsTable, Sequence[EventRow]], None]


class Channel:
    """One channel. What was sent is kept in the log's file, so that a restart does not repeat or lose an alert."""

    def __init__(self, name: str, send: Send, log: EventLog, monotonic: Callable[[], float]) -> None:
        self._name, self._send, self._log, self._monotonic = f"alerted-{name}", send, log, monotonic
        self._due_s: float | None = None
        self._next_s, self._failed = 0.0, 0
        if log.value(self._name) is None:
            self._sent(log.number)

    def step(self, stage: Path, name: str, table: AlertsTable) -> None:
        """Send what is due. Tells the log of the first failure in a row."""
        now_s = self._monotonic()
        rows = [row for row in self._log.after(int(self._log.value(self._name) or 0)) if _worth(row, table)]
        if not rows:
            self._due_s = None
            return
        self._due_s = now_s + GATHER_S if self._due_s is None else self._due_s
        if now_s < max(self._due_s, self._next_s):
            return
        try:
            self._send(stage, name, table, rows[-MOST_EVENTS:])
        except WorkError as error:
            if not self._failed:
                self._log.add(Notice(error.code, error.what, error.remedy, Level.WARNING))
            self._next_s = self._monotonic() + AGAIN_S[min(self._failed, len(AGAIN_S) - 1)]
            self._failed += 1
            return
        if self._failed:
            self._log.add(Notice("alert-sent", "Alerts are sent again."))
        self._failed, self._due_s = 0, None
        self._next_s = self._monotonic() + PAUSE_S
        self._sent(rows[-1].number)

    def _sent(self, number: int) -> None:
        self._log.keep(self._name, str(number))


class Alerts:
    """``table`` and ``name``: the settings and the stage's name now. One thread calls ``step`` about once a second."""

    def __init__(
        self, stage: Path, name: Callable[[], str], table: Callable[[], AlertsTable], log: EventLog, *,
        monotonic: Callable[[], float] = time.monotonic, wall: Callable[[], float] = time.time,
        ways: Callable[[AlertsTable], dict[str, Send]] | None = None,
    ) -> None:  # fmt: skip
        self._stage, self._name, self._table, self._log = stage, name, table, log
        self._monotonic, self._wall = monotonic, wall
        self._ways = ways or ways_out
        self._channels: dict[str, Channel] = {}

    def step(self) -> None:
        table = self._table()
        for kind, send in self._ways(table).items():
            if kind not in self._channels:
                self._channels[kind] = Channel(kind, send, self._log, self._monotonic)
            self._channels[kind].step(self._stage, self._name(), table)

    def test(self) -> None:
        """Send a test on every channel. Raises UsageError("alerts-none"), WorkError("alert-not-sent")."""
        table = self._table()
        if not (wanted := self._ways(table)):
            raise UsageError("alerts-none", what="stage.toml names no receiver of alerts.",
                             remedy="Write mail_to or webhook under [alerts].")  # fmt: skip
        row = EventRow(self._log.number, self._wall(), "info", "This is a test: alerts arrive.", "alert-test")
        for send in wanted.values():
            send(self._stage, self._name(), table, (row,))


def ways_out(table: AlertsTable) -> dict[str, Send]:
    """What sends to each receiver that the settings name."""
    by_mail: dict[str, Send] = {"mail": mail} if table.mail_to else {}
    return by_mail | ({"webhook": webhook} if table.webhook is not None else {})


def _worth(row: EventRow, table: AlertsTable) -> bool:
    return row.level in _LEVELS[table.least] and row.code != _OWN
