"""Who did what stands in the event log by name; and who tries tokens locks out no one but himself."""

from __future__ import annotations

from pathlib import Path

import pytest

from controller.cli.kiosk_process import PanelAddress, _check_panel
from controller.core.errors import UsageError
from controller.kiosk.store.accounts import Role
from controller.panel.api import PREFIX
from controller.panel.auth.sessions import EVERY_S, Refusals
from controller.panel.mqtt.options import BrokerOptions, check_broker
from tests.controller.panel.memory_kiosk import MemoryKiosk
from tests.controller.panel.served import PASSWORD, Served, csrf, log_in


def in_memory(fresh: Served) -> MemoryKiosk:
    assert isinstance(fresh.kiosk, MemoryKiosk)
    return fresh.kiosk


def told(fresh: Served) -> list[str]:
    return [what for _, what in in_memory(fresh).recorded]


def test_a_bad_client_does_not_lock_out_good_tokens_behind_the_same_address(fresh: Served) -> None:
    good = fresh.token(Role.VIEWER)
    with fresh.client() as client:
        answers = [
            client.get(f"{PREFIX}/state", headers={"authorization": "Bearer velatura_guess"}).status_code
            for _ in range(25)
        ]
        assert answers[0] == 401
        assert answers[-1] == 429, "who guesses has to wait"
        assert client.get(f"{PREFIX}/state", headers=good).status_code == 200
    assert any("A wrong token from 127.0.0.1 was refused" in what for what in told(fresh))


def test_log_ins_failures_accounts_tokens_settings_and_restores_are_in_the_log_by_name(fresh: Served) -> None:
    with fresh.client() as client:
        assert log_in(client, "tina", "wrong password").status_code == 403
    with fresh.entered("tina") as tina:
        token = csrf(tina.get("/accounts").text)
        for path, sent in (
            ("/accounts/add", {"name": "nora", "password": PASSWORD, "role": "viewer"}),
            ("/accounts/role", {"name": "nora", "role": "operator"}),
            ("/accounts/add", {"name": "nora", "password": PASSWORD, "role": "viewer"}),
            ("/do/remove-appearance", {"name": "marble", "sure": "yes"}),
            ("/tokens/add", {"name": "robot", "role": "viewer"}),
            ("/tokens/remove", {"name": "robot", "sure": "yes"}),
            ("/accounts/remove", {"name": "nora", "sure": "yes"}),
            ("/do/save-settings", {"text": fresh.kiosk.settings(), "sure": "yes"}),
        ):
            assert tina.post(path, data={"csrf": token, **sent}).status_code in (200, 303, 422), path
        restore = {"csrf": token, "sure": "yes"}
        tina.post("/do/restore", data=restore, files={"file": ("b.tar.gz", b"no backup")})
    with fresh.client() as machine:
        machine.post(f"{PREFIX}/identify", json={"on": True}, headers=fresh.token(Role.OPERATOR))
        assert (
            machine.post(f"{PREFIX}/play", json={"name": "no"}, headers=fresh.token(Role.OPERATOR)).status_code == 404
        )
    lines = told(fresh)
    for expected in (
        "A log-in as tina from 127.0.0.1 was refused.",
        "tina logged in from 127.0.0.1.",
        "tina: Add the account nora (viewer).",
        "tina: Make nora a operator.",
        "tina: Add the token robot (viewer).",
        "tina: Remove the token robot.",
        "tina: Remove the account nora.",
        "tina: Check stage.toml, save it, and apply it.",
        "tina: Replace settings, calibration and appearances with a backup. Refused: This file is not a backup.",
        "tina: Remove an appearance (marble). Refused: It is playing, or scheduled.",
        "tina: Add the account nora (viewer). Refused: The account 'nora' exists already.",
    ):
        assert expected in lines, lines
    assert any(line.startswith("Token t") and "projector's name" in line for line in lines)
    refused = [what for code, what in in_memory(fresh).recorded if code == "refused"]
    assert any("Show this appearance now (no). Refused: There is no such appearance." in line for line in refused)
    assert [what for code, what in in_memory(fresh).recorded if code == "done-by" and "Refused" in what] == []
    assert not any(PASSWORD in line for line in lines)


@pytest.mark.parametrize(
    ("operation", "sent", "question"),
    [
        ("stop", {}, "Close the stage?"),
        ("remove-appearance", {"name": "warm wood"}, "Remove the appearance warm wood?"),
    ],
)
def test_closing_and_removing_ask_first(fresh: Served, operation: str, sent: dict[str, str], question: str) -> None:
    before = fresh.kiosk.snapshot()
    with fresh.entered("tina") as tina:
        form = {"csrf": csrf(tina.get("/").text), **sent}
        page = tina.post(f"/do/{operation}", data=form)
        assert question in page.text
        assert fresh.kiosk.snapshot() == before
        assert tina.post(f"/do/{operation}", data={**form, "sure": "yes"}).status_code == 303
    assert any(what.startswith("tina: ") for what in told(fresh))


def test_settings_that_restart_something_and_restoring_ask_first(fresh: Served) -> None:
    with fresh.entered("tina") as tina:
        token, text = csrf(tina.get("/settings").text), fresh.kiosk.settings()
        in_memory(fresh).effect = "The lamp of left is switched off & on again."
        page = tina.post("/do/save-settings", data={"csrf": token, "text": f"# new\n{text}"})
        assert "The lamp of left is switched off &amp; on again." in page.text
        assert fresh.kiosk.settings() == text
        assert 'name="sure" value="yes"' in page.text
        sent = {"csrf": token, "text": f"# new\n{text}", "sure": "yes"}
        assert tina.post("/do/save-settings", data=sent).status_code == 303
        assert fresh.kiosk.settings().startswith("# new")
        in_memory(fresh).effect = ""
        assert tina.post("/do/save-settings", data={"csrf": token, "text": text}).status_code == 303
        asked = tina.post("/do/restore", data={"csrf": token}, files={"file": ("b", b"")}, follow_redirects=True)
        assert "Tick the box" in asked.text


def test_who_tries_many_names_does_not_fill_the_log() -> None:
    now, lines = [0.0], list[str]()
    refusals = Refusals(lambda code, what, level: lines.append(what), lambda: now[0])
    for number in range(1000):
        refusals.add(f"A log-in as {number} was refused")
    now[0] += EVERY_S
    refusals.add("A log-in as x was refused")
    assert lines == ["A log-in as 0 was refused.", "A log-in as x was refused, and 999 before it."]


@pytest.mark.parametrize("host", ["broker.example", "10.0.0.9", "::"])
def test_a_password_for_a_broker_elsewhere_needs_tls(host: str, tmp_path: Path) -> None:
    password = tmp_path / "password"
    password.write_text("swordfish\n")
    with pytest.raises(UsageError) as refused:
        check_broker(BrokerOptions(host, password_file=password))
    assert refused.value.code == "mqtt-password-without-tls"
    with pytest.raises(UsageError):
        _check_panel(PanelAddress(broker=BrokerOptions(host, password_file=password)))
    check_broker(BrokerOptions(host, password_file=password, certificates=password))
    check_broker(BrokerOptions(host))
    check_broker(BrokerOptions("127.0.0.1", password_file=password))
