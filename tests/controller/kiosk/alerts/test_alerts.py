"""Alerts to a real mail server and a real web server: what they get, and what the log says when they take nothing."""

from __future__ import annotations

import shutil
import ssl
import subprocess
import tomllib
from pathlib import Path
from typing import Any

import pytest

from controller.config.loader import parse_stage
from controller.config.models import AlertsTable
from controller.config.problems import Place
from controller.core.errors import UsageError, WorkError
from controller.kiosk.alerts import AGAIN_S, GATHER_S, PAUSE_S, Alerts
from controller.kiosk.store.event_log import EventLog
from hal.notices import Level, Notice
from hal.toml_lines import KeyLines
from tests.controller.kiosk.alerts.servers import MailServer, WebServer

MAIL: dict[str, Any] = {"mail_to": ("care@example.org",), "mail_from": "kiosk@example.org", "mail_host": "127.0.0.1"}
BROKEN = Notice("lamp-given-up", "The lamp of projector left stays off.", "Replace it.", Level.ERROR)


class Hands:
    now_s = 1000.0

    def __call__(self) -> float:
        return self.now_s


class Alerting:
    """Alerts of a stage, on a clock that is moved by hand."""

    def __init__(self, stage: Path, **table: Any) -> None:
        self.table, self.hands = AlertsTable(**table), Hands()
        self.log = EventLog(stage / EventLog.FILE, durable=False)
        self.alerts = Alerts(stage, lambda: "Head\nof a boy", lambda: self.table, self.log, monotonic=self.hands)
        self.alerts.step()

    def after(self, seconds: float) -> None:
        self.hands.now_s += seconds
        self.alerts.step()

    @property
    def codes(self) -> list[str]:
        return [row.code for row in self.log.after(0)]


def test_events_of_the_level_are_gathered_into_one_message_for_each_and_sent_once(tmp_path: Path) -> None:
    with MailServer() as mail, WebServer() as web:
        one = Alerting(tmp_path, **MAIL, mail_port=mail.port, mail_security="none", webhook=web.address)
        one.log.add(Notice("state", "The stage is playing."))
        one.log.add(BROKEN)
        one.alerts.step()
        one.log.add(Notice("camera-missing", "The camera is gone.", "Plug it in.", Level.ERROR))
        assert (mail.mails, web.posts) == ([], [])
        one.after(GATHER_S)
        one.after(GATHER_S)
        (message,), (post,) = mail.mails, web.posts
        assert message["subject"].startswith("Head")
        assert "left stays off" in message["subject"]
        assert message["to"] == "care@example.org"
        assert "The camera is gone." in mail.bodies[0]
        assert "playing" not in mail.bodies[0]
        assert [event["code"] for event in post["events"]] == ["lamp-given-up", "camera-missing"]
        one.log.add(BROKEN)
        one.after(GATHER_S)
        one.after(GATHER_S)
        assert len(web.posts) == 1, "not a message for each event of a device that fails all the time"
        one.after(PAUSE_S)
        assert len(web.posts) == len(mail.mails) == 2
        one.log.close()
        again = Alerting(tmp_path, **MAIL, mail_port=mail.port, mail_security="none", webhook=web.address)
        again.after(GATHER_S)
        again.after(GATHER_S)
        assert len(web.posts) == 2, "a restart repeats nothing"
        again.log.close()


def test_a_server_that_takes_nothing_is_told_once_and_gets_it_later(tmp_path: Path) -> None:
    with MailServer(refuses=True) as mail, WebServer(code=500) as web:
        one = Alerting(tmp_path, **MAIL, mail_port=mail.port, mail_security="none", webhook=web.address)
        one.log.add(BROKEN)
        one.alerts.step()
        for _ in range(4):
            one.after(max(AGAIN_S))
        assert one.codes.count("alert-not-sent") == 2, "once for each server"
        with pytest.raises(WorkError, match="took no alert"):
            one.alerts.test()
        mail.refuses, web.code = False, 204
        one.after(max(AGAIN_S))
        assert (len(mail.mails), len(web.posts)) == (1, 1)
        assert one.codes.count("alert-sent") == 2
        web.code = 302
        with pytest.raises(WorkError, match="took no alert"):
            one.alerts.test()
        one.log.close()


def certificate(folder: Path) -> tuple[Path, Path]:
    """Of 127.0.0.1, by itself; and its key."""
    public, private = folder / "mail.pem", folder / "mail.key"
    asked = ("req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:P-256", "-nodes", "-days", "2")
    named = ("-subj", "/CN=mail", "-addext", "subjectAltName=IP:127.0.0.1")
    subprocess.run(["openssl", *asked, *named, "-keyout", private, "-out", public], check=True, capture_output=True)
    return public, private


@pytest.mark.skipif(shutil.which("openssl") is None, reason="needs openssl to make a certificate")
def test_a_password_goes_only_through_tls_and_only_to_a_server_that_proves_its_name(tmp_path: Path) -> None:
    public, private = certificate(tmp_path)
    (tmp_path / "mail-password").write_text("swordfish\n")
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(public, private)
    login: dict[str, Any] = {"mail_user": "kiosk", "mail_password_file": "mail-password"}
    with MailServer(context) as mail:
        one = Alerting(tmp_path, **MAIL, **login, mail_port=mail.port, certificates=public.name)
        one.alerts.test()
        assert (len(mail.mails), mail.logins) == (1, [("kiosk", "swordfish")])
        one.table = AlertsTable(**MAIL, **login, mail_port=mail.port)
        with pytest.raises(WorkError, match="certificate"):
            one.alerts.test()
        assert len(mail.logins) == 1
        one.log.close()


BASE = """
stage = { name = "s" }
camera = { driver = "ptp", iso = 100 }
display = { driver = "player" }
projectors = [{ name = "left", output = "P1", driver = "serial" }]
"""


@pytest.mark.parametrize(
    ("alerts", "key"),
    [
        ({"mail_to": ["a@b"]}, "mail_from"),
        ({"mail_to": ["a@b"], "mail_from": "c@d"}, "mail_host"),
        ({"mail_user": "u", "mail_security": "none"}, "mail_security"),
        ({"webhook": "ftp://example.org"}, "webhook"),
        ({"mail_to": ["nobody"]}, "mail_to"),
    ],
)
def test_settings_that_could_send_nothing_or_a_password_in_clear_are_refused(alerts: dict[str, Any], key: str) -> None:
    content = tomllib.loads(BASE) | {"alerts": alerts}
    with pytest.raises(UsageError) as refused:
        parse_stage(content, Place("stage.toml", KeyLines(BASE)))
    assert key in f"{refused.value.what} {refused.value.remedy}"


@pytest.mark.parametrize(
    "table", [{"webhook": "https://127.0.0.1:9/"}, {**MAIL, "mail_security": "tls", "mail_port": 9}]
)
def test_a_file_of_certificates_that_has_none_is_named(tmp_path: Path, table: dict[str, Any]) -> None:
    (tmp_path / "ca.pem").write_text("nothing")
    one = Alerting(tmp_path, **table, certificates="ca.pem")
    with pytest.raises(WorkError, match=r"ca\.pem has no certificate in PEM format"):
        one.alerts.test()
    one.log.close()


def test_without_anybody_to_tell_a_test_says_so(tmp_path: Path) -> None:
    one = Alerting(tmp_path)
    with pytest.raises(UsageError, match="names no receiver"):
        one.alerts.test()
    one.log.close()
