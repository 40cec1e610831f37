"""How an alert leaves the computer: a mail to people, or JSON to a program. Both raise WorkError with the reason."""

from __future__ import annotations

import json
import smtplib
import ssl
import urllib.error
import urllib.request
from collections.abc import Sequence
from dataclasses import asdict
from email.message import EmailMessage
from pathlib import Path
from typing import Any, Final

from controller.config.models import AlertsTable
from controller.core.errors import WorkError
from controller.core.files import read_text
from controller.core.text import printable
from controller.kiosk.interface import EventRow

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
    if address.startswith("https:"):
        handlers.append(urllib.request.HTTPSHandler(context=_context(stage, table)))
    try:
        with urllib.request.build_opener(*handlers).open(request, timeout=PATIENCE_S):
            return
    except (OSError, ValueError) as error:
        raise _not_sent("The webhook", error) from error


class _NoRedirects(urllib.request.HTTPRedirectHandler):
    """What was moved has to be written into the settings: a POST would be repeated as a GET without its body."""

    def redirect_request(self, *_: Any, **__: Any) -> None:
        return None


def _context(stage: Path, table: AlertsTable) -> ssl.SSLContext:
    return ssl.create_default_context(cafile=None if table.certificates is None else str(stage / table.certificates))


def _not_sent(who: str, error: Exception) -> WorkError:
    detail = printable(str(error) or type(error).__name__)[:200]
    return WorkError("alert-not-sent", what=f"{who} took no alert: {detail}.",
                     remedy="Check [alerts] in stage.toml and the network; it is tried again.")  # fmt: skip


def _when(row: EventRow) -> str:
    import time

    return time.strftime("%Y-%m-%d %H:%M:%S UTC", time.gmtime(row.unix_s))
