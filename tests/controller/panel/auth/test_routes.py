"""Passwords, sessions, limits."""

from __future__ import annotations

import json
import stat
from pathlib import Path
from typing import Literal

import httpx
import pytest
from argon2 import PasswordHasher, extract_parameters

from controller.core.errors import UsageError
from controller.kiosk.store.accounts import Account, Accounts, Role
from controller.panel.auth.sessions import IDLE_S, LONGEST_S, MOST_SESSIONS, LoginLimit, Sessions
from tests.controller.panel.memory_kiosk import MemoryKiosk
from tests.controller.panel.served import PASSWORD, QUICK_HASH, Served, csrf, log_in
from tests.full_disk import full_disk


class Clock:
    def __init__(self) -> None:
        self.now = 1000.0

    def __call__(self) -> float:
        return self.now


def test_passwords_are_kept_as_argon2id_in_a_private_file(tmp_path: Path) -> None:
    accounts = Accounts(tmp_path / "accounts.json")
    accounts.add("anna", Role.VIEWER, PASSWORD)
    text = (tmp_path / "accounts.json").read_text()
    assert "$argon2id$v=19$m=65536,t=3," in text
    assert PASSWORD not in text
    assert stat.S_IMODE((tmp_path / "accounts.json").stat().st_mode) == 0o600
    again = Accounts(tmp_path / "accounts.json")
    found = again.verify("anna", PASSWORD)
    assert found is not None
    assert found.role is Role.VIEWER
    assert again.verify("anna", PASSWORD + "x") is None
    assert again.verify("nobody", PASSWORD) is None


def test_a_name_that_does_not_exist_costs_a_hash_too(tmp_path: Path) -> None:
    class Counting(PasswordHasher):
        costs: list[object]

        def verify(self, hash: str | bytes, password: str | bytes) -> Literal[True]:  # noqa: A002
            # An empty or damaged hash would be refused at once.
            Counting.costs.append(extract_parameters(str(hash)))
            return QUICK_HASH.verify(hash, password)

    Counting.costs = []
    accounts = Accounts(tmp_path / "a.json", hasher=Counting())
    accounts.add("vera", Role.VIEWER, PASSWORD)
    assert accounts.verify("nobody", "whatever it is") is None
    assert accounts.verify("vera", "whatever it is") is None
    assert len(Counting.costs) == 2
    assert Counting.costs[0] == Counting.costs[1]


def test_the_one_time_password_ends_with_the_first_real_one(tmp_path: Path) -> None:
    accounts = Accounts(tmp_path / "a.json", hasher=QUICK_HASH)
    first, second = accounts.first_start(), accounts.first_start()
    assert first
    assert second
    assert first != second
    assert accounts.verify("technician", first) is None
    assert second not in (tmp_path / "a.json").read_text()
    accounts.set_password("technician", "seven tall horses")
    assert accounts.first_start() is None


def test_on_a_full_disk_somebody_can_log_in_first_all_the_same(tmp_path: Path) -> None:
    accounts = Accounts(tmp_path / "a.json", hasher=QUICK_HASH)
    with full_disk():
        password = accounts.first_start()
    assert password
    assert accounts.verify("technician", password) is not None
    accounts.set_password("technician", "seven tall horses")
    assert Accounts(tmp_path / "a.json", hasher=QUICK_HASH).first_start() is None


def test_a_damaged_file_of_accounts_does_not_open_the_door(tmp_path: Path) -> None:
    for text in ("", "{}", "[]", '{"accounts": [{}], "tokens": []}', '{"accounts": 1, "tokens": 2}', "\x00"):
        (tmp_path / "a.json").write_text(text)
        with pytest.raises(UsageError) as caught:
            Accounts(tmp_path / "a.json", hasher=QUICK_HASH)
        assert caught.value.code == "accounts-damaged"


def test_the_last_technician_stays(tmp_path: Path) -> None:
    accounts = Accounts(tmp_path / "a.json", hasher=QUICK_HASH)
    accounts.add("tina", Role.TECHNICIAN, PASSWORD)
    with pytest.raises(UsageError, match="last technician"):
        accounts.remove("tina")
    with pytest.raises(UsageError, match="last technician"):
        accounts.set_role("tina", Role.VIEWER)


@pytest.mark.parametrize("password", ["short", "aaaaaaaaaaaaaa", "my name is tina", "x" * 201])
def test_passwords_that_are_easy_to_guess_are_refused(tmp_path: Path, password: str) -> None:
    with pytest.raises(UsageError):
        Accounts(tmp_path / "a.json", hasher=QUICK_HASH).add("tina", Role.VIEWER, password)


def test_a_token_is_kept_only_as_its_digest_and_ends_when_it_is_removed(tmp_path: Path) -> None:
    accounts = Accounts(tmp_path / "a.json", hasher=QUICK_HASH)
    token = accounts.add_token("grafana", Role.VIEWER)
    assert token not in (tmp_path / "a.json").read_text()
    assert accounts.by_token(token) is not None
    assert accounts.by_token(token[:-1]) is None
    accounts.remove_token("grafana")
    assert accounts.by_token(token) is None


def test_sessions_end_by_age_by_silence_and_by_number(tmp_path: Path) -> None:
    clock = Clock()
    sessions = Sessions(tmp_path / "s.json", clock=clock)
    quiet, _ = sessions.begin("anna")
    clock.now += IDLE_S + 1
    assert sessions.get(quiet) is None
    busy, _ = sessions.begin("anna")
    for _ in range(int(LONGEST_S / IDLE_S * 2) + 1):
        clock.now += IDLE_S / 2 + 1
        sessions.get(busy)
    assert sessions.get(busy) is None
    first, _ = sessions.begin("anna")
    for _ in range(MOST_SESSIONS):
        sessions.begin("otto")
    assert sessions.get(first) is None


def test_a_disk_that_takes_nothing_keeps_nobody_out(tmp_path: Path) -> None:
    (tmp_path / "s.json").mkdir()
    sessions = Sessions(tmp_path / "s.json")
    secret, _ = sessions.begin("anna")
    assert sessions.get(secret) is not None


def test_a_clock_that_is_set_back_does_not_make_a_session_last_for_years() -> None:
    clock = Clock()
    clock.now = 1e9
    sessions = Sessions(clock=clock)
    secret, _ = sessions.begin("anna")
    clock.now -= 60
    assert sessions.get(secret) is not None, "a clock that is put right by a little ends nothing"
    clock.now -= 10 * LONGEST_S
    assert sessions.get(secret) is None


def test_sessions_outlive_the_service_and_hold_nothing_to_steal(tmp_path: Path) -> None:
    secret, session = Sessions(tmp_path / "s.json").begin("anna")
    assert secret not in (tmp_path / "s.json").read_text()
    again = Sessions(tmp_path / "s.json").get(secret)
    assert again is not None
    assert again.matches(session.csrf)
    (tmp_path / "s.json").write_text("[[[")
    assert Sessions(tmp_path / "s.json").get(secret) is None


def test_a_limit_lets_a_few_tries_pass_then_one_at_a_time() -> None:
    clock = Clock()
    limit = LoginLimit(burst=3, refill_s=10, most_keys=5, clock=clock)
    for _ in range(3):
        assert limit.wait_s("a") == 0
        limit.failed("a")
    assert 0 < limit.wait_s("a") <= 10
    assert limit.wait_s("b") == 0
    clock.now += 10
    assert limit.wait_s("a") == 0
    for number in range(100):
        limit.failed(f"other {number}")
    assert len(limit._used) <= 5


def test_guessing_is_stopped_and_even_the_right_password_waits(fresh: Served) -> None:
    with fresh.client() as client:
        statuses = [log_in(client, "tina", f"wrong guess {number}").status_code for number in range(8)]
        assert statuses == [403] * 5 + [429] * 3
        answer = log_in(client, "tina", PASSWORD)
        assert answer.status_code == 429
        assert int(answer.headers["retry-after"]) <= 31


def test_guessing_tokens_is_stopped(fresh: Served) -> None:
    with fresh.client() as client:
        wrong = {"authorization": "Bearer velatura_x"}
        statuses = {client.get("/api/v1/state", headers=wrong).status_code for _ in range(25)}
        assert statuses == {401, 429}


def test_a_log_in_begins_a_new_session_and_its_cookie_is_closed(fresh: Served) -> None:
    with fresh.client() as client:
        client.cookies.set("velatura", "chosen by somebody else")
        page = client.get("/login").text
        answer = client.post("/login", data={"csrf": csrf(page), "name": "vera", "password": PASSWORD})
        cookie = next(text for text in answer.headers.get_list("set-cookie") if text.startswith("velatura="))
        assert "chosen" not in cookie
        assert "HttpOnly" in cookie
        assert "SameSite=strict" in cookie
        assert client.post("/login", data={"name": "vera", "password": PASSWORD}).status_code == 403


def test_a_log_in_ends_the_session_that_the_browser_had(fresh: Served) -> None:
    with fresh.entered("vera") as vera:
        old = vera.cookies["velatura"]
        page = vera.get("/login").text
        vera.post("/login", data={"csrf": csrf(page), "name": "vera", "password": PASSWORD})
        assert vera.cookies["velatura"] != old
        assert vera.get("/").status_code == 200
    with fresh.client() as thief:
        thief.cookies.set("velatura", old)
        assert thief.get("/").status_code != 200


def test_a_removed_account_and_a_changed_password_end_their_sessions(fresh: Served) -> None:
    with fresh.entered("tina") as tina, fresh.entered("otto") as otto, fresh.entered("vera") as vera:
        token = csrf(tina.get("/accounts").text)
        asked = tina.post("/accounts/remove", data={"csrf": token, "name": "otto"})
        assert "Remove the account otto?" in asked.text
        assert otto.get("/").status_code == 200
        tina.post("/accounts/remove", data={"csrf": token, "name": "otto", "sure": "yes"})
        assert otto.get("/").status_code == 303
        with fresh.entered("vera") as elsewhere:
            sent = {"old": PASSWORD, "new": "another long one", "again": "another long one"}
            vera.post("/password", data={"csrf": csrf(vera.get("/password").text), **sent})
            assert elsewhere.get("/").status_code == 303
        assert vera.get("/").status_code == 200
        tina.post("/logout", data={"csrf": token})
        assert tina.get("/").status_code == 303


def change_password(client: httpx.Client, old: str, new: str, again: str) -> str:
    """What the panel says to it."""
    client.post("/password", data={"csrf": csrf(client.get("/password").text), "old": old, "new": new, "again": again})
    return client.get("/password").text


def test_who_finds_an_open_panel_cannot_change_its_password(fresh: Served) -> None:
    new = "another long one"
    with fresh.entered("vera") as vera:
        assert "The old password is wrong." in change_password(vera, "a wrong guess", new, new)
        assert "The two new passwords differ." in change_password(vera, PASSWORD, new, "another long two")
        assert "The new password is the old one." in change_password(vera, PASSWORD, PASSWORD, PASSWORD)
        assert "This password is too easy to guess." in change_password(vera, PASSWORD, "short", "short")
    with fresh.client() as client:
        assert log_in(client, "vera", new).status_code == 403
    with fresh.entered("vera"):
        pass


def test_guessing_the_old_password_is_stopped_and_even_the_right_one_waits(fresh: Served) -> None:
    new = "another long one"
    with fresh.entered("vera") as vera:
        said = [change_password(vera, f"wrong guess {number}", new, new) for number in range(8)]
        assert all("The old password is wrong." in what for what in said[:5])
        assert all("Too many wrong passwords." in what for what in said[5:])
        assert "Too many wrong passwords." in change_password(vera, PASSWORD, new, new)
    assert isinstance(fresh.kiosk, MemoryKiosk)
    assert any("A change of the password of vera" in what for _, what in fresh.kiosk.recorded)


def test_no_secret_is_shown_by_the_api(fresh: Served) -> None:
    token = fresh.token(Role.TECHNICIAN)
    with fresh.client() as client, fresh.entered("tina") as browser:
        document = client.get("/api/v1/openapi.json", headers=token).json()
        asked = [f"/api/v1{path}" for path, ways in document["paths"].items() if "get" in ways and "{" not in path]
        answers = [client.get(path, headers=token) for path in (*asked, "/metrics")]
        sessions = list(browser.cookies.values())
    folder = fresh.app.state.panel.options.folder
    stored = json.loads((folder / "accounts.json").read_text())
    secrets = [row["password_hash"] for row in stored["accounts"]] + [row["digest"] for row in stored["tokens"]]
    secrets += [*sessions, *(value.split()[-1] for value in token.values()), PASSWORD]
    assert len(secrets) >= 6
    assert all(secrets), "an empty one would be in every answer"
    assert len([one for one in answers if one.status_code == 200 and one.text]) > 5
    assert [secret for secret in secrets for one in answers if secret in one.text] == []


def test_an_old_password_that_is_changed_while_it_is_verified_opens_nothing(
    fresh: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    panel = fresh.app.state.panel
    verify = panel.accounts.verify

    def slowly(name: str, password: str) -> Account | None:
        found: Account | None = verify(name, password)
        panel.accounts.set_password(name, "another long one")
        panel.sessions.end_all(name)
        return found

    monkeypatch.setattr(panel.accounts, "verify", slowly)
    with fresh.client() as client:
        assert log_in(client, "vera", PASSWORD).status_code == 403
        assert client.get("/").status_code == 303
